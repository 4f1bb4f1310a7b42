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

struct CommandLine {
  OfflineRequest request;
  bool check = false, quiet = false, verbose = false, help = false, help_all = false,
       version = false;
};

po::options_description Describe(const std::vector<RequestOption>& common, CommandLine* line) {
  po::options_description options("Options");
  AddRequestOptions(common, &options);
  auto add = options.add_options();
  add("check", po::bool_switch(&line->check), "judge the recording without calibrating");
  add("verbose", po::bool_switch(&line->verbose), "print all of the result");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  add("help-all", po::bool_switch(&line->help_all), "print every option");
  add("version", po::bool_switch(&line->version), "print the version");
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
  const RequestOptions known = OptionsOf(&line.request);
  // With the others they fit a screen no more.
  po::options_description all, common = Describe(known.common, &line), others("Other options");
  AddRequestOptions(known.others, &others);
  all.add(common).add(others);
  ParseCommandLine(argc, argv, all, Unnamed{"bag", Value(&line.request.paths), -1});
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
