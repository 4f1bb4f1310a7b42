// Calibrates from a recording, without a ROS master.

#include <boost/algorithm/string/join.hpp>
#include <iostream>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  OfflineRequest request;
  bool check = false, quiet = false, verbose = false, help = false, help_all = false,
       version = false;
};

/// An option that can be given again and again: `field` gets all values, with blanks between them.
auto* Repeated(std::string* field) {
  return po::value<std::vector<std::string>>()->composing()->value_name("TEXT")->notifier(
      [field](const std::vector<std::string>& values) { *field = boost::join(values, " "); });
}

/// Those that --help shows; with the others they fit a screen no more.
po::options_description DescribeCommon(CommandLine* line) {
  OfflineRequest& request = line->request;
  po::options_description options("Options");
  auto add = options.add_options();
  add("imu-topic", Repeated(&request.bag.imu_topic), "sensor_msgs/Imu; again for each further IMU");
  add("pose-topic", Value(&request.bag.pose_topic), "poses of the marker");
  add("pose-sensor", Repeated(&request.pose_sensors),
      "poses of a camera, SLAM, ...: TOPIC, FILE, or tf:PARENT:CHILD; again for each further one");
  add("body", Value(&request.bag.body), "rigid body, where poses are of several");
  add("imu-yaml", Value(&request.imu_yaml), "Kalibr's imu.yaml: noise and topic");
  add("config", Value(&request.config), "YAML of options, see config/default.yaml");
  add("start", Value(&request.bag.start_s, "S"), "seconds of the recording to skip");
  add("duration", Value(&request.bag.duration_s, "S"), "seconds to use; 0: all");
  add("output", Value(&request.output), "result; default: next to the recording");
  add("report", Value(&request.report), "figures: FILE.html or FILE.pdf");
  add("export", Value(&request.exports), "kalibr,ros2,...: files for other programs");
  add("trajectory", Value(&request.trajectory.path), "ground truth: .tum, .csv, .bag, folder");
  add("check", po::bool_switch(&line->check), "judge the recording without calibrating");
  add("verbose", po::bool_switch(&line->verbose), "print all of the result");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  add("help-all", po::bool_switch(&line->help_all), "print every option");
  add("version", po::bool_switch(&line->version), "print the version");
  return options;
}

po::options_description DescribeOthers(OfflineRequest* given) {
  OfflineRequest& request = *given;
  po::options_description options("Other options");
  auto add = options.add_options();
  add("gyro-topic", Repeated(&request.bag.gyro_topic),
      "gyroscope of a split IMU: sensor_msgs/Imu or geometry_msgs/Vector3Stamped");
  add("accel-topic", Repeated(&request.bag.accel_topic), "accelerometer of a split IMU");
  add("tf-parent", Value(&request.bag.tf_parent), "poses from tf: the fixed frame");
  add("tf-child", Value(&request.bag.tf_child), "poses from tf: the marker");
  add("poses", Value(&request.text.poses),
      "text file of the poses, instead of those of a bag: CSV, TUM, export of Motive or Vicon");
  add("imu", Repeated(&request.text.imu), "text file of the IMU; again for each further one");
  add("gyro", Repeated(&request.text.gyro), "text file of the gyroscope of a split IMU");
  add("accel", Repeated(&request.text.accel), "text file of the accelerometer of a split IMU");
  add("method", Value(&request.method), "joint (default) or gp");
  add("solver", Value(&request.solver), "of method joint: windows (default) or ceres");
  add("trajectory-format", Value(&request.trajectory.format),
      "tum, ov_eval, euroc, asl or bag; default: by the suffix");
  add("trajectory-frame", Value(&request.trajectory.frame, "NAME"),
      "pose sensor whose trajectory it is, sensor0 or its frame; default: the IMUs");
  add("trajectory-rate", Value(&request.trajectory.rate_hz, "HZ"),
      "states per second; default: at the samples of the IMU");
  add("trajectory-clock", Value(&request.trajectory.clock),
      "clock of its stamps: imu (default) or poses");
  add("trajectory-gaps", Value(&request.trajectory.max_gap_s, "S"),
      "longest gap of the poses that the IMU bridges (default 2); others are left out");
  add("record-time", po::bool_switch(&request.bag.record_time),
      "times of recording instead of the header stamps");
  add("marker-frame", Value(&request.marker_frame), "name of the marker frame in the result");
  add("imu-frame", Repeated(&request.imu_frame),
      "name of the imu frame in the result; again for each further IMU");
  add("one-recording", po::bool_switch(&request.one_recording),
      "all bags are one recording, also those that do not continue each other");
  return options;
}

void PrintHelp(const std::vector<po::options_description>& options) {
  std::cout << "Usage: calibrate_bag BAG [BAG ...] [options]          .bag, .mcap, .db3, folder\n"
            << "       calibrate_bag FOLDER [options]                  ASL dataset (EuRoC)\n"
            << "       calibrate_bag --poses FILE --imu FILE [options] CSV, TUM, Motive, Vicon\n\n"
            << "Finds where an IMU sits on a tracked body, the marker: T_marker_imu (x_marker =\n"
            << "R x_imu + p), and time_shift (t_pose = t_imu + time_shift). Bags that do not\n"
            << "continue each other are sessions of the same body. Topics are found by type.\n"
            << "So for each further source of poses on the body, with or without an IMU.\n\n";
  for (const po::options_description& group : options) std::cout << group << "\n";
  std::cout << "Examples:\n"
            << "  calibrate_bag my.bag --check\n"
            << "  calibrate_bag my.bag --report my.html --export kalibr,ros2\n"
            << "  calibrate_bag rosbag2_folder --pose-topic /rigid_bodies --body drone\n"
            << "  calibrate_bag first.mcap second.mcap --imu-topic /imu0 --imu-topic /imu1\n"
            << "  calibrate_bag my.bag --pose-topic /mocap/pose --pose-sensor /camera/pose\n"
            << "  calibrate_bag imu.bag --poses take.csv --body drone --output drone.yaml\n\n"
            << "Exit status: 0 calibrated, 1 bad usage or unreadable input, 2 data that cannot\n"
            << "be calibrated.\n";
}

void Check(const CommandLine& line) {
  std::string refused;
  for (const OfflineCheck& offline : CheckOffline(line.request)) {
    if (!line.quiet) std::cout << Summary(offline.check, offline.info) << std::flush;
    if (offline.check.verdict == DataVerdict::kRecordAgain) refused = offline.check.message;
  }
  if (!refused.empty()) throw DataError(refused);
}

void Run(int argc, char** argv) {
  CommandLine line;
  const po::options_description common = DescribeCommon(&line);
  const po::options_description others = DescribeOthers(&line.request);
  po::options_description all;
  all.add(common).add(others);
  ParseCommandLine(argc, argv, all, "bag", Value(&line.request.bag.paths), -1);
  if (line.help_all) return PrintHelp({common, others});
  if (line.help) return PrintHelp({common});
  if (line.version) {
    std::cout << "imu_pose_calib " << kVersion << "\n";
    return;
  }

  if (line.check) return Check(line);
  const InterruptGuard guard;
  const Progress progress = ShowProgress(line.quiet);
  OfflineResult offline = CalibrateOffline(line.request, progress);
  const std::string failure = WriteResult(&offline, progress);
  if (!line.quiet) std::cout << Describe(offline, line.verbose) << std::flush;
  if (!failure.empty()) throw InputError(failure);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("calibrate_bag", [&] { imu_pose_calib::Run(argc, argv); });
}
