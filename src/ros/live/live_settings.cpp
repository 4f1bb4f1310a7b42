#include "imu_pose_calib/ros/live/live_settings.h"

#include <filesystem>

#include "imu_pose_calib/ros/io/imu_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/live/parameters.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

LiveSettings ReadLiveSettings(const ros::NodeHandle& node) {
  const auto text = [&](const char* name) {
    return Param<std::string>(node, name, "", "a string");
  };
  const auto number = [&](const char* name, double* value) {
    *value = Param<double>(node, name, *value, "a number");
  };
  LiveSettings settings;
  settings.imu_topic = text("imu_topic");
  settings.gyro_topic = text("gyro_topic");
  settings.accel_topic = text("accel_topic");
  settings.pose_topic = text("pose_topic");
  const bool is_split = IsPair({"imu_topic", settings.imu_topic},
                               {"gyro_topic", settings.gyro_topic},
                               {"accel_topic", settings.accel_topic});
  settings.tf_parent = text("tf_parent");
  settings.tf_child = text("tf_child");
  IsPair({"pose_topic", settings.pose_topic},
         {"tf_parent", settings.tf_parent},
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
  number("window", &settings.live.window);
  number("min_duration", &settings.live.min_duration);
  number("solve_interval", &settings.live.solve_interval);
  number("lost_timeout", &settings.live.lost_timeout);
  number("target_rotation_std", &settings.live.target_rotation_std);
  number("target_translation_std", &settings.live.target_translation_std);
  number("target_time_shift_std", &settings.live.target_time_shift_std);
  return settings;
}

}  // namespace imu_pose_calib
