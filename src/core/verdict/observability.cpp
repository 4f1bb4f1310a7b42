#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/core/verdict/verdict.h"

namespace imu_pose_calib {
namespace {

constexpr double kDegenerateFactor = 10.0;  // times the weak threshold

// What is worth a warning:
constexpr double kCorrelated = 3.0;      // clusters' sigma over the model's
constexpr double kNotableDelay = 10e-3;  // [s]

double WeakThreshold(const CalibrationOptions& options, const std::string& unit) {
  if (unit == "m") return options.weak_translation_std;
  if (unit == "rad") return options.weak_rotation_std;
  return options.weak_time_shift_std;
}

/// What the verdict rests on.
std::vector<Observability> Spectrum(const Marginals& marginals, const Eigen::MatrixXd& C,
                                    const Calibration& result) {
  std::vector<Observability> spectrum;
  for (const PlacedParameter& p : marginals.parameters) {
    const int k = p.place;
    const ParameterKind kind = p.parameter.kind;
    if (!(C(k, k) > 0.0)) continue;
    std::string of = OfImu(p.parameter.imu, result.imus.size());
    if (kind == ParameterKind::kTimeShift)
      of += OfSession(p.parameter.session, result.sessions.size());
    const auto add_time = [&](const char* name) {
      spectrum.push_back({name + of, std::sqrt(C(k, k)), "s", Status::kNotRun});
    };
    if (kind == ParameterKind::kTranslation)
      AddDirections(C.block<3, 3>(k, k), "p_MI" + of + " along ", "marker", "m", &spectrum);
    if (kind == ParameterKind::kRotation)
      AddDirections(C.block<3, 3>(k, k), "R_MI" + of + " about ", "imu", "rad", &spectrum);
    if (kind == ParameterKind::kTimeShift) add_time("time_shift");
    if (kind == ParameterKind::kAccelDelay) add_time("accel_delay");
  }
  return spectrum;
}

/// Largest factor by which the clusters' sigma exceeds the model's, of what the verdict rests on.
double Correlation(const Marginals& m) {
  double ratio = 0.0;
  for (const PlacedParameter& p : m.parameters)
    for (int i = p.place; i < p.place + p.parameter.size; ++i)
      if (p.parameter.kind <= ParameterKind::kAccelDelay && m.model(i, i) > 0.0)
        ratio = std::max(ratio, std::sqrt(m.robust(i, i) / m.model(i, i)));
  return ratio;
}

void WarnOfMisfit(const Marginals& marginals, Calibration* result) {
  const auto warn = [result](const std::string& text) { result->warnings.push_back(text); };
  const double correlation = Correlation(marginals);
  if (correlation > kCorrelated)
    warn("the residuals are not independent noise: sigmas are up to " +
         Number(correlation, "%.1f") + " times as large as with it");
  for (size_t i = 0; i < result->imus.size(); ++i) {
    const double delay = result->imus[i].accel_delay;
    if (std::abs(delay) > kNotableDelay)
      warn("the accelerometer's data" + OfImu(i, result->imus.size()) + " are " +
           InWords(std::abs(delay), "s") + (delay > 0.0 ? " later" : " earlier") +
           " than the gyroscope's of the same stamp: check the imu's filters and driver");
  }
}

/// Sigmas of one parameter, but for p_MI and R_MI, which go together.
void ReportParameter(const PlacedParameter& p, const Eigen::MatrixXd& C, Calibration* result) {
  const Eigen::VectorXd std_dev =
      C.diagonal().segment(p.place, p.parameter.size).cwiseMax(0.0).cwiseSqrt();
  const ParameterKind kind = p.parameter.kind;
  ImuCalibration& imu = result->imus[p.parameter.imu];
  SessionCalibration& session = result->sessions[p.parameter.session];
  ImuSession& own = session.imus[p.parameter.imu];
  const std::pair<ParameterKind, double*> places[] = {
      {ParameterKind::kTimeShift, &own.time_shift_std},
      {ParameterKind::kAccelDelay, &imu.accel_delay_std},
      {ParameterKind::kClockDrift, &own.clock_drift_std},
      {ParameterKind::kPoseSmoothing, &result->pose_smoothing_std},
      {ParameterKind::kPositionSmoothing, &result->position_smoothing_std},
      {ParameterKind::kPoseCumulants, result->pose_cumulants_std.data()},
      {ParameterKind::kPositionCumulants, result->position_cumulants_std.data()},
      {ParameterKind::kPositionDelay, &result->position_delay_std},
      {ParameterKind::kPoseScale, &result->pose_scale_std},
      {ParameterKind::kGyroSmoothing, &imu.gyro_smoothing_std},
      {ParameterKind::kAccelSmoothing, &imu.accel_smoothing_std},
      {ParameterKind::kMountCompliance, &imu.mount_compliance_std},
      {ParameterKind::kGravity, session.g_W_std.data()},
      {ParameterKind::kGyroBias, own.gyro_bias_std.data()},
      {ParameterKind::kAccelBias, own.accel_bias_std.data()}};
  for (const auto& [of, place] : places)
    if (of == kind) std::copy_n(std_dev.data(), std_dev.size(), place);
  if (kind == ParameterKind::kGyroIntrinsics)
    imu.gyro_matrix_std = GyroMatrix(Vector6d(std_dev)) - Eigen::Matrix3d::Identity();
  if (kind == ParameterKind::kAccelIntrinsics)
    imu.accel_matrix_std = AccelMatrix(Vector9d(std_dev)) - Eigen::Matrix3d::Identity();
  if (kind == ParameterKind::kAccelPositions)
    imu.accel_positions_std = AccelPositions(Vector6d(std_dev)).cwiseAbs();
}

/// Covariance of each T_MI, and the transforms between the IMUs with theirs.
void ReportTransforms(const Eigen::MatrixXd& C, const Marginals& marginals, Calibration* result) {
  // Rows of (p_MI, R_MI) of each IMU; zero rows for what is not estimated.
  Eigen::MatrixXd S = Eigen::MatrixXd::Zero(6 * static_cast<Eigen::Index>(result->imus.size()),
                                            marginals.model.rows());
  for (const PlacedParameter& p : marginals.parameters) {
    const auto row = 6 * static_cast<Eigen::Index>(p.parameter.imu);
    if (p.parameter.kind == ParameterKind::kTranslation) S.block<3, 3>(row, p.place).setIdentity();
    if (p.parameter.kind == ParameterKind::kRotation) S.block<3, 3>(row + 3, p.place).setIdentity();
  }
  const Eigen::MatrixXd poses = Propagate(S, C);
  const Eigen::MatrixXd model = Propagate(S, marginals.model);
  const ImuCalibration& first = result->imus[0];
  result->between_imus.clear();
  for (size_t i = 0; i < result->imus.size(); ++i) {
    const auto row = 6 * static_cast<Eigen::Index>(i);
    result->imus[i].covariance = poses.block<6, 6>(row, row);
    result->imus[i].model_covariance = model.block<6, 6>(row, row);
    if (i == 0) continue;
    result->between_imus.push_back(Between(first.T_MI, first.covariance, result->imus[i].T_MI,
                                           result->imus[i].covariance, poses.block<6, 6>(0, row)));
    result->between_imus.back().second = i;
  }
}

}  // namespace

BetweenImus Between(const Rigid3& T_MF, const Matrix6d& covariance_F, const Rigid3& T_MS,
                    const Matrix6d& covariance_S, const Matrix6d& cross) {
  BetweenImus between{0, 0, T_MF.Inverse() * T_MS, {}};
  // p = R_MF^T (p_MS - p_MF), R = R_MF^T R_MS, with R_MF Exp(theta_F) and R_MS Exp(theta_S).
  const Eigen::Matrix3d R_FM = T_MF.q.conjugate().toRotationMatrix();
  Eigen::Matrix<double, 6, 12> J = Eigen::Matrix<double, 6, 12>::Zero();
  J.block<3, 3>(0, 0) = -R_FM;
  J.block<3, 3>(0, 3) = Hat(between.T.p);
  J.block<3, 3>(0, 6) = R_FM;
  J.block<3, 3>(3, 3) = -between.T.q.conjugate().toRotationMatrix();
  J.block<3, 3>(3, 9).setIdentity();
  Eigen::Matrix<double, 12, 12> both;
  both << covariance_F, cross, cross.transpose(), covariance_S;
  between.covariance = Propagate(J, both);
  return between;
}

void AddDirections(const Eigen::Matrix3d& C, const std::string& name, const std::string& frame,
                   const std::string& unit, std::vector<Observability>* spectrum) {
  if (C.isZero(0.0)) return;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(C);
  for (int k = 0; k < 3; ++k)
    spectrum->push_back({name + DescribeAxis(eigen.eigenvectors().col(k), frame),
                         std::sqrt(std::max(0.0, eigen.eigenvalues()[k])), unit, Status::kNotRun});
}

Status GradeSpectrum(const CalibrationOptions& options, std::vector<Observability>* spectrum,
                     std::string* message) {
  const auto badness = [&](const Observability& o) {
    return o.std / WeakThreshold(options, o.unit);
  };
  for (Observability& o : *spectrum)
    o.status = badness(o) <= 1.0                 ? Status::kOk
               : badness(o) <= kDegenerateFactor ? Status::kWeak
                                                 : Status::kDegenerate;
  std::stable_sort(
      spectrum->begin(), spectrum->end(),
      [&](const Observability& a, const Observability& b) { return badness(a) > badness(b); });
  *message = "every sigma is within its bound";
  if (spectrum->empty() || spectrum->front().status == Status::kOk) return Status::kOk;
  const Observability& worst = spectrum->front();
  const bool is_degenerate = worst.status == Status::kDegenerate;
  const double bound =
      (is_degenerate ? kDegenerateFactor : 1.0) * WeakThreshold(options, worst.unit);
  *message = (is_degenerate ? "the motion does not determine " : "sigma of ") + worst.direction +
             (is_degenerate ? ": sigma " : " is ") + InWords(worst.std, worst.unit) +
             " (bound: " + InWords(bound, worst.unit) +
             "); record longer, and turn faster about at least two axes";
  return worst.status;
}

void GradeResult(const CalibrationOptions& options, const Marginals& marginals,
                 Calibration* result) {
  WarnOfMisfit(marginals, result);
  if (!marginals.model.allFinite() || !marginals.robust.allFinite()) {
    result->status = Status::kDegenerate;
    result->message = std::string("the data do not determine all parameters; ") + kTurnAdvice;
    result->unobservable = {result->message};
    return;
  }
  const Eigen::VectorXd enlargement = Enlargement(marginals.model, marginals.robust);
  const auto larger = enlargement.asDiagonal();
  const Eigen::MatrixXd C = larger * marginals.model * larger;
  for (const PlacedParameter& p : marginals.parameters) ReportParameter(p, C, result);
  // Of further IMUs the gyroscope's is known as less that of the first.
  if (const int first = marginals.Find(ParameterKind::kGyroSmoothing, 0); first >= 0)
    for (size_t i = 1; i < result->imus.size(); ++i)
      if (const int own = marginals.Find(ParameterKind::kGyroSmoothing, i); own >= 0)
        result->imus[i].gyro_smoothing_std =
            std::sqrt(C(own, own) + C(first, first) + 2.0 * C(own, first));
  ReportTransforms(C, marginals, result);

  const auto take_halves = [&](ParameterKind kind, int size, double* difference) {
    const int place = marginals.Find(kind);
    if (place >= 0) std::copy_n(&marginals.halves_difference[place], size, difference);
  };
  take_halves(ParameterKind::kTranslation, 3, result->split_half.translation.data());
  take_halves(ParameterKind::kRotation, 3, result->split_half.rotation.data());
  take_halves(ParameterKind::kTimeShift, 1, &result->split_half.time_shift);
  result->split_half.sigmas = marginals.halves_sigmas;

  result->observability = Spectrum(marginals, C, *result);
  result->status = GradeSpectrum(options, &result->observability, &result->message);
  for (const Observability& o : result->observability)
    if (o.status == Status::kDegenerate)
      result->unobservable.push_back(o.direction + ": turn faster, and about a second axis");
}

}  // namespace imu_pose_calib
