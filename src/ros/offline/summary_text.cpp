#include "imu_pose_calib/ros/offline/summary_text.h"

#include <cmath>
#include <sstream>

#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

std::string Wrap(const std::string& label, const std::string& text, size_t columns) {
  std::istringstream words(text);
  std::string wrapped, line = label, word;
  const std::string indent(label.size(), ' ');
  bool is_empty = true;
  while (words >> word) {
    if (!is_empty && line.size() + 1 + word.size() > columns) {
      wrapped += line + "\n";
      line = indent;
      is_empty = true;
    }
    line += (is_empty ? "" : " ") + word;
    is_empty = false;
  }
  return wrapped + line + "\n";
}

std::string Time(double seconds) {
  const double size = std::abs(seconds);
  if (size < 1.0) return Format("%.2f ms", 1e3 * seconds);
  if (size < 600.0) return Format("%.1f s", seconds);
  if (size < 36.0 * 3600.0) return Format("%.2f h", seconds / 3600.0);
  return Format("%.1f days", seconds / 86400.0);
}

std::string List(const Eigen::Vector3d& v, const char* number) {
  const std::string format = std::string(number) + ", " + number + ", " + number;
  return Format(format.c_str(), v.x(), v.y(), v.z());  // NOLINT
}

std::string Dropped(const StreamReport& report) {
  std::string text;
  for (const auto& [key, words, count] : kDropReasons)
    if (report.*count > 0)
      text += (text.empty() ? "" : ", ") + std::to_string(report.*count) + " " + words;
  return text;
}

RecordingInfo WithPrintableNames(RecordingInfo info) {
  std::vector<std::string*> names = {&info.bag, &info.pose_topic, &info.marker_frame,
                                     &info.imu_yaml};
  for (ImuInfo& imu : info.imus)
    names.insert(names.end(), {&imu.imu_topic, &imu.gyro_topic, &imu.accel_topic, &imu.imu_frame});
  for (PoseSensorInfo& sensor : info.pose_sensors)
    names.insert(names.end(), {&sensor.topic, &sensor.frame, &sensor.world_frame});
  for (std::string* name : names) *name = Printable(*name);
  return info;
}

std::vector<CheckedStream> CheckedStreams(const DataCheck& check, const RecordingInfo& info) {
  std::vector<CheckedStream> streams = {
      {"poses", 0, info.pose_topic, check.poses, check.poses_report, info.pose_latency}};
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    const ImuInfo& source = info.imus[i];
    streams.push_back(
        {"gyro", i, source.GyroSource(), imu.gyro, imu.gyro_report, source.gyro_latency});
    streams.push_back(
        {"accel", i, source.AccelSource(), imu.accel, imu.accel_report, source.accel_latency});
  }
  return streams;
}

}  // namespace imu_pose_calib
