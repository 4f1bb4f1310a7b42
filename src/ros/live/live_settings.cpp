#include "imu_pose_calib/ros/live/live_settings.h"

#include <filesystem>

#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/ros_options.h"

namespace imu_pose_calib {

LiveSettings ReadLiveSettings(const ros::NodeHandle& node) {
  const auto text = [&](const char* name) {
    return Param<std::string>(node, name, "", "a string");
  };
  LiveSettings settings;
  settings.imu_topic = text("imu_topic");
  settings.gyro_topic = text("gyro_topic");
  settings.accel_topic = text("accel_topic");
  settings.pose_topic = text("pose_topic");
  const bool is_split =
      IsPair({"imu_topic", settings.imu_topic}, {"gyro_topic", settings.gyro_topic},
             {"accel_topic", settings.accel_topic});
  settings.tf_parent = text("tf_parent");
  settings.tf_child = text("tf_child");
  IsPair({"pose_topic", settings.pose_topic}, {"tf_parent", settings.tf_parent},
         {"tf_child", settings.tf_child});
  settings.marker_frame = text("marker_frame");
  settings.imu_frame = text("imu_frame");

  const size_t imus = SplitNames(is_split ? settings.gyro_topic : settings.imu_topic).size();
  const auto check_count = [imus](const char* name, const std::string& value) {
    const size_t count = SplitNames(value).size();
    if (!value.empty() && count != imus)
      throw InputError(std::string(name) + " has " + std::to_string(count) + " names for " +
                       std::to_string(imus) + " imus");
  };
  check_count("imu_frame", settings.imu_frame);
  check_count("accel_topic", settings.accel_topic);

  const std::string output = text("output");
  settings.output =
      std::filesystem::absolute(output.empty() ? "imu_pose_calib.calibration.yaml" : output);
  settings.auto_save = Param<bool>(node, "auto_save", false, "true or false");

  if (const std::string config = text("config"); !config.empty())
    settings.calibration = LoadOptions(config);
  settings.imu_yaml = text("imu_yaml");
  if (!settings.imu_yaml.empty()) {
    const ImuYaml imu = LoadImuYaml(settings.imu_yaml);
    imu.CopyNoise(&settings.calibration);
    if (settings.imu_topic.empty() && !is_split) settings.imu_topic = imu.rostopic;
  }
  if (const std::string method = text("method"); !method.empty())
    settings.calibration.method = ParseMethod(method);
  for (const LiveOptions::Field& field : LiveOptions::kFields) {
    double& value = settings.live.*field.value;
    value = Param<double>(node, field.name, value, "a number");
  }
  return settings;
}

}  // namespace imu_pose_calib
