#include "imu_pose_calib/ros/offline/report_series.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/ros/io/yaml_text.h"
#include "imu_pose_calib/simulation/information.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kOverview = 6000;       // instants over the whole recording
constexpr size_t kErrorBounds = 400;     // the same, with covariance
constexpr double kGridStep = 0.005;      // [s]
constexpr double kLongestGrid = 60.0;    // [s]
constexpr double kZoom = 1.0;            // [s]
constexpr double kZoomStep = 0.002;      // [s] of what is predicted
constexpr double kCurvatureStep = 2e-3;  // [s]

template <int size>
Eigen::Matrix<double, size, 1> Nothing() {
  return Eigen::Matrix<double, size, 1>::Constant(std::numeric_limits<double>::quiet_NaN());
}

// In the order of Quantity.
constexpr const char* kNames[] = {"position", "rotation", "gyro", "accel"};

/// The series of one session that was solved.
class SolvedSession {
 public:
  SolvedSession(const ReportInput& input, size_t session,
                const std::shared_ptr<const TrajectoryCovariance>& covariance)
      : input_(input),
        s_(session),
        solution_(*input.result.solution),
        estimate_(solution_.estimate.sessions[session]),
        has_covariance_(covariance != nullptr),
        trajectory_(input.result.solution, session, covariance) {}

  int64_t PoseEpoch() const { return trajectory_.epoch_ns(); }
  int64_t ImuEpoch(size_t imu) const {
    const double apart =
        input_.result.sessions[s_].imus[imu].time_shift - estimate_.imus[imu].time_shift;
    return PoseEpoch() - std::llround(1e9 * apart);
  }
  double PoseTime(int64_t t_ns) const { return 1e-9 * static_cast<double>(t_ns - PoseEpoch()); }
  /// `delay`: 0 for the gyroscope, accel_delay for the accelerometer.
  double ImuSampleTime(size_t imu, double delay, int64_t t_ns) const {
    return estimate_.imus[imu].PoseTime(1e-9 * static_cast<double>(t_ns - ImuEpoch(imu)) - delay);
  }

  /// Residuals of the sensors of the session, and what is said of them.
  YAML::Node WriteResiduals(const std::string& prefix) const {
    YAML::Node sensors(YAML::NodeType::Sequence);
    for (size_t k = 0; k < solution_.residuals.size(); ++k) {
      const SensorResiduals& found = solution_.residuals[k];
      if (found.session != s_) continue;
      const std::string quantity = kNames[static_cast<size_t>(found.quantity)];
      const bool is_of_imu =
          found.quantity == Quantity::kGyro || found.quantity == Quantity::kAccel;
      const std::string file =
          prefix + (is_of_imu ? "_i" + std::to_string(found.imu) : "") + "_" + quantity;
      NumpyTable<double> t(1);
      NumpyTable<float> rows(4);
      for (size_t i = 0; i < found.t.size(); ++i) {
        t.AddRow(found.t[i]);
        rows.AddRow(found.residual[i], found.weight[i]);
      }
      t.Write(file + "_residual_t.npy");
      rows.Write(file + "_residual.npy");
      YAML::Node node;
      node["quantity"] = quantity;
      node["imu"] = found.imu;
      node["noise"] = YamlValue(found.noise);
      node["rms"] = YamlValue(solution_.statistics[k].rms);
      node["rate_hz"] = YamlValue(solution_.models[k].rate_hz);
      sensors.push_back(node);
    }
    return sensors;
  }

  /// Motion over the whole session, and what each IMU measured and should have; the excitation.
  YAML::Node WriteMotion(const std::string& prefix) const {
    const double begin = PoseTime(input_.sessions[s_].poses.front().t_ns);
    const double end = PoseTime(input_.sessions[s_].poses.back().t_ns);
    const double step = (end - begin) / static_cast<double>(kOverview);
    NumpyTable<double> motion(7);
    Vector6d sum = Vector6d::Zero(), sum2 = sum;  // of turning and moving
    double count = 0.0;
    for (size_t k = 0; k < kOverview; ++k) {
      const double t = begin + (static_cast<double>(k) + 0.5) * step;
      const auto state = trajectory_.Marker(t);
      if (!state) {
        motion.AddRow(t, Nothing<6>());
        continue;
      }
      motion.AddRow(t, state->p_WB,
                    Eigen::Vector3d(trajectory_.Imu(estimate_.FirstImu(), t)->p_WB));
      const Vector6d now = (Vector6d() << state->omega_B, state->a_W).finished();
      sum += now;
      sum2 += now.cwiseAbs2();
      count += 1.0;
    }
    motion.Write(prefix + "_motion.npy");
    const Vector6d rms = (sum2 / count - (sum / count).cwiseAbs2()).cwiseMax(0.0).cwiseSqrt();
    YAML::Node excitation;
    excitation["turns"] = YamlList(rms.head<3>());
    excitation["moves"] = YamlList(rms.tail<3>());
    return excitation;
  }

  /// Sigmas of the trajectory of the marker over time: position in W [m], rotation about the
  /// marker's axes [rad].
  void WriteErrorBounds(const std::string& prefix) const {
    const double begin = PoseTime(input_.sessions[s_].poses.front().t_ns);
    const double end = PoseTime(input_.sessions[s_].poses.back().t_ns);
    NumpyTable<double> table(7);
    for (size_t k = 0; has_covariance_ && k < kErrorBounds; ++k) {
      const double t = begin + (static_cast<double>(k) + 0.5) / static_cast<double>(kErrorBounds) *
                                   (end - begin);
      const auto covariance = trajectory_.MarkerCovariance(t);
      Vector6d sigma = Nothing<6>();
      if (covariance)
        sigma << covariance->diagonal().segment<3>(3), covariance->diagonal().head<3>();
      table.AddRow(t, Vector6d(sigma.cwiseSqrt()));
    }
    table.Write(prefix + "_error_bounds.npy");
  }

  /// All of one IMU.
  void WriteImu(const std::string& prefix, size_t imu, const ImuData& recorded) const {
    const auto measured = [&](const std::string& file, const std::vector<ImuSample>& samples,
                              double unit, double delay) {
      WriteTimes(file + "_t.npy", samples,
                 [&](int64_t t_ns) { return ImuSampleTime(imu, delay, t_ns); });
      WriteValues(file + ".npy", samples, unit);
    };
    const double accel_delay = solution_.estimate.imus[imu].accel_delay;
    measured(prefix + "_gyro", recorded.gyro, input_.options.gyro_unit, 0.0);
    measured(prefix + "_accel", recorded.accel, input_.options.accel_unit, accel_delay);
    WritePredictions(prefix, imu);
    WriteGrid(prefix, imu, recorded);
    WriteBiases(prefix, imu);
    const auto [begin, end] = Covered(imu);
    const InformationGrowth growth =
        GrowInformation(input_.result, s_, imu, trajectory_, begin, end);
    NumpyTable<double> table(9);
    for (size_t k = 0; k < growth.share.size(); ++k) table.AddRow(growth.share[k], growth.std[k]);
    table.Write(prefix + "_growth.npy");
  }

 private:
  static Eigen::Vector3d Bias(const BiasKnots& knots, double t) {
    const auto [k, u] = knots.Locate(t);
    return (1.0 - u) * knots.values[k] + u * knots.values[k + 1];
  }

  /// f_M at p_MI of doc/math.md Eq. (2) [m/s^2].
  std::optional<Eigen::Vector3d> SpecificForceAt(size_t imu, double t) const {
    const auto state = trajectory_.Marker(t);
    if (!state) return std::nullopt;
    const Eigen::Vector3d& p_MI = solution_.estimate.imus[imu].p_MI;
    return Eigen::Vector3d(
        state->q_WB.conjugate() * (state->a_W / solution_.estimate.pose_scale - estimate_.g_W) +
        state->alpha_B.cross(p_MI) + state->omega_B.cross(state->omega_B.cross(p_MI)));
  }

  /// What gyroscope and accelerometer at the estimate would measure; nothing in gaps.
  Vector6d Predict(size_t imu, double t) const {
    const auto state = trajectory_.Marker(t);
    const auto f = SpecificForceAt(imu, t);
    if (!state || !f) return Nothing<6>();
    const ImuEstimate& rig = solution_.estimate.imus[imu];
    const ImuSessionEstimate& own = estimate_.imus[imu];
    Vector6d predicted;
    predicted.head<3>() =
        GyroMatrix(rig.gyro_intrinsics) * (rig.q_MI.conjugate() * state->omega_B) +
        Bias(own.gyro_bias, own.ImuTime(t));
    // The mean over the time that the accelerometer averages longer than the gyroscope.
    const auto before = SpecificForceAt(imu, t - kCurvatureStep);
    const auto after = SpecificForceAt(imu, t + kCurvatureStep);
    Eigen::Vector3d mean = *f;
    if (before && after)
      mean +=
          0.5 * rig.accel_smoothing / std::pow(kCurvatureStep, 2) * (*before - 2.0 * *f + *after);
    const Eigen::Matrix3d R_IM = rig.q_MI.conjugate().toRotationMatrix(), W = Hat(state->omega_B);
    const Eigen::Matrix3d K = Hat(state->alpha_B) + W * W;
    const Eigen::Matrix3d arms = R_IM.transpose() * AccelPositions(rig.accel_positions);
    const Eigen::Vector3d by_size = (R_IM * K).cwiseProduct(arms.transpose()).rowwise().sum();
    predicted.tail<3>() = AccelMatrix(rig.accel_intrinsics) * (R_IM * mean + by_size) +
                          Bias(own.accel_bias, own.ImuTime(t));
    return predicted;
  }

  /// What the gyroscope's samples cover [s, pose clock].
  std::pair<double, double> Covered(size_t imu) const {
    for (const SensorResiduals& sensor : solution_.residuals)
      if (sensor.session == s_ && sensor.imu == imu && sensor.quantity == Quantity::kGyro &&
          !sensor.t.empty())
        return {sensor.t.front(), sensor.t.back()};
    return {0.0, 0.0};
  }

  /// Over the whole session, and close in the second in which it turns most.
  void WritePredictions(const std::string& prefix, size_t imu) const {
    const auto [begin, end] = Covered(imu);
    const auto write = [&](const std::string& file, double from, double step, size_t count) {
      NumpyTable<double> table(7);
      for (size_t k = 0; k < count; ++k) {
        const double t = from + step * static_cast<double>(k);
        table.AddRow(t, Predict(imu, t));
      }
      table.Write(file);
    };
    write(prefix + "_predicted.npy", begin, (end - begin) / static_cast<double>(kOverview),
          kOverview);
    constexpr double kLook = 0.05;  // [s]
    double liveliest = begin, most = -1.0;
    for (double t = begin; t + kZoom < end; t += 0.5 * kZoom) {
      std::vector<double> rates;
      for (double u = t; u < t + kZoom; u += kLook) {
        const auto state = trajectory_.Marker(u);
        if (state) rates.push_back(state->omega_B.norm());
      }
      if (rates.empty()) continue;
      const double usual = Median(std::move(rates));  // not that of a shock
      if (usual > most) liveliest = t;
      most = std::max(most, usual);
    }
    write(prefix + "_zoom.npy", liveliest, kZoomStep,
          static_cast<size_t>(std::lround(kZoom / kZoomStep)) + 1);
  }

  /// Evenly spaced rows where poses and IMU have no gap, for at most kLongestGrid: t, |omega| of
  /// the poses alone and of the gyroscope [rad/s], acceleration in W, rotation
  /// q_WM (xyzw), omega_M, alpha_M, and the accelerometer without bias and matrix, in M.
  void WriteGrid(const std::string& prefix, size_t imu, const ImuData& recorded) const {
    const PoseTrajectory& poses = *solution_.trajectories[s_];
    const auto [begin, end] = Covered(imu);
    // The longest run.
    double from = begin, to = begin, run = begin;
    for (double t = begin; t <= end && to - from < kLongestGrid; t += 0.02) {
      if (!trajectory_.Marker(t)) run = t + 0.02;
      if (t - run > to - from) {
        from = run;
        to = t;
      }
    }
    const ImuEstimate& rig = solution_.estimate.imus[imu];
    const ImuSessionEstimate& own = estimate_.imus[imu];
    const Eigen::Matrix3d gyro_inverse = GyroMatrix(rig.gyro_intrinsics).inverse();
    const Eigen::Matrix3d accel_inverse = AccelMatrix(rig.accel_intrinsics).inverse();
    size_t g = 0, a = 0;
    const auto interpolate = [&](const std::vector<ImuSample>& samples, double delay, double t,
                                 size_t* next) -> Eigen::Vector3d {
      const auto time = [&](size_t k) { return ImuSampleTime(imu, delay, samples[k].t_ns); };
      while (*next < samples.size() && !(time(*next) > t)) ++*next;
      if (*next == 0 || *next == samples.size()) return Nothing<3>();
      const Eigen::Vector3d &before = samples[*next - 1].value, &after = samples[*next].value;
      const double t0 = time(*next - 1), t1 = time(*next);
      return before + (t - t0) / (t1 - t0) * (after - before);
    };
    NumpyTable<double> table(19);
    for (double t = from; t < to; t += kGridStep) {
      MarkerState<double> state;
      const auto joint = trajectory_.Marker(t);
      if (!joint || !poses.Evaluate(t, &state)) break;
      const Eigen::Vector3d gyro =
          input_.options.gyro_unit * interpolate(recorded.gyro, 0.0, t, &g);
      const Eigen::Vector3d accel =
          input_.options.accel_unit * interpolate(recorded.accel, rig.accel_delay, t, &a);
      const double t_imu = own.ImuTime(t);
      table.AddRow(
          t, state.omega_M.norm(), (gyro_inverse * (gyro - Bias(own.gyro_bias, t_imu))).norm(),
          joint->a_W, joint->q_WB.coeffs(), joint->omega_B, joint->alpha_B,
          Eigen::Vector3d(rig.q_MI * (accel_inverse * (accel - Bias(own.accel_bias, t_imu)))));
    }
    table.Write(prefix + "_grid.npy");
  }

  /// Values at the knots, and their sigmas.
  void WriteBiases(const std::string& prefix, size_t imu) const {
    const ImuSessionEstimate& own = estimate_.imus[imu];
    const auto write = [&](const std::string& file, const BiasKnots& knots, Eigen::Index sensor) {
      NumpyTable<double> table(7);
      for (size_t k = 0; k < knots.t.size(); ++k) {
        const double t = own.PoseTime(knots.t[k]);
        Eigen::Vector3d sigma = Nothing<3>();
        if (has_covariance_)
          if (const auto covariance = trajectory_.BiasCovariance(imu, t))
            sigma = covariance->diagonal().segment<3>(sensor).cwiseSqrt();
        table.AddRow(t, knots.values[k], sigma);
      }
      table.Write(file);
    };
    write(prefix + "_gyro_bias.npy", own.gyro_bias, 0);
    write(prefix + "_accel_bias.npy", own.accel_bias, 3);
  }

  const ReportInput& input_;
  const size_t s_;
  const Solution& solution_;
  const SessionEstimate& estimate_;
  const bool has_covariance_;
  const SessionTrajectory trajectory_;
};

}  // namespace

YAML::Node YamlValue(double value) { return YAML::Node(YamlNumber(value)); }

YAML::Node YamlList(const Eigen::VectorXd& values) {
  YAML::Node list(YAML::NodeType::Sequence);
  for (Eigen::Index k = 0; k < values.size(); ++k) list.push_back(YamlValue(values[k]));
  return list;
}

void WriteValues(const std::string& file, const std::vector<ImuSample>& samples, double unit) {
  NumpyTable<float> values(3);
  for (const ImuSample& sample : samples) values.AddRow(Eigen::Vector3d(unit * sample.value));
  values.Write(file);
}

void WriteSolvedSession(const ReportInput& input, size_t s,
                        const std::shared_ptr<const TrajectoryCovariance>& covariance,
                        const std::string& prefix, YAML::Node* node) {
  const SessionData& recorded = input.sessions[s];
  const SolvedSession solved(input, s, covariance);
  const SessionCalibration& session = input.result.sessions[s];
  (*node)["epoch_ns"] = solved.PoseEpoch();
  (*node)["gaps"] = session.gaps;
  (*node)["jumps"] = session.jumps;
  (*node)["knot_spacing_s"] = YamlValue(session.knot_spacing_s);
  (*node)["gravity"] = YamlList(session.g_W);
  (*node)["sensors"] = solved.WriteResiduals(prefix);
  (*node)["excitation"] = solved.WriteMotion(prefix);
  solved.WriteErrorBounds(prefix);
  WriteTimes(prefix + "_poses_stamps.npy", recorded.poses,
             [&](int64_t t_ns) { return solved.PoseTime(t_ns); });
  for (size_t i = 0; i < recorded.imus.size(); ++i)
    if (session.imus[i].is_present)
      solved.WriteImu(prefix + "_i" + std::to_string(i), i, recorded.imus[i]);
}

}  // namespace imu_pose_calib
