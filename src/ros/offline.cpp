#include "imu_pose_calib/ros/offline.h"

#include <algorithm>
#include <filesystem>
#include <iostream>
#include <iterator>
#include <sstream>
#include <system_error>

#include "imu_pose_calib/ros/conversions.h"
#include "imu_pose_calib/ros/imu_yaml.h"
#include "imu_pose_calib/ros/result_yaml.h"
#include "imu_pose_calib/ros/ros_options.h"

namespace imu_pose_calib {
namespace {

std::string OutputPath(const OfflineRequest& request) {
  if (!request.output.empty()) return request.output;
  const std::string& bag = request.bag.paths.front();
  const bool has_extension = bag.size() > 4 && bag.substr(bag.size() - 4) == ".bag";
  return (has_extension ? bag.substr(0, bag.size() - 4) : bag) + ".calibration.yaml";
}

CalibrationOptions Options(const OfflineRequest& request) {
  CalibrationOptions options;
  if (!request.config.empty()) options = LoadOptions(request.config);
  if (!request.imu_yaml.empty()) LoadImuYaml(request.imu_yaml).CopyNoise(&options);
  if (!request.method.empty()) options.method = ParseMethod(request.method);
  return options;
}

void CheckOutput(const std::string& output, const std::vector<std::string>& bags) {
  std::error_code ignored;
  for (const std::string& bag : bags)
    if (std::filesystem::equivalent(output, bag, ignored))
      throw InputError("output '" + output + "' is the bag itself");
}

Recording ReadRecording(const OfflineRequest& request) {
  BagRequest bag = request.bag;
  if (!request.imu_yaml.empty()) bag.usual_imu_topic = LoadImuYaml(request.imu_yaml).rostopic;
  Recording recording = ReadBag(bag);
  RecordingInfo& info = recording.info;
  info.marker_frame = FrameName(request.marker_frame, info.marker_frame);
  info.imu_frame = FrameName(request.imu_frame, info.imu_frame);
  if (info.marker_frame == info.imu_frame)
    throw InputError("marker_frame and imu_frame are both '" + info.imu_frame +
                     "', which leaves no transform between them; give one of them another name");
  return recording;
}

}  // namespace

OfflineResult CalibrateOffline(const OfflineRequest& request) {
  if (request.bag.paths.empty()) throw InputError("no bag is given");
  OfflineResult offline;
  offline.output = OutputPath(request);
  CheckOutput(offline.output, request.bag.paths);
  RemoveOldResult(offline.output);

  const CalibrationOptions options = Options(request);
  const Recording recording = ReadRecording(request);
  offline.info = recording.info;

  offline.result = Calibrate(options, recording.data);
  if (!offline.result.IsUsable()) throw DataError(offline.result.message);
  offline.yaml = ToYaml(offline.result, offline.info, options);
  return offline;
}

std::vector<std::string> SplitBags(const std::string& text) {
  if (std::filesystem::exists(text)) return {text};
  std::istringstream words(text);
  return {std::istream_iterator<std::string>(words), {}};
}

void WriteResult(const OfflineResult& offline) {
  try {
    WriteFile(offline.output, offline.yaml);
  } catch (const InputError&) {
    std::cout << offline.yaml << std::flush;
    throw;
  }
}

int ExitStatus(const std::exception& error) {
  return dynamic_cast<const DataError*>(&error) != nullptr ? 2 : 1;
}

std::string OneLine(const std::exception& error) {
  std::string text = error.what();
  std::replace(text.begin(), text.end(), '\n', ' ');
  return text;
}

}  // namespace imu_pose_calib
