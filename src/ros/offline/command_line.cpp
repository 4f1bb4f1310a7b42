#include "imu_pose_calib/ros/offline/command_line.h"

#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <iostream>
#include <memory>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

void ParseCommandLine(int argc, char** argv, boost::program_options::options_description options,
                      const char* name, const boost::program_options::value_semantic* unnamed,
                      int count) {
  namespace po = boost::program_options;
  po::positional_options_description positional;
  if (unnamed) {
    options.add_options()(name, unnamed);
    positional.add(name, count);
  }
  const int style = po::command_line_style::unix_style & ~po::command_line_style::allow_guessing;
  po::variables_map values;
  po::store(po::command_line_parser(argc, argv)
                .options(options)
                .positional(positional)
                .style(style)
                .run(),
            values);
  po::notify(values);
}

int RunToExitStatus(const std::function<void()>& run,
                    const std::function<void(const std::string&)>& report) {
  try {
    run();
    return 0;
  } catch (const DataError& error) {
    report(OneLine(error));
    return 2;
  } catch (const std::exception& error) {
    report(OneLine(error));
    return 1;
  }
}

int RunCommand(const std::string& name, const std::function<void()>& run) {
  return RunToExitStatus(run, [&name](const std::string& error) {
    std::cerr << name << ": error: " << error << "\n";
  });
}

Progress ShowProgress(bool quiet) {
  if (quiet || isatty(STDERR_FILENO) != 1) return {};
  struct Line {
    bool is_open = false;
    std::chrono::steady_clock::time_point begin;
    ~Line() { std::fputs(is_open ? "\n" : "", stderr); }
  };
  const auto line = std::make_shared<Line>();
  return [line](const std::string& stage, std::optional<int> iterations) {
    line->is_open = !iterations;
    if (!iterations) {
      line->begin = std::chrono::steady_clock::now();
      std::fprintf(stderr, "%-30s", stage.c_str());
      return;
    }
    const std::chrono::duration<double> time = std::chrono::steady_clock::now() - line->begin;
    std::fprintf(stderr, "%6.1f s", time.count());
    if (*iterations > 0) std::fprintf(stderr, "  %d iterations", *iterations);
    std::fputs("\n", stderr);
  };
}

}  // namespace imu_pose_calib
