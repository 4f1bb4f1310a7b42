// Writes a result as the files of other programs.

#include <boost/algorithm/string/join.hpp>
#include <iostream>
#include <string>

#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"

namespace imu_pose_calib {
namespace {

void Run(int argc, char** argv) {
  std::string result, exports, output_dir, body_imu, chain, chain_output;
  size_t imu = 0;
  ExportChoice choice;
  bool is_quiet = false;
  boost::program_options::options_description options("Options");
  auto add = options.add_options();
  add("export", Value(&exports, "LIST"), "programs, separated by commas; all: every one");
  add("output-dir", Value(&output_dir, "DIR"),
      "folder for the files, made when missing; default: that of the result");
  add("body-imu", Value(&body_imu, "\"QX QY QZ QW\""),
      "px4: from imu axes to the body's forward, right, down; default: they are the same");
  const auto set_sensor = [&choice](size_t place) { choice.pose_sensor = place; };
  add("pose-sensor", boost::program_options::value<size_t>()->value_name("N")->notifier(set_sensor),
      "which of several pose sensors plays camera or lidar, from 0; default: the first usable one");
  add("chain", Value(&chain, "CAMCHAIN"),
      "Kalibr's camchain-imucam.yaml, for --chain-output, with or without --export");
  add("chain-output", Value(&chain_output, "PREFIX"),
      "write marker -> imu (result) -> cameras (chain): PREFIX.urdf, PREFIX.tf.launch");
  add("imu", ValueOrDefault(&imu, "N"), "which of several imus the chain is of, from 0");
  add("quiet", boost::program_options::bool_switch(&is_quiet), "print errors only");
  const std::string known = boost::join(ExportNames(), ", ");
  const std::string usage =
      "Usage: export_calibration RESULT.yaml --export LIST [options]\n"
      "       export_calibration RESULT.yaml --chain CAMCHAIN.yaml --chain-output PREFIX\n\n"
      "Writes a result of calibrate_bag as files of " +
      known + ".\n\n";
  if (!ParseOrHelp(argc, argv, usage, options,
                   "\nExit status: 0 written, 1 bad usage or unreadable input.\n",
                   Unnamed{"result", Value(&result)}))
    return;
  if (result.empty()) throw InputError("give the result to export; see export_calibration --help");
  const std::vector<std::string> names = ParseExports(exports);
  if (chain.empty() != chain_output.empty())
    throw InputError("--chain and --chain-output go together");
  if (names.empty() && chain.empty()) throw InputError("--export must name " + known);
  if (!body_imu.empty()) choice.q_body_imu = ParseQuaternion("--body-imu", body_imu);
  const StoredResult stored = LoadResult(result);
  const InterruptGuard guard;
  OutputFiles outputs;
  outputs.Keep("result", result);
  outputs.Keep("chain", chain);
  std::vector<std::string> paths = WriteExports(stored, names, &outputs, output_dir, choice);
  if (!chain.empty())
    for (const auto& [ending, text] : ExportChain(stored, imu, chain)) {
      paths.push_back(chain_output + "." + ending);
      outputs.Write(paths.back(), text);
    }
  outputs.Commit();
  for (const std::string& path : paths)
    if (!is_quiet) std::cout << "Written to " << path << "\n";
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("export_calibration", [&] { imu_pose_calib::Run(argc, argv); });
}
