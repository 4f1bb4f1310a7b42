#include "imu_pose_calib/ros/offline/summary.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr double kCertain = 3.0;  // sigma
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

std::string Verdict(const Calibration& result) {
  switch (result.status) {
    case Status::kOk:
      return Wrap("OK: ", result.message);
    case Status::kWeak:
      return Wrap("WEAK: ", result.message);
    case Status::kDegenerate:
      return Wrap("DEGENERATE: ", result.message);
    case Status::kNotRun:
      break;
  }
  return Wrap("NOT RUN: ", result.message);
}

/// What became of the stamps; nothing when they are as recorded.
std::string Recovered(const StreamReport& report) {
  return report.stamps_recovered ? "; stamps: recovered, jitter " + Time(report.stamp_jitter_s)
                                 : "";
}

std::string Stream(const char* label, const std::string& topic, const StreamReport& report) {
  return Wrap(
      label,
      topic +
          Format(": %zu at %.1f Hz over %.1f s", report.used, report.rate_hz, report.duration_s) +
          Recovered(report) + Dropped(report));
}

std::string Data(const SessionCalibration& session, const RecordingInfo& info) {
  std::string text = Stream("  poses  ", info.pose_topic, session.poses);
  if (info.stated_pose_std) text += Stated("         ", *info.stated_pose_std);
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const ImuSession& imu = session.imus[i];
    if (!imu.is_present) continue;
    text += Stream("  gyro   ", info.imus[i].GyroSource(), imu.gyro);
    text += Stream("  accel  ", info.imus[i].AccelSource(), imu.accel);
  }
  if (!info.imu_yaml.empty()) text += Wrap("  noise  ", info.imu_yaml);
  if (session.gaps + session.jumps > 0)
    text += Format("  %zu gaps and %zu jumps in the poses leave %zu segments\n",
                   session.gaps,
                   session.jumps,
                   session.segments);
  return text;
}

std::string Data(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::string text;
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const bool is_single = result.sessions.size() == 1;
    text += is_single
                ? "\nData\n"
                : "\n" + Wrap("Data of session " + std::to_string(s + 1) + ": ", infos[s].Source());
    text += Data(result.sessions[s], infos[s]);
  }
  return text;
}

std::string List(const Eigen::Vector3d& v, const char* number) {
  const std::string text = Vector(v, number);
  return text.substr(1, text.size() - 2);
}

std::string Quaternion(const Eigen::Quaterniond& q) {
  return Format("[%.6f, %.6f, %.6f, %.6f]", q.x(), q.y(), q.z(), q.w());
}

/// Roll, pitch, yaw about the fixed axes, as tf prints them [deg].
Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  return kDegrees * Eigen::Vector3d(std::atan2(R(2, 1), R(2, 2)),
                                    std::asin(std::clamp(-R(2, 0), -1.0, 1.0)),
                                    std::atan2(R(1, 0), R(0, 0)));
}

/// Worst verdict of the directions whose name begins with `name`; "fixed" when there are none.
std::string RowVerdict(const Calibration& result, const std::string& name) {
  for (const Observability& o : result.observability)  // the worst first
    if (o.direction.compare(0, name.size(), name) == 0) return ToString(o.status);
  return "fixed";
}

std::string Row(const std::string& name,
                const std::string& value,
                const std::string& sigma,
                const std::string& verdict) {
  return Format("  %-16s %-29s %-22s %s\n",
                name.c_str(),
                value.c_str(),
                verdict == "fixed" ? "" : sigma.c_str(),
                verdict.c_str());
}

/// What a person wants to know first.
std::string Table(const Calibration& result) {
  const Vector6d sigma = result.imus[0].Std();
  std::string text = "\n" + Row("imu in marker", "value", "sigma", "verdict");
  text += Row("translation [mm]",
              List(1e3 * result.imus[0].T_MI.p, "%.3f"),
              List(1e3 * sigma.head<3>(), "%.3f"),
              RowVerdict(result, "p_MI"));
  text += Row("rpy [deg]",
              List(RollPitchYaw(result.imus[0].T_MI.q), "%.3f"),
              List(kDegrees * sigma.tail<3>(), "%.4f"),
              RowVerdict(result, "R_MI"));
  text += Row("time shift",
              Format("%.7f s", result.sessions[0].imus[0].time_shift),
              Format("%.4f ms", 1e3 * result.sessions[0].imus[0].time_shift_std),
              RowVerdict(result, "time_shift"));
  text += Row("accel delay",
              Format("%.4f ms", 1e3 * result.imus[0].accel_delay),
              Format("%.4f ms", 1e3 * result.imus[0].accel_delay_std),
              RowVerdict(result, "accel_delay"));
  if (result.sessions[0].imus[0].clock_drift_std > 0.0)
    text += Row("clock drift",
                Format("%.2f ppm", 1e6 * result.sessions[0].imus[0].clock_drift),
                Format("%.2f ppm", 1e6 * result.sessions[0].imus[0].clock_drift_std),
                "ok");
  return text;
}

/// With several IMUs: one row for each, and their transforms to the first.
std::string ImuTable(const Calibration& result, const RecordingInfo& info) {
  const auto row = [](const std::string& name, const Rigid3& T, const Vector6d& sigma) {
    return Format("  %-6s %26s %7.3f %25s %9.4f\n",
                  name.c_str(),
                  List(1e3 * T.p, "%.3f").c_str(),
                  1e3 * sigma.head<3>().maxCoeff(),
                  List(RollPitchYaw(T.q), "%.3f").c_str(),
                  kDegrees * sigma.tail<3>().maxCoeff());
  };
  const std::string units =
      Format("%26s %7s %25s %9s\n", "translation [mm]", "sigma", "rpy [deg]", "sigma");
  std::string text = "\n  in marker" + units.substr(2);
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += row("imu" + std::to_string(i), result.imus[i].T_MI, result.imus[i].Std());
  text += "  in imu0  " + units.substr(2);
  for (const BetweenImus& between : result.between_imus)
    text += row("imu" + std::to_string(between.second), between.T, between.Std());
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += Wrap("  imu" + std::to_string(i) + ": ",
                 info.imus[i].imu_frame + ", " + info.imus[i].GyroSource() +
                     Format(", accel delay %.4f +- %.4f ms",
                            1e3 * result.imus[i].accel_delay,
                            1e3 * result.imus[i].accel_delay_std));
  return text;
}

/// With several sessions or IMUs: which is which, the clocks, and what a session says alone.
std::string SessionTable(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::string text = "\n  session, what it says alone less all others\n";
  if (result.sessions.size() == 1) text = "\n";
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const SessionCalibration& session = result.sessions[s];
    if (result.sessions.size() > 1) {
      text += Wrap("  " + std::to_string(s + 1) + "  ", infos[s].Source());
      text += Format("     at most %s: %.1f sigma (chi-square %.1f of %d)\n",
                     session.agreement.worst.c_str(),
                     session.agreement.sigmas,
                     session.agreement.chi2,
                     session.agreement.dof);
    }
    for (size_t i = 0; i < session.imus.size(); ++i)
      if (session.imus[i].is_present)
        text += Format("     time shift of imu%zu  %.7f s +- %.4f ms\n",
                       i,
                       session.imus[i].time_shift,
                       1e3 * session.imus[i].time_shift_std);
  }
  return text;
}

std::string Transform(const Calibration& result) {
  const Rigid3& T = result.imus[0].T_MI;
  const Rigid3 inverse = T.Inverse();
  std::string text = "\nT_marker_imu, the imu seen from the marker: x_marker = R x_imu + p\n";
  text += "  p = " + Vector(1e3 * T.p, "%.3f") + " mm\n";
  text += "  R = " + Quaternion(T.q) + " (x, y, z, w)\n";
  text += "  sigma of p along the marker axes, of R about the imu axes\n";
  text += "T_imu_marker, its inverse: x_imu = R x_marker + p\n";
  text += "  p = " + Vector(1e3 * inverse.p, "%.3f") + " mm\n";
  text += "  R = " + Quaternion(inverse.q) + " (x, y, z, w)\n";
  return text;
}

std::string Clocks(const Calibration& result) {
  std::string text =
      "Clocks: t_pose = t_imu + time_shift      (inverse: t_imu = t_pose - time_shift)\n";
  text += "        t_pose = t_accel + time_shift - accel_delay\n";
  if (result.sessions[0].imus[0].clock_drift_std > 0.0)
    text += Format("        time_shift holds at t_imu = %.3f s and grows by clock drift\n",
                   result.sessions[0].imus[0].clock_reference);
  const double averaging = result.imus[0].accel_smoothing;
  if (std::abs(averaging) > kCertain * result.imus[0].accel_smoothing_std)
    text += Format("%s averages over %.1f ms more than the %s: accounted for\n",
                   averaging > 0.0 ? "Accelerometer" : "Gyroscope",
                   1e3 * std::sqrt(std::abs(averaging)),
                   averaging > 0.0 ? "gyroscope" : "accelerometer");
  const double smoothing = result.pose_smoothing;
  if (std::abs(smoothing) > kCertain * result.pose_smoothing_std) {
    const double root = std::sqrt(std::abs(smoothing));
    text += Format("%s smoothed over %.1f ms (sigma %.1f ms) more than the %s: accounted for\n",
                   smoothing > 0.0 ? "Poses" : "Imu",
                   1e3 * root,
                   0.5e3 * result.pose_smoothing_std / root,
                   smoothing > 0.0 ? "imu" : "poses");
  }
  const double excess = result.position_smoothing;
  if (std::abs(excess) > kCertain * result.position_smoothing_std)
    text += Format("%s of the poses averages over %.1f ms more than their %s: accounted for\n",
                   excess > 0.0 ? "Position" : "Rotation",
                   1e3 * std::sqrt(std::abs(excess)),
                   excess > 0.0 ? "rotation" : "position");
  if (std::abs(result.pose_scale - 1.0) > kCertain * result.pose_scale_std)
    text += Format("Positions are too %s by %.2f %% (sigma %.2f %%): accounted for\n",
                   result.pose_scale > 1.0 ? "large" : "small",
                   100.0 * std::abs(result.pose_scale - 1.0),
                   100.0 * result.pose_scale_std);
  return text;
}

std::string Matrix(const char* name, const Eigen::Matrix3d& M, const Eigen::Matrix3d& sigma) {
  std::string text;
  for (int row = 0; row < 3; ++row)
    text += Format("  %-12s", row == 0 ? name : "") + Vector(M.row(row), "%9.5f") + " +- " +
            Vector(sigma.row(row), "%.5f") + "\n";
  return text;
}

std::string Imu(const Calibration& result) {
  std::string text = "\nGravity and mean biases\n";
  text +=
      "  gravity    = " + Vector(result.sessions[0].g_W, "%.5f") + " m/s^2 in the world frame\n";
  text += "  gyro bias  = " + Vector(result.sessions[0].imus[0].gyro_bias, "%.6f") +
          " rad/s in the imu frame\n";
  text += "  accel bias = " + Vector(result.sessions[0].imus[0].accel_bias, "%.5f") +
          " m/s^2 in the imu frame\n";
  const ImuCalibration& imu = result.imus[0];
  if (result.imu_model != ImuModel::kCalibrated) {
    text += "\nScale and misalignment: measured = M true + bias\n";
    text += Matrix("gyro M =", imu.gyro_matrix, imu.gyro_matrix_std);
    text += Matrix("accel M =", imu.accel_matrix, imu.accel_matrix_std);
  }
  if (!imu.accel_positions_std.isZero(0.0)) {
    text += "\nSize effect: places of the accelerometer's axes in the imu frame [m]\n";
    text += Matrix(
        "axes x,y,z =", imu.accel_positions.transpose(), imu.accel_positions_std.transpose());
  }
  return text;
}

std::string Residuals(const Calibration& result) {
  const auto row = [](const char* name, double rms, double noise, const char* unit) {
    return Format("  %-9s rms %.3g %s, noise %.3g %s\n", name, rms, unit, noise, unit);
  };
  return "\nResiduals per axis, and the noise estimated from them\n" +
         row("gyro",
             result.sessions[0].imus[0].rms.gyro,
             result.sessions[0].imus[0].noise.gyro,
             "rad/s") +
         row("accel",
             result.sessions[0].imus[0].rms.accel,
             result.sessions[0].imus[0].noise.accel,
             "m/s^2") +
         row("position",
             1e3 * result.sessions[0].rms.position,
             1e3 * result.sessions[0].noise.position,
             "mm") +
         row("rotation",
             kDegrees * result.sessions[0].rms.rotation,
             kDegrees * result.sessions[0].noise.rotation,
             "deg") +
         Format("  the halves of the recording differ by up to %.1f sigma\n",
                result.split_half.sigmas);
}

std::string Warnings(const Calibration& result) {
  std::string text;
  for (const std::string& direction : result.unobservable)
    text += Wrap("  undetermined: ", direction);
  for (const std::string& warning : result.warnings) text += Wrap("  warning: ", warning);
  return text.empty() ? "" : "\n" + text;
}

std::string StaticTransform(const Rigid3& T,
                            const std::string& marker_frame,
                            const std::string& imu_frame) {
  return "\nrosrun tf2_ros static_transform_publisher \\\n" +
         Format("  %.6f %.6f %.6f %.8f %.8f %.8f %.8f \\\n",
                T.p.x(),
                T.p.y(),
                T.p.z(),
                T.q.x(),
                T.q.y(),
                T.q.z(),
                T.q.w()) +
         "  " + marker_frame + " " + imu_frame + "\n";
}

}  // namespace

std::string Summary(const Calibration& result, const std::vector<RecordingInfo>& recordings) {
  std::vector<RecordingInfo> infos;
  for (const RecordingInfo& recording : recordings) infos.push_back(WithPrintableNames(recording));
  if (!result.IsUsable()) return Verdict(result) + Data(result, infos) + Warnings(result);
  const bool is_single = result.imus.size() == 1 && result.sessions.size() == 1;
  std::string text = Verdict(result);
  text += result.imus.size() == 1 ? Table(result) : ImuTable(result, infos.front());
  if (!is_single) text += SessionTable(result, infos);
  text += Warnings(result) + Data(result, infos) + Transform(result) + Clocks(result) +
          Imu(result) + Residuals(result);
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += StaticTransform(result.imus[i].T_MI, infos[0].marker_frame, infos[0].imus[i].imu_frame);
  return text;
}

std::string WrittenTo(const std::vector<std::string>& paths) {
  std::string text;
  for (const std::string& path : paths)
    text += (text.empty() ? "\nWritten to " : "           ") + Printable(path) + "\n";
  return text;
}

}  // namespace imu_pose_calib
