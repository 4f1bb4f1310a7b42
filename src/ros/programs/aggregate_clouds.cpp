// Puts the point clouds of a recording together through the calibrated trajectory.

#include <ros/ros.h>

#include <iostream>
#include <string>

#include "imu_pose_calib/ros/clouds/aggregate.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  AggregateRequest request;
  bool publish = false, quiet = false, help = false;
};

/// An option that is a transform, see ReadTransform(); launch files leave it empty.
auto* Transform(const char* name, std::optional<Rigid3>* T) {
  return po::value<std::string>()->value_name("T")->notifier([=](const std::string& text) {
    if (!text.empty()) *T = ReadTransform(name, text);
  });
}

po::options_description Describe(CommandLine* line) {
  AggregateRequest& request = line->request;
  OfflineRequest& recording = request.recording;
  po::options_description options("Options");
  auto add = options.add_options();
  add("imu-sensor", Transform("imu_sensor", &request.sensor.T_IS),
      "T_imu_sensor (x_imu = T x_sensor): \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("marker-sensor", Transform("marker_sensor", &request.sensor.T_MS),
      "T_marker_sensor, instead of it");
  add("cloud-topic", Value(&request.cloud_topic), "PointCloud2; default: the one in the bag");
  add("cloud-clock", Value(&request.cloud_clock), "clock of its stamps: imu (default) or poses");
  add("point-time", ValueOrDefault(&request.point_time, "UNIT"),
      "unit of the points' own times: s, ms, us, ns; none: they have none");
  add("output", Value(&request.output, "FILE"), "map; default: BAG.map.pcd next to the bag");
  add("voxel", ValueOrDefault(&request.voxel_m, "M"), "one point of the map for each such cube");
  add("min-range", ValueOrDefault(&request.min_range_m, "M"), "nearer points are left out");
  add("max-range", ValueOrDefault(&request.max_range_m, "M"), "farther points are left out");
  add("radius", ValueOrDefault(&request.radius_m, "M"), "around a point, to judge sharpness");
  add("uncalibrated", Value(&request.uncalibrated, "FILE"),
      "also write the map of the poses as recorded, without any calibration");
  add("guess", Transform("guess", &request.sensor.guessed_T_MI),
      "its T_marker_imu; default: nearest right angles, no lever arm");
  add("publish", po::bool_switch(&line->publish), "stay as a ROS node: ~map, ~uncalibrated");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");

  po::options_description calibration("Calibration, as calibrate_bag has it");
  auto more = calibration.add_options();
  more("calibration", Value(&recording.calibration, "FILE"),
       "result of another recording: its T_marker_imu is kept");
  more("imu-topic", Value(&recording.bag.imu_topic), "sensor_msgs/Imu");
  more("pose-topic", Value(&recording.bag.pose_topic), "poses of the marker");
  more("body", Value(&recording.bag.body), "name of the rigid body, where a topic holds several");
  more("gyro-topic", Value(&recording.bag.gyro_topic), "gyroscope of a split IMU");
  more("accel-topic", Value(&recording.bag.accel_topic), "its accelerometer");
  more("tf-parent", Value(&recording.bag.tf_parent), "poses from tf: the fixed frame");
  more("tf-child", Value(&recording.bag.tf_child), "poses from tf: the marker");
  more("imu-frame", Value(&recording.imu_frame), "name of the imu frame");
  more("imu-yaml", Value(&recording.imu_yaml), "Kalibr's imu.yaml");
  more("config", Value(&recording.config), "YAML of options");
  more("start", Value(&recording.bag.start_s, "S"), "seconds to skip");
  more("duration", Value(&recording.bag.duration_s, "S"), "to use; 0: all");
  options.add(calibration);
  return options;
}

void PrintHelp(const po::options_description& options) {
  std::cout << "Usage: aggregate_clouds BAG [BAG...] --imu-sensor T [options]\n\n"
            << "Calibrates as calibrate_bag does, and writes one map of all point clouds, each\n"
            << "point placed by the trajectory at its own time.\n\n"
            << options
            << "\nExit status: 0 written, 1 bad usage or unreadable input, 2 data that cannot be\n"
            << "calibrated, or no cloud within the trajectory.\n";
}

/// Offers the maps until the node is shut down.
void Publish(const AggregateOutcome& outcome) {
  ros::NodeHandle node("~");
  const auto offer = [&](const char* topic, const std::vector<MapPoint>& map) {
    auto publisher = node.advertise<sensor_msgs::PointCloud2>(topic, 1, true);
    publisher.publish(ToMessage(map, outcome.world_frame));
    return publisher;
  };
  const ros::Publisher map = offer("map", outcome.map);
  const ros::Publisher uncalibrated = offer("uncalibrated", outcome.uncalibrated);
  ros::spin();
}

void Run(int argc, char** argv) {
  CommandLine line;
  const po::options_description options = Describe(&line);
  ParseCommandLine(argc, argv, options, "bag", Value(&line.request.recording.bag.paths), -1);
  if (line.help) return PrintHelp(options);
  line.request.keep_uncalibrated = line.publish;
  auto guard = std::make_unique<InterruptGuard>();
  const AggregateOutcome outcome = AggregateClouds(line.request, ShowProgress(line.quiet));
  guard.reset();
  if (!line.quiet) std::cout << outcome.text << WrittenTo(outcome.written) << std::flush;
  if (line.publish) Publish(outcome);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  ros::init(argc, argv, "aggregate_clouds");  // takes out what roslaunch adds; starts nothing
  return imu_pose_calib::RunCommand("aggregate_clouds", [&] { imu_pose_calib::Run(argc, argv); });
}
