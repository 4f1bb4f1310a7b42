#include "imu_pose_calib/ros/offline.h"

#include <algorithm>
#include <filesystem>
#include <system_error>

#include "imu_pose_calib/ros/conversions.h"
#include "imu_pose_calib/ros/result_yaml.h"
#include "imu_pose_calib/ros/ros_options.h"

namespace imu_pose_calib {
namespace {

std::string OutputPath(const OfflineRequest& request) {
  if (!request.output.empty()) return request.output;
  const std::string& bag = request.bag.path;
  const bool has_extension = bag.size() > 4 && bag.substr(bag.size() - 4) == ".bag";
  return (has_extension ? bag.substr(0, bag.size() - 4) : bag) + ".calibration.yaml";
}

CalibrationOptions Options(const OfflineRequest& request) {
  CalibrationOptions options;
  if (!request.config.empty()) options = LoadOptions(request.config);
  if (!request.method.empty()) options.method = ParseMethod(request.method);
  return options;
}

}  // namespace

OfflineResult CalibrateOffline(const OfflineRequest& request) {
  if (request.bag.path.empty()) throw InputError("no bag is given");
  OfflineResult offline;
  offline.output = OutputPath(request);
  std::error_code ignored;
  if (std::filesystem::equivalent(offline.output, request.bag.path, ignored))
    throw InputError("output '" + offline.output + "' is the bag itself");
  RemoveOldResult(offline.output);

  const CalibrationOptions options = Options(request);
  const Recording recording = ReadBag(request.bag);
  offline.info = recording.info;
  offline.info.marker_frame = FrameName(request.marker_frame, recording.info.marker_frame);
  offline.info.imu_frame = FrameName(request.imu_frame, recording.info.imu_frame);

  offline.result = Calibrate(options, recording.data);
  if (!offline.result.IsUsable()) throw DataError(offline.result.message);
  offline.yaml = ToYaml(offline.result, offline.info, options);
  return offline;
}

OfflineCheck CheckOffline(const OfflineRequest& request) {
  const CalibrationOptions options = Options(request);
  const Recording recording = ReadBag(request.bag);
  return {CheckData(options, recording.data), recording.info};
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
