#include "imu_pose_calib/ros/offline/command_line.h"

#include <iostream>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

void ParseCommandLine(int argc,
                      char** argv,
                      const boost::program_options::options_description& options,
                      const char* positional,
                      int count) {
  namespace po = boost::program_options;
  po::positional_options_description unnamed;
  unnamed.add(positional, count);
  const int style = po::command_line_style::unix_style & ~po::command_line_style::allow_guessing;
  po::variables_map values;
  po::store(
      po::command_line_parser(argc, argv).options(options).positional(unnamed).style(style).run(),
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

}  // namespace imu_pose_calib
