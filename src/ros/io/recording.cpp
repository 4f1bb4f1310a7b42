#include "imu_pose_calib/ros/io/recording.h"

#include <boost/algorithm/string/predicate.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <filesystem>
#include <iterator>
#include <map>
#include <set>
#include <sstream>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {

bool IsPair(const Given& one, const Given& first, const Given& second) {
  if (first.value.empty() && second.value.empty()) return false;
  const std::string pair = std::string(first.name) + " and " + second.name;
  if (first.value.empty() || second.value.empty())
    Reject(pair, " belong together: ", (first.value.empty() ? first.name : second.name),
           " is missing");
  if (!one.value.empty()) Reject("give either ", one.name, ", or ", pair, ", not all");
  return true;
}

void CheckSpan(double start_s, double duration_s) {
  if (!(start_s >= 0.0)) Reject("start = ", start_s, " s must be at least 0 s");
  if (!(duration_s >= 0.0)) Reject("duration = ", duration_s, " s must be at least 0 s (0: all)");
}

std::vector<std::string> SplitNames(const std::string& text) {
  std::istringstream words(text);
  std::vector<std::string> names{std::istream_iterator<std::string>(words), {}};
  if (names.empty()) names.emplace_back();
  return names;
}

std::vector<std::string> SplitPaths(const std::string& text) {
  if (text.empty()) return {};
  std::error_code ignored;  // also of several that are too long for one
  return std::filesystem::exists(text, ignored) ? std::vector<std::string>{text} : SplitNames(text);
}

std::pair<std::string, std::string> SplitBody(const std::string& name) {
  std::error_code ignored;
  const size_t colon = name.rfind(':');
  if (colon == std::string::npos || std::filesystem::exists(name, ignored)) return {name, ""};
  return {name.substr(0, colon), name.substr(colon + 1)};
}

bool IsPoseFile(const std::string& name) { return IsFile(SplitBody(name).first); }

std::string JoinBody(const std::string& source, const std::string& body) {
  return body.empty() ? source : source + ":" + body;
}

std::string JoinTf(const TfFrames& frames) { return "tf:" + frames.first + ":" + frames.second; }

std::optional<TfFrames> SplitTf(const std::string& name) {
  if (!boost::starts_with(name, "tf:")) return std::nullopt;
  const size_t colon = name.find(':', 3);
  if (colon == std::string::npos) Reject("pose_sensor '", name, "' must be tf:PARENT:CHILD");
  return TfFrames(FrameName(name.substr(3, colon - 3), ""), FrameName(name.substr(colon + 1), ""));
}

PoseSensorInfo NamePoseSensor(const std::string& name, const std::string& world_frame,
                              const std::string& frame) {
  const std::string topic = FrameName(SplitBody(name).first, "");
  const std::string own = FrameName(frame, boost::replace_all_copy(topic, "/", "_"));
  return {name, own, FrameName(world_frame, own + "_world")};
}

void CheckPoseSensors(const std::string& marker, const std::vector<std::string>& pose_sensors) {
  std::set<std::string> known;
  for (const std::string& name : pose_sensors) {
    if (name.empty()) continue;
    if (name == marker) Reject("pose_sensor '", name, "' is the marker; choose others");
    if (!known.insert(name).second) Reject("pose_sensor '", name, "' is given twice");
  }
}

std::string FrameName(const std::string& frame, const std::string& fallback) {
  const size_t first = frame.find_first_not_of('/');
  return first == std::string::npos ? fallback : frame.substr(first);
}

void NameFrames(const std::string& marker_frame, const std::string& imu_frame,
                RecordingInfo* info) {
  info->marker_frame = FrameName(marker_frame, info->marker_frame);
  const std::vector<std::string> names = SplitNames(imu_frame);
  std::map<std::string, int> uses;
  for (const ImuInfo& imu : info->imus) ++uses[imu.imu_frame];
  for (size_t i = 0; i < info->imus.size(); ++i) {
    std::string& frame = info->imus[i].imu_frame;
    if (uses[frame] > 1) frame = FrameName(frame, "imu") + std::to_string(i);
    if (i < names.size()) frame = FrameName(names[i], frame);
  }
  std::set<std::string> taken = {info->marker_frame};
  for (const ImuInfo& imu : info->imus) taken.insert(imu.imu_frame);
  for (size_t k = 0; k < info->pose_sensors.size(); ++k) {
    std::string& frame = info->pose_sensors[k].frame;
    if (!taken.insert(frame).second) frame += "_sensor" + std::to_string(k);
  }
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

}  // namespace imu_pose_calib
