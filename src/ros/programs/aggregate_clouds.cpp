// Puts the point clouds of a recording together through the calibrated trajectory.

#include <ros/ros.h>

#include <functional>
#include <iostream>
#include <sstream>
#include <string>

#include "imu_pose_calib/ros/clouds/aggregate.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/progress_lines.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  AggregateRequest request;
  bool publish = false, quiet = false, help = false;
};

po::options_description Describe(CommandLine* line) {
  AggregateRequest& request = line->request;
  OfflineRequest& recording = request.recording;
  const auto text = [](std::string* field, const char* name = "TEXT") {
    return po::value(field)->value_name(name);
  };
  const auto number = [](double* field, const char* unit) {
    std::ostringstream shown;
    shown << *field;
    return po::value(field)->value_name(unit)->default_value(*field, shown.str());
  };
  po::options_description options("Options");
  auto add = options.add_options();
  add("imu-sensor",
      text(&request.imu_sensor, "T"),
      "T_imu_sensor (x_imu = T x_sensor): \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("marker-sensor", text(&request.marker_sensor, "T"), "T_marker_sensor, instead of it");
  add("cloud-topic", text(&request.cloud_topic), "PointCloud2; default: the one in the bag");
  add("cloud-clock", text(&request.cloud_clock), "clock of its stamps: imu (default) or poses");
  add("point-time",
      po::value(&request.point_time)->value_name("UNIT")->default_value(request.point_time),
      "unit of the points' own times: s, ms, us, ns; none: they have none");
  add("output", text(&request.output, "FILE"), "map; default: BAG.map.pcd next to the bag");
  add("voxel", number(&request.voxel_m, "M"), "one point of the map for each such cube");
  add("min-range", number(&request.min_range_m, "M"), "nearer points are left out");
  add("max-range", number(&request.max_range_m, "M"), "farther points are left out");
  add("radius", number(&request.radius_m, "M"), "around a point, to judge sharpness");
  add("uncalibrated",
      text(&request.uncalibrated, "FILE"),
      "also write the map of the poses as recorded, without any calibration");
  add("guess",
      text(&request.guess, "T"),
      "its T_marker_imu; default: nearest right angles, no lever arm");
  add("publish", po::bool_switch(&line->publish), "stay as a ROS node: ~map, ~uncalibrated");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");

  po::options_description calibration("Calibration, as calibrate_bag has it");
  auto more = calibration.add_options();
  more("calibration",
       text(&recording.calibration, "FILE"),
       "result of another recording: its T_marker_imu is kept");
  more("imu-topic", text(&recording.bag.imu_topic), "sensor_msgs/Imu");
  more("pose-topic", text(&recording.bag.pose_topic), "poses of the marker");
  more("body", text(&recording.bag.body), "name of the rigid body, where a topic holds several");
  more("gyro-topic", text(&recording.bag.gyro_topic), "gyroscope of a split IMU");
  more("accel-topic", text(&recording.bag.accel_topic), "its accelerometer");
  more("tf-parent", text(&recording.bag.tf_parent), "poses from tf: the fixed frame");
  more("tf-child", text(&recording.bag.tf_child), "poses from tf: the marker");
  more("imu-frame", text(&recording.imu_frame), "name of the imu frame");
  more("imu-yaml", text(&recording.imu_yaml), "Kalibr's imu.yaml");
  more("config", text(&recording.config), "YAML of options");
  more("start", po::value(&recording.bag.start_s)->value_name("S"), "seconds to skip");
  more("duration", po::value(&recording.bag.duration_s)->value_name("S"), "to use; 0: all");
  options.add(calibration);
  return options;
}

void PrintHelp() {
  CommandLine line;
  std::cout << "Usage: aggregate_clouds BAG [BAG...] --imu-sensor T [options]\n\n"
            << "Calibrates as calibrate_bag does, and writes one map of all point clouds, each\n"
            << "point placed by the trajectory at its own time.\n\n"
            << Describe(&line)
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
  po::options_description all = Describe(&line);
  all.add_options()("bag", po::value(&line.request.recording.bag.paths));
  ParseCommandLine(argc, argv, all, "bag", -1);
  if (line.help) return PrintHelp();
  line.request.keep_uncalibrated = line.publish;
  ProgressLines progress(line.quiet);
  const AggregateOutcome outcome = AggregateClouds(line.request, std::ref(progress));
  if (!line.quiet) std::cout << outcome.text << WrittenTo(outcome.written) << std::flush;
  if (line.publish) Publish(outcome);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  ros::init(argc, argv, "aggregate_clouds");  // takes out what roslaunch adds; starts nothing
  return imu_pose_calib::RunCommand("aggregate_clouds", [&] { imu_pose_calib::Run(argc, argv); });
}
