#include "imu_pose_calib/ros/summary.h"

#include <cstdarg>
#include <cstdio>
#include <sstream>

namespace imu_pose_calib {
namespace {

constexpr size_t kColumns = 80;
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

[[gnu::format(printf, 1, 2)]] std::string Format(const char* format, ...) {
  char buffer[512];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(buffer, sizeof(buffer), format, arguments);
  va_end(arguments);
  return buffer;
}

/// `text` in lines of at most kColumns, the first behind `label`, the others indented like it.
std::string Wrap(const std::string& label, const std::string& text) {
  std::istringstream words(text);
  std::string wrapped, line = label, word;
  const std::string indent(label.size(), ' ');
  bool is_empty = true;
  while (words >> word) {
    if (!is_empty && line.size() + 1 + word.size() > kColumns) {
      wrapped += line + "\n";
      line = indent;
      is_empty = true;
    }
    line += (is_empty ? "" : " ") + word;
    is_empty = false;
  }
  return wrapped + line + "\n";
}

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

std::string Dropped(const StreamReport& report) {
  std::string reasons;
  const auto add = [&](size_t count, const char* reason) {
    if (count > 0) reasons += (reasons.empty() ? "" : ", ") + std::to_string(count) + " " + reason;
  };
  add(report.not_finite, "not finite");
  add(report.zero_quaternion, "zero quaternion");
  add(report.reversed_stamp, "reversed stamp");
  add(report.duplicate_stamp, "duplicate stamp");
  add(report.repeated_value, "repeated value");
  add(report.outlier, "outlier");
  add(report.in_short_segment, "between gaps");
  return reasons.empty() ? "" : "; dropped " + reasons;
}

std::string Stream(const char* label, const std::string& topic, const StreamReport& report) {
  return Wrap(
      label,
      topic +
          Format(": %zu at %.1f Hz over %.1f s", report.used, report.rate_hz, report.duration_s) +
          Dropped(report));
}

std::string Data(const Calibration& result, const RecordingInfo& info) {
  const bool is_split = info.imu_topic.empty();
  std::string text = "\nData\n";
  text += Stream("  poses  ", info.pose_topic, result.poses);
  text += Stream("  gyro   ", is_split ? info.gyro_topic : info.imu_topic, result.gyro);
  text += Stream("  accel  ", is_split ? info.accel_topic : info.imu_topic, result.accel);
  if (result.gaps > 0)
    text += Format("  %zu gaps in the poses leave %zu segments\n", result.gaps, result.segments);
  return text;
}

std::string Vector(const Eigen::Vector3d& v, const char* number) {
  const std::string format = std::string("[") + number + ", " + number + ", " + number + "]";
  char buffer[128];
  std::snprintf(buffer, sizeof(buffer), format.c_str(), v.x(), v.y(), v.z());
  return buffer;
}

std::string Quaternion(const Eigen::Quaterniond& q) {
  return Format("[%.6f, %.6f, %.6f, %.6f]", q.x(), q.y(), q.z(), q.w());
}

std::string Transform(const Calibration& result) {
  const Rigid3& T = result.T_MI;
  const Rigid3 inverse = T.Inverse();
  const Vector6d std_dev = result.Std();
  std::string text = "\nT_marker_imu, the imu seen from the marker: x_marker = R x_imu + p\n";
  text += "  p = " + Vector(1e3 * T.p, "%.3f") + " mm\n";
  text += "   +- " + Vector(1e3 * std_dev.head<3>(), "%.3f") + " mm along the marker axes\n";
  text += "  R = " + Quaternion(T.q) + " (x, y, z, w)\n";
  text += "   +- " + Vector(kDegrees * std_dev.tail<3>(), "%.4f") + " deg about the imu axes\n";
  text += "\nT_imu_marker, its inverse: x_imu = R x_marker + p\n";
  text += "  p = " + Vector(1e3 * inverse.p, "%.3f") + " mm\n";
  text += "  R = " + Quaternion(inverse.q) + " (x, y, z, w)\n";
  return text;
}

std::string Clocks(const Calibration& result) {
  std::string text =
      "\nClocks: t_pose = t_imu + time_shift      (inverse: t_imu = t_pose - time_shift)\n";
  text += "        t_pose = t_accel + time_shift - accel_delay\n";
  text +=
      Format("  time_shift  = %.7f s +- %.4f ms\n", result.time_shift, 1e3 * result.time_shift_std);
  text += Format("  accel_delay = %.7f s ", result.accel_delay);
  return text + (result.accel_delay_std > 0.0 ? Format("+- %.4f ms\n", 1e3 * result.accel_delay_std)
                                              : "(fixed)\n");
}

std::string Imu(const Calibration& result) {
  std::string text = "\nGravity and mean biases\n";
  text += "  gravity    = " + Vector(result.g_W, "%.5f") + " m/s^2 in the world frame\n";
  text += "  gyro bias  = " + Vector(result.gyro_bias, "%.6f") + " rad/s in the imu frame\n";
  text += "  accel bias = " + Vector(result.accel_bias, "%.5f") + " m/s^2 in the imu frame\n";
  return text;
}

std::string Residuals(const Calibration& result) {
  const auto row = [](const char* name, double rms, double noise, const char* unit) {
    return Format("  %-9s rms %.3g %s, noise %.3g %s\n", name, rms, unit, noise, unit);
  };
  return "\nResiduals per axis, and the noise estimated from them\n" +
         row("gyro", result.rms.gyro, result.noise.gyro, "rad/s") +
         row("accel", result.rms.accel, result.noise.accel, "m/s^2") +
         row("position", 1e3 * result.rms.position, 1e3 * result.noise.position, "mm") +
         row("rotation", kDegrees * result.rms.rotation, kDegrees * result.noise.rotation, "deg");
}

std::string Warnings(const Calibration& result) {
  std::string text;
  for (const std::string& direction : result.unobservable)
    text += Wrap("  undetermined: ", direction);
  for (const std::string& warning : result.warnings) text += Wrap("  warning: ", warning);
  return text.empty() ? "" : "\n" + text;
}

std::string StaticTransform(const Calibration& result, const RecordingInfo& info) {
  if (info.marker_frame == info.imu_frame)
    return "\n" + Wrap("",
                       "No tf: the marker and the imu frame are both called '" + info.imu_frame +
                           "'; set marker_frame or imu_frame.");
  const Rigid3& T = result.T_MI;
  return "\nrosrun tf2_ros static_transform_publisher \\\n" +
         Format("  %.6f %.6f %.6f %.8f %.8f %.8f %.8f \\\n",
                T.p.x(),
                T.p.y(),
                T.p.z(),
                T.q.x(),
                T.q.y(),
                T.q.z(),
                T.q.w()) +
         "  " + info.marker_frame + " " + info.imu_frame + "\n";
}

}  // namespace

std::string Summary(const Calibration& result, const RecordingInfo& info) {
  if (!result.IsUsable()) return Verdict(result) + Data(result, info) + Warnings(result);
  return Verdict(result) + Data(result, info) + Transform(result) + Clocks(result) + Imu(result) +
         Residuals(result) + Warnings(result) + StaticTransform(result, info);
}

}  // namespace imu_pose_calib
