// Calibrates from a recording, without a ROS master.

#include <iostream>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

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

void Check(const OfflineRequest& request, bool quiet) {
  std::string refused;
  for (const OfflineCheck& offline : CheckOffline(request)) {
    if (!quiet) std::cout << Summary(offline.check, offline.info) << std::flush;
    if (offline.check.verdict == DataVerdict::kRecordAgain) refused = offline.check.message;
  }
  if (!refused.empty()) throw DataError(refused);
}

void Run(int argc, char** argv) {
  OfflineRequest request;
  const RequestOptions known = OptionsOf(&request);
  bool check, verbose, quiet, help, help_all, version;
  // With the others they fit a screen no more.
  po::options_description all, common("Options"), others("Other options");
  AddRequestOptions(known.common, &common);
  AddRequestOptions(known.others, &others);
  auto add = common.add_options();
  add("check", po::bool_switch(&check), "judge the recording without calibrating");
  add("verbose", po::bool_switch(&verbose), "print all of the result");
  add("quiet", po::bool_switch(&quiet), "print errors only");
  add("help", po::bool_switch(&help), "print this text");
  add("help-all", po::bool_switch(&help_all), "print every option");
  add("version", po::bool_switch(&version), "print the version");
  all.add(common).add(others);
  ParseCommandLine(argc, argv, all, Unnamed{"bag", Value(&request.paths), -1});
  if (help_all) return PrintHelp({common, others});
  if (help) return PrintHelp({common});
  if (version) {
    std::cout << "imu_pose_calib " << kVersion << "\n";
    return;
  }

  if (check) return Check(request, quiet);
  const InterruptGuard guard;
  const Progress progress = ShowProgress(quiet);
  OfflineResult offline = CalibrateOffline(request, progress);
  const std::string failure = WriteResult(&offline, progress);
  if (!quiet) std::cout << Describe(offline, verbose) << std::flush;
  if (!failure.empty()) throw InputError(failure);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("calibrate_bag", [&] { imu_pose_calib::Run(argc, argv); });
}
