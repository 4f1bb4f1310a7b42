#include "imu_pose_calib/core/observability.h"

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <sstream>
#include <utility>

#include "imu_pose_calib/core/intrinsics.h"

namespace imu_pose_calib {
namespace {

constexpr double kMinTurnRate = 0.01;  // [rad/s] about the second axis
constexpr double kSampleStep = 0.02;   // [s] between the instants at which the motion is judged
constexpr double kDegenerateFactor = 10.0;  // times the weak threshold

// What is worth a warning:
constexpr double kCertain = 3.0;            // sigma of a hint
constexpr double kCorrelated = 3.0;         // clusters' sigma over the model's
constexpr double kDisagreement = 5.0;       // sigma between the halves
constexpr double kNotableDrift = 1e-4;      // [s] over the recording
constexpr double kNotableSmoothing = 1e-5;  // [s^2]
constexpr double kNotableScale = 5e-3;      // [1]
constexpr double kNotableDelay = 10e-3;     // [s]

const char* const kTurnAdvice = "turn the marker about at least two axes";

/// Covariance of p_MI once the information that the trajectory's errors feign is taken away; huge
/// where nothing remains.
Eigen::Matrix3d HonestLeverArm(const Eigen::Matrix3d& covariance, double feigned_information) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      Eigen::Matrix3d(covariance.inverse() - feigned_information * Eigen::Matrix3d::Identity()));
  const Eigen::Matrix3d& V = eigen.eigenvectors();
  return V * eigen.eigenvalues().cwiseMax(1e-12).cwiseInverse().asDiagonal() * V.transpose();
}

/// Scales the model's covariance so that every sigma is at least the robust one.
CalibrationMatrix Enlarge(const CalibrationMatrix& model, const CalibrationCovariance& c) {
  Eigen::Matrix<double, kCalibrationSize, 1> scale;
  for (int i = 0; i < kCalibrationSize; ++i)
    scale[i] = c.model(i, i) > 0.0 ? std::sqrt(std::max(1.0, c.robust(i, i) / c.model(i, i))) : 1.0;
  return scale.asDiagonal() * model * scale.asDiagonal();
}

/// 123.4 mm, 0.1234 deg or 0.1234 ms.
std::string InWords(double value, const std::string& unit) {
  std::ostringstream text;
  text.precision(3);
  if (unit == "m") text << 1e3 * value << " mm";
  if (unit == "rad") text << 180.0 / M_PI * value << " deg";
  if (unit == "s") text << 1e3 * value << " ms";
  return text.str();
}

/// Principal directions of the 3x3 block of C at `place`, each with its sigma. None when it is not
/// estimated.
void AddDirections(const CalibrationMatrix& C,
                   int place,
                   const std::string& name,
                   const std::string& frame,
                   const std::string& unit,
                   std::vector<Observability>* spectrum) {
  const Eigen::Matrix3d block = C.block<3, 3>(place, place);
  if (block.isZero(0.0)) return;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(block);
  for (int k = 0; k < 3; ++k)
    spectrum->push_back({name + DescribeAxis(eigen.eigenvectors().col(k), frame),
                         std::sqrt(std::max(0.0, eigen.eigenvalues()[k])),
                         unit,
                         Status::kNotRun});
}

double WeakThreshold(const CalibrationOptions& options, const std::string& unit) {
  if (unit == "m") return options.weak_translation_std;
  if (unit == "rad") return options.weak_rotation_std;
  return options.weak_time_shift_std;
}

/// Each direction with its verdict, the worst first.
std::vector<Observability> Spectrum(const CalibrationOptions& options, const CalibrationMatrix& C) {
  std::vector<Observability> spectrum;
  AddDirections(C, kTranslation, "p_MI along ", "marker", "m", &spectrum);
  AddDirections(C, kRotation, "R_MI about ", "imu", "rad", &spectrum);
  if (C(kTimeShift, kTimeShift) > 0.0)
    spectrum.push_back({"time_shift", std::sqrt(C(kTimeShift, kTimeShift)), "s", Status::kNotRun});
  if (C(kAccelDelay, kAccelDelay) > 0.0)
    spectrum.push_back(
        {"accel_delay", std::sqrt(C(kAccelDelay, kAccelDelay)), "s", Status::kNotRun});
  const auto badness = [&](const Observability& o) {
    return o.std / WeakThreshold(options, o.unit);
  };
  for (Observability& o : spectrum)
    o.status = badness(o) <= 1.0                 ? Status::kOk
               : badness(o) <= kDegenerateFactor ? Status::kWeak
                                                 : Status::kDegenerate;
  std::stable_sort(
      spectrum.begin(), spectrum.end(), [&](const Observability& a, const Observability& b) {
        return badness(a) > badness(b);
      });
  return spectrum;
}

/// Largest factor by which the clusters' sigma exceeds the model's.
double Correlation(const CalibrationCovariance& c) {
  double ratio = 0.0;
  for (int i = 0; i <= kAccelDelay; ++i)
    if (c.model(i, i) > 0.0) ratio = std::max(ratio, std::sqrt(c.robust(i, i) / c.model(i, i)));
  return ratio;
}

/// The hint of largest size among `count` from `place` on that is certain; 0 when none is.
double CertainHint(const CalibrationCovariance& c, int place, int count) {
  double largest = 0.0;
  for (int i = place; i < place + count; ++i)
    if (std::abs(c.hint[i]) > kCertain * c.hint_std[i] && std::abs(c.hint[i]) > std::abs(largest))
      largest = c.hint[i];
  return largest;
}

}  // namespace

TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  Eigen::Matrix3d sum2 = Eigen::Matrix3d::Zero();
  double variance = 0.0, count = 0.0;
  for (double t = 0.0; t <= data.poses.back().t; t += kSampleStep) {
    MarkerState<double> state;
    if (!trajectory.Evaluate(t, &state)) continue;
    sum += state.omega_M;
    sum2 += state.omega_M * state.omega_M.transpose();
    variance += trajectory.Variance(t).omega;
    count += 1.0;
  }
  const Eigen::Vector3d mean = sum / count;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      Eigen::Matrix3d(sum2 / count - mean * mean.transpose()));
  const double noise = variance / count;
  TurnExcitation turns;
  for (int k = 0; k < 3; ++k) {
    const double excess = eigen.eigenvalues()[2 - k] - noise;
    turns.rate_std[k] = excess > 0.5 * noise ? std::sqrt(excess) : 0.0;
    turns.axes_M.col(k) = eigen.eigenvectors().col(2 - k);
  }
  return turns;
}

std::string DescribeAxis(const Eigen::Vector3d& direction, const std::string& frame) {
  const Eigen::Vector3d axis = direction.normalized();
  int largest = 0;
  if (axis.cwiseAbs().maxCoeff(&largest) > std::cos(20.0 * M_PI / 180.0))
    return frame + " " + "xyz"[largest];
  const double sign = axis[largest] < 0.0 ? -1.0 : 1.0;
  char text[48];
  std::snprintf(text,
                sizeof(text),
                "(%.2f, %.2f, %.2f) in the ",
                sign * axis.x(),
                sign * axis.y(),
                sign * axis.z());
  return text + frame + " frame";
}

bool IsMotionDegenerate(const TurnExcitation& turns, Calibration* result) {
  if (turns.rate_std[1] >= kMinTurnRate) return false;
  result->status = Status::kDegenerate;
  std::ostringstream text;
  text.precision(2);
  if (turns.rate_std[0] < kMinTurnRate) {
    result->unobservable = {"R_MI, p_MI and time_shift: " + std::string(kTurnAdvice)};
    text << "the marker does not turn (" << turns.rate_std[0]
         << " rad/s rms, bound: " << kMinTurnRate
         << " rad/s): R_MI, p_MI and time_shift are undetermined; " << kTurnAdvice;
  } else {
    const std::string axis = DescribeAxis(turns.axes_M.col(0));
    result->unobservable = {"p_MI along " + axis + ": turn about a second axis"};
    text << "the marker turns about one axis only, " << axis << " (" << turns.rate_std[0]
         << " rad/s rms; about any other " << turns.rate_std[1] << " rad/s, bound: " << kMinTurnRate
         << " rad/s): p_MI along it is undetermined; " << kTurnAdvice;
  }
  result->message = text.str();
  return true;
}

void GradeResult(const CalibrationOptions& options,
                 const CalibrationCovariance& covariance,
                 Calibration* result) {
  if (!covariance.model.allFinite() || !covariance.robust.allFinite()) {
    result->status = Status::kDegenerate;
    result->message = std::string("the data do not determine all parameters; ") + kTurnAdvice;
    result->unobservable = {result->message};
    return;
  }
  const CalibrationMatrix C = Enlarge(covariance.model, covariance);
  result->covariance = C.topLeftCorner<6, 6>();
  result->time_shift_std = std::sqrt(C(kTimeShift, kTimeShift));
  result->accel_delay_std = std::sqrt(C(kAccelDelay, kAccelDelay));
  result->clock_drift_std = std::sqrt(C(kClockDrift, kClockDrift));
  result->pose_smoothing_std = std::sqrt(C(kPoseSmoothing, kPoseSmoothing));
  const CalibrationVector std_dev = C.diagonal().cwiseSqrt();
  result->gyro_matrix_std =
      GyroMatrix(std_dev.segment<6>(kGyroIntrinsics)) - Eigen::Matrix3d::Identity();
  result->accel_matrix_std =
      AccelMatrix(std_dev.segment<9>(kAccelIntrinsics)) - Eigen::Matrix3d::Identity();

  result->split_half.translation = covariance.halves_difference.segment<3>(kTranslation);
  result->split_half.rotation = covariance.halves_difference.segment<3>(kRotation);
  result->split_half.time_shift = covariance.halves_difference[kTimeShift];
  result->split_half.sigmas = covariance.halves_sigmas;

  CalibrationMatrix honest = covariance.model;
  if (options.estimate_translation)
    honest.topLeftCorner<3, 3>() = HonestLeverArm(covariance.model.topLeftCorner<3, 3>(),
                                                  covariance.feigned_lever_arm_information);
  result->observability = Spectrum(options, Enlarge(honest, covariance));
  result->status = Status::kOk;
  result->message = "every sigma is within its bound";
  if (result->observability.empty() || result->observability.front().status == Status::kOk) return;
  const Observability& worst = result->observability.front();
  result->status = worst.status;
  const bool is_degenerate = worst.status == Status::kDegenerate;
  const double bound =
      (is_degenerate ? kDegenerateFactor : 1.0) * WeakThreshold(options, worst.unit);
  result->message = (is_degenerate ? "the motion does not determine " : "sigma of ") +
                    worst.direction + (is_degenerate ? ": sigma " : " is ") +
                    InWords(worst.std, worst.unit) + " (bound: " + InWords(bound, worst.unit) +
                    "); record longer, and turn faster about at least two axes";
  for (const Observability& o : result->observability)
    if (o.status == Status::kDegenerate)
      result->unobservable.push_back(o.direction + ": turn faster, and about a second axis");
}

void WarnOfMisfit(const CalibrationCovariance& covariance, Calibration* result) {
  const auto warn = [result](const std::string& text) { result->warnings.push_back(text); };
  const auto number = [](double value, const char* format) {
    char text[32];
    std::snprintf(text, sizeof(text), format, value);
    return std::string(text);
  };
  const double correlation = Correlation(covariance);
  if (correlation > kCorrelated)
    warn("the residuals are not independent noise: sigmas are up to " +
         number(correlation, "%.1f") + " times as large as with it");
  if (result->split_half.sigmas > kDisagreement)
    warn("the two halves of the recording disagree by up to " +
         number(result->split_half.sigmas, "%.1f") + " sigma (translation " +
         InWords(result->split_half.translation.norm(), "m") + ", rotation " +
         InWords(result->split_half.rotation.norm(), "rad") + "): did the marker or the imu move?");
  const double drift = CertainHint(covariance, kClockDrift, 1);
  const double drifted = std::abs(drift) * result->gyro.duration_s;
  if (drifted > kNotableDrift)
    warn("the clocks drift by " + number(1e6 * drift, "%+.1f") + " ppm (" + InWords(drifted, "s") +
         " over the recording): set estimate_clock_drift: true");
  const double smoothing = CertainHint(covariance, kPoseSmoothing, 1);
  if (std::abs(smoothing) > kNotableSmoothing)
    warn(std::string(smoothing > 0.0 ? "the poses are smoothed more than the imu's data"
                                     : "the imu's data are smoothed more than the poses") +
         ", over " + InWords(std::sqrt(std::abs(smoothing)), "s") +
         ": set estimate_pose_smoothing: true");
  const std::pair<const char*, double> scales[] = {
      {"gyroscope", CertainHint(covariance, kGyroIntrinsics, 6)},
      {"accelerometer", CertainHint(covariance, kAccelIntrinsics, 9)}};
  for (const auto& [sensor, error] : scales)
    if (std::abs(error) > kNotableScale)
      warn(std::string("the ") + sensor + "'s scale or alignment seems off by " +
           number(100.0 * std::abs(error), "%.1f") + " %: try imu_model: scale_misalignment");
  if (std::abs(result->accel_delay) > kNotableDelay)
    warn("the accelerometer's data are " + InWords(std::abs(result->accel_delay), "s") +
         (result->accel_delay > 0.0 ? " later" : " earlier") +
         " than the gyroscope's of the same stamp: check the imu's filters and driver");
}

}  // namespace imu_pose_calib
