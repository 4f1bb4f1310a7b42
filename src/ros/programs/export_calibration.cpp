// Writes a result as the files of other programs.

#include <boost/algorithm/string/join.hpp>
#include <iostream>
#include <string>

#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  std::string result, exports, output_dir, body_imu;
  bool quiet = false, help = false;
};

po::options_description Describe(CommandLine* line) {
  po::options_description options("Options");
  auto add = options.add_options();
  add("export", Value(&line->exports, "LIST"), "programs, separated by commas; all: every one");
  add("output-dir", Value(&line->output_dir, "DIR"),
      "folder for the files, made when missing; default: that of the result");
  add("body-imu", Value(&line->body_imu, "\"QX QY QZ QW\""),
      "px4: from imu axes to the body's forward, right, down; default: they are the same");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  return options;
}

void PrintHelp() {
  CommandLine line;
  std::cout << "Usage: export_calibration RESULT.yaml --export LIST [options]\n\n"
            << "Writes a result of calibrate_bag as files of " << boost::join(ExportNames(), ", ")
            << ".\n\n"
            << Describe(&line) << "\nExit status: 0 written, 1 bad usage or unreadable input.\n";
}

void Run(int argc, char** argv) {
  CommandLine line;
  ParseCommandLine(argc, argv, Describe(&line), "result", Value(&line.result), 1);
  if (line.help) return PrintHelp();
  if (line.result.empty())
    throw InputError("give the result to export; see export_calibration --help");
  const std::vector<std::string> names = ParseExports(line.exports);
  if (names.empty()) throw InputError("--export must name " + boost::join(ExportNames(), ", "));
  ExportOptions options;
  if (!line.body_imu.empty()) options.q_body_imu = ParseQuaternion("--body-imu", line.body_imu);
  const StoredResult stored = LoadResult(line.result);
  const InterruptGuard guard;
  OutputFiles outputs;
  const std::vector<std::string> paths =
      WriteExports(stored, names, &outputs, line.output_dir, options);
  outputs.Commit();
  for (const std::string& path : paths)
    if (!line.quiet) std::cout << "Written to " << path << "\n";
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("export_calibration", [&] { imu_pose_calib::Run(argc, argv); });
}
