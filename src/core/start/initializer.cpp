#include "imu_pose_calib/core/start/initializer.h"

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <limits>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/peak.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/start/rate_alignment.h"

namespace imu_pose_calib {
namespace {

constexpr double kFlipFactor = 25.0;       // its mean square residual over that of the others
constexpr double kMinAgreement = 0.6;      // of the motion, on one rotation
constexpr double kUnitBound = 5.0;         // scale of the positions, either way
constexpr double kLeastExplained = 0.3;    // by positions in another unit
constexpr double kDelaySearch = 0.1;       // [s] to either side
constexpr double kDelayResolution = 1e-3;  // [s] within which the fit is a parabola
constexpr double kAccelBiasPrior = 1.0;    // [m/s^2] keeps bias and gravity apart at small turns

void CheckUnit(const RateAlignment& best) {
  if (best.scale > 0.5 && best.scale < 2.0) return;
  const bool is_degrees = best.scale > 40.0 && best.scale < 80.0;
  Throw<OptionNeeded>("gyroscope: its rates are ", best.scale,
                      " times the marker's (bound: 0.5 to 2); ",
                      is_degrees ? "it looks like deg/s: set gyro_unit: 0.0174532925"
                                 : "set gyro_unit, the unit of the gyroscope in rad/s");
}

/// Time shifts of an IMU that the correlation of the turn rates proposes; a guess is of the first.
std::vector<double> CandidateShifts(const CalibrationOptions& options,
                                    const PoseTrajectory& trajectory, const ConditionedData& data,
                                    size_t imu) {
  const ConditionedImu& samples = data.imus[imu];
  std::optional<double> guess;
  // t_pose - t_imu of absolute stamps, here of relative ones.
  if (options.initial_time_shift && imu == 0)
    guess = *options.initial_time_shift -
            1e-9 * static_cast<double>(data.pose_epoch_ns - samples.epoch_ns);
  if (guess && !options.estimate_time_shift) return {*guess};
  return FindTimeShifts(trajectory, samples.gyro, options.min_overlap_s, guess, kCandidates,
                        options.Threads());
}

/// Gyro samples on one segment of the trajectory.
using SegmentRates = std::vector<RatePair>;

/// Which segments turn as the gyroscope does under one alignment.
struct RotationAgreement {
  std::vector<bool> flipped;  ///< per segment
  double agreeing = 0.0;      ///< share of the gyroscope's squared rate on the others
  double explained = 0.0;     ///< share of that, where it turns
  double cost = std::numeric_limits<double>::infinity();
};

RotationAgreement Judge(const std::vector<SegmentRates>& segments, const RateAlignment& alignment) {
  const auto size = static_cast<Eigen::Index>(segments.size());
  Eigen::ArrayXd residual = Eigen::ArrayXd::Zero(size), motion = residual, count = residual;
  for (Eigen::Index k = 0; k < size; ++k) {
    for (const RatePair& pair : segments[static_cast<size_t>(k)]) {
      const Eigen::Vector3d& gyro_I = pair.gyro->value;
      residual[k] += alignment.Residual(gyro_I, pair.marker.omega_M).squaredNorm();
      motion[k] += (gyro_I - alignment.gyro_bias).squaredNorm();
      count[k] += 1.0;
    }
  }
  using Flags = Eigen::Array<bool, Eigen::Dynamic, 1>;
  const Flags is_explained = residual <= kFlipped * motion;
  const double unexplained = is_explained.select(residual, 0.0).sum();
  const double usual = unexplained / std::max(1.0, is_explained.select(count, 0.0).sum());
  // Where the marker hardly turns, noise is all there is: nothing can be said.
  const Flags agrees = is_explained || residual < kFlipFactor * usual * count;
  RotationAgreement result;
  for (Eigen::Index k = 0; k < size; ++k) result.flipped.push_back(!agrees[k]);
  result.agreeing = agrees.select(motion, 0.0).sum() / (motion.sum() + 1e-12);
  result.explained = 1.0 - unexplained / (is_explained.select(motion, 0.0).sum() + 1e-12);
  result.cost = residual.min(kFlipped * motion).sum();
  return result;
}

/// The alignment that most of the motion agrees on, of those of all segments and of each one.
RotationAgreement FindAgreement(const ConditionedData& data, const std::vector<RatePair>& all) {
  std::vector<SegmentRates> segments(data.segments.size());
  size_t k = 0;
  for (const RatePair& pair : all) {
    while (data.poses[data.segments[k].end - 1].t < pair.t) ++k;
    segments[k].push_back(pair);
  }
  RotationAgreement best = Judge(segments, AlignRates(all));
  for (const SegmentRates& pairs : segments) {
    const RotationAgreement candidate = Judge(segments, AlignRates(pairs));
    if (candidate.cost < best.cost) best = candidate;
  }
  return best;
}

/// Gravity is estimated without knowing its magnitude: another one means another unit or none.
void CheckGravity(double estimated, double expected) {
  if (estimated > 0.5 * expected && estimated < 2.0 * expected) return;
  Throw<DataError>("accelerometer: it shows a gravity of ", estimated,
                   " m/s^2 (bound: ", 0.5 * expected, " to ", 2.0 * expected, " m/s^2); ",
                   estimated < expected ? "is gravity removed? Record the raw accelerometer"
                                        : "is its unit m/s^2?");
}

/// Normal equations of the accelerometer for x = (p_MI, g_W, R_MI b_a, s) at a given delay:
///   R_MI f = ([alpha]x + [omega]x [omega]x) p_MI - R_WM^T g_W + R_MI b_a + s R_WM^T a_W,
/// where s is 1 when positions and accelerometer are in the same unit of length.
struct LeverArmEquations {
  using Matrix10d = Eigen::Matrix<double, 10, 10>;
  using Vector10d = Eigen::Matrix<double, 10, 1>;
  Matrix10d A = Matrix10d::Zero();
  Vector10d b = Vector10d::Zero();
  double sum = 0.0, count = 0.0;

  LeverArmEquations(const PoseTrajectory& trajectory, const std::vector<TimedSample>& accel,
                    const Start& start, double delay, size_t stride) {
    const Eigen::Matrix3d R_MI = start.q_MI.toRotationMatrix();
    A.diagonal().segment<3>(6).setConstant(1.0 / (kAccelBiasPrior * kAccelBiasPrior));
    for (size_t i = 0; i < accel.size(); i += stride) {
      MarkerState<double> state;
      const double t = accel[i].t + start.walk.At(accel[i].t);
      if (!trajectory.Evaluate(t + start.time_shift - delay, &state)) continue;
      const Eigen::Matrix3d R_MW = state.q_WM.conjugate().toRotationMatrix();
      const Eigen::Matrix3d W = Hat(state.omega_M);
      Eigen::Matrix<double, 3, 10> J;
      J << Hat(state.alpha_M) + W * W, -R_MW, Eigen::Matrix3d::Identity(), R_MW * state.a_W;
      const Eigen::Vector3d y = R_MI * accel[i].value;
      A += J.transpose().lazyProduct(J);
      b += J.transpose().lazyProduct(y);
      sum += y.squaredNorm();
      count += 1.0;
    }
  }

  /// (p_MI, g_W, R_MI b_a) with s = 1, and the mean squared residual.
  Eigen::Matrix<double, 9, 1> Fit(double* residual) const {
    const Eigen::Matrix<double, 9, 1> b9 = b.head<9>() - A.col(9).head<9>();
    Eigen::Matrix<double, 9, 1> x = Solve(A.topLeftCorner<9, 9>(), b9);
    *residual = count > 0.0 ? (sum - 2.0 * b[9] + A(9, 9) - b9.dot(x)) / count
                            : std::numeric_limits<double>::infinity();
    return x;
  }
};

/// Positions in another unit than metres do not fit the accelerometer.
void CheckPositionUnit(const LeverArmEquations& equations) {
  const Eigen::VectorXd x = Solve(equations.A, equations.b);
  const double scale = x[9];
  if (scale > 1.0 / kUnitBound && scale < kUnitBound) return;
  // Accelerations that are mostly errors of the poses match nothing, in no unit: s explains little
  // of what the other unknowns leave of the accelerometer.
  const double gain = scale * scale / Solve(equations.A, LeverArmEquations::Vector10d::Unit(9))(9);
  if (!(gain > kLeastExplained * (gain + equations.sum - equations.b.dot(x)))) return;
  const char* const advice =
      scale > 2e-4 && scale < 4e-3   ? "positions look like millimetres: set position_unit: 1.0e-3"
      : scale > 6e-3 && scale < 2e-2 ? "positions look like centimetres: set position_unit: 1.0e-2"
                                     : "are positions in metres and of the body that carries the "
                                       "IMU? Else set position_unit";
  Throw<OptionNeeded>(
      std::setprecision(3), "pose: the marker's acceleration has to be multiplied by ", scale,
      " to match the accelerometer (bound: ", 1.0 / kUnitBound, " to ", kUnitBound, "); ", advice);
}

}  // namespace

void RemoveFlippedSegments(const CalibrationOptions& options, PoseTrajectory* trajectory,
                           ConditionedData* data) {
  if (data->segments.size() < 2 || data->imus.empty()) return;
  const size_t first = data->FirstImu();
  const std::vector<TimedSample>& gyro = data->imus[first].gyro;
  const std::vector<double> shifts = CandidateShifts(options, *trajectory, *data, first);
  std::vector<RotationAgreement> agreements(shifts.size());
  InParallel(options.Threads(), shifts.size(), [&](size_t k) {
    agreements[k] = FindAgreement(*data, PairRates(*trajectory, gyro, Stride(gyro.size()),
                                                   [&](double t) { return t + shifts[k]; }));
  });
  RotationAgreement best;
  for (const RotationAgreement& agreement : agreements)
    if (agreement.explained * agreement.agreeing > best.explained * best.agreeing) best = agreement;
  if (best.agreeing < 0.5 * kMinAgreement || best.explained < kMinExplained) return;  // S2 says why
  if (best.agreeing < kMinAgreement)
    Throw<DataError>(
        std::setprecision(2), "pose: the marker's frame flips: only ", 100.0 * best.agreeing,
        " % of the motion turns as the gyroscope does with one rotation R_MI (bound: ",
        100.0 * kMinAgreement, " %); place the markers less symmetrically and record again");
  if (std::find(best.flipped.begin(), best.flipped.end(), true) == best.flipped.end()) return;
  std::vector<bool> leaves(data->poses.size());
  for (size_t k = 0; k < data->segments.size(); ++k)
    std::fill(leaves.begin() + static_cast<ptrdiff_t>(data->segments[k].begin),
              leaves.begin() + static_cast<ptrdiff_t>(data->segments[k].end), best.flipped[k]);
  data->pose_report.flipped += RemovePoses(leaves, data);
  *trajectory = PoseTrajectory(data->poses, data->segments, trajectory->position_hyperparameters(),
                               trajectory->rotation_hyperparameters(), options.Threads());
}

void FitLeverArm(const PoseTrajectory& trajectory, const std::vector<TimedSample>& accel,
                 double gravity_magnitude, bool estimate_delay, int threads, Start* start) {
  const size_t stride = Stride(accel.size());
  constexpr int kSteps = 5;  // to either side
  double residual = 0.0, best_delay = start->accel_delay;
  for (double reach = kDelaySearch; estimate_delay && reach > kDelayResolution; reach /= kSteps) {
    std::vector<double> residuals(2 * kSteps + 1);
    const auto delay = [reach, middle = best_delay](double k) {
      return middle + reach * (k / kSteps - 1.0);
    };
    InParallel(threads, residuals.size(), [&](size_t k) {
      LeverArmEquations(trajectory, accel, *start, delay(static_cast<double>(k)), stride)
          .Fit(&residuals[k]);
    });
    const auto least = std::min_element(residuals.begin() + 1, residuals.end() - 1);
    best_delay = delay(static_cast<double>(least - residuals.begin()) +
                       PeakOffset(-least[-1], -least[0], -least[1]));
  }
  const LeverArmEquations equations(trajectory, accel, *start, best_delay, stride);
  const Eigen::Matrix<double, 9, 1> best = equations.Fit(&residual);
  CheckPositionUnit(equations);
  start->accel_delay = best_delay;
  start->p_MI = best.head<3>();
  CheckGravity(best.segment<3>(3).norm(), gravity_magnitude);
  start->g_W = gravity_magnitude * best.segment<3>(3).normalized();
  start->accel_bias = start->q_MI.conjugate() * best.tail<3>();
}

Start Initialise(const CalibrationOptions& options, const PoseTrajectory& trajectory,
                 const ConditionedData& data, size_t imu) {
  const ConditionedImu& samples = data.imus[imu];
  const std::vector<double> shifts = CandidateShifts(options, trajectory, data, imu);
  const RateAlignment best =
      MatchRates(trajectory, samples.gyro, shifts,
                 {"poses and gyroscope", "the gyroscope's", "invert_poses", options.invert_poses},
                 options.Threads());
  CheckUnit(best);
  Start start;
  // What is estimated starts where the data put it, which no guess can better.
  start.q_MI = options.estimate_rotation ? best.q_MI : options.initial_rotation->normalized();
  start.gyro_bias = best.gyro_bias;
  start.accel_delay = options.accel_delay;
  start.time_shift = best.time_shift;
  start.clock_reference = samples.MiddleOfGyro();
  if (options.method == Method::kJoint && options.estimate_clock_walk &&
      options.estimate_time_shift)
    FitClockWalk(trajectory, samples.gyro, &start);
  FitLeverArm(trajectory, samples.accel, options.GravityMagnitude(), options.estimate_accel_delay,
              options.Threads(), &start);
  if (!options.estimate_translation) start.p_MI = *options.initial_translation;
  if (options.initial_gravity) start.g_W = *options.initial_gravity;
  return start;
}

}  // namespace imu_pose_calib
