// Compares results with each other and with a reference.

#include <iostream>
#include <string>
#include <vector>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/compare.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  CompareRequest request;
  bool quiet = false, help = false;
};

po::options_description Describe(CommandLine* line) {
  CompareRequest& request = line->request;
  po::options_description options("Options");
  auto add = options.add_options();
  add("reference",
      po::value(&request.reference)->value_name("T"),
      "T_marker_imu to compare with: \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("chain",
      po::value(&request.chain)->multitoken()->value_name("T CAMCHAIN"),
      "the same as T_marker_cam (x_marker = T x_cam), numbers or file, and Kalibr's "
      "camchain-imucam.yaml: T_marker_imu = T_marker_cam T_cam_imu");
  add("cam",
      po::value(&request.camera)->default_value(request.camera)->value_name("NAME"),
      "camera of the chain that T_marker_cam is of");
  add("reference-std",
      po::value(&request.reference_std)
          ->default_value(request.reference_std)
          ->value_name("\"MM DEG\""),
      "sigma of reference or chain, per axis");
  add("chain-output",
      po::value(&request.chain_output)->value_name("PREFIX"),
      "write marker -> imu (result) -> cameras (chain): PREFIX.urdf, PREFIX.tf.launch");
  add("imu",
      po::value(&request.imu)->default_value(request.imu)->value_name("N"),
      "which of several imus, from 0");
  add("same-clocks",
      po::bool_switch(&request.same_clocks),
      "compare the time shifts of different recordings, too");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  return options;
}

void Parse(int argc, char** argv, CommandLine* line) {
  po::options_description all = Describe(line);
  std::vector<std::string>& results = line->request.results;
  all.add_options()("result", po::value(&results));
  ParseCommandLine(argc, argv, all, "result", -1);
  // --chain takes all words that follow; those after its two are results.
  std::vector<std::string>& chain = line->request.chain;
  if (chain.size() > 2) {
    results.insert(results.end(), chain.begin() + 2, chain.end());
    chain.resize(2);
  }
}

void PrintHelp() {
  CommandLine line;
  std::cout << "Usage: compare_calibrations A.yaml B.yaml [...] [options]\n"
            << "       compare_calibrations A.yaml --reference \"x y z qx qy qz qw\"\n"
            << "       compare_calibrations A.yaml --chain T_MARKER_CAM CAMCHAIN.yaml\n\n"
            << "Differences of results of calibrate_bag in mm, deg and ms, in their sigmas, and\n"
            << "the repeatability of more than two.\n\n"
            << Describe(&line)
            << "\nExit status: 0 nothing differs by more than 5 sigma, 1 bad usage or unreadable\n"
            << "input, 2 something does.\n";
}

void Run(int argc, char** argv) {
  CommandLine line;
  Parse(argc, argv, &line);
  if (line.help) return PrintHelp();
  const CompareOutcome outcome = CompareResults(line.request);
  if (!line.quiet) {
    std::cout << outcome.text;
    for (const std::string& path : outcome.written) std::cout << "Written to " << path << "\n";
    std::cout << std::flush;
  }
  if (!outcome.agrees) throw DataError(outcome.verdict);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("compare_calibrations",
                                    [&] { imu_pose_calib::Run(argc, argv); });
}
