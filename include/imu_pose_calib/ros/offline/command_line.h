#pragma once

#include <boost/program_options.hpp>
#include <functional>
#include <string>

namespace imu_pose_calib {

/// Reads a command line into what `options` refer to. Arguments without a name, at most `count` of
/// them (-1: any number), go to the option `positional`. Names must be spelled out.
void ParseCommandLine(int argc,
                      char** argv,
                      const boost::program_options::options_description& options,
                      const char* positional,
                      int count);

/// Runs an executable and returns its exit status: 0, 2 for data that cannot be calibrated, 1 for
/// any other error. `report` is given the text of the error on one line.
int RunToExitStatus(const std::function<void()>& run,
                    const std::function<void(const std::string&)>& report);

/// The same for a command: the error goes to stderr.
int RunCommand(const std::string& name, const std::function<void()>& run);

}  // namespace imu_pose_calib
