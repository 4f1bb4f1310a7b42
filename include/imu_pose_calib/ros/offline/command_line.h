#pragma once

#include <boost/program_options.hpp>
#include <functional>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// An option that fills `field`. `unit`: what its value is called in the help.
template <typename T>
boost::program_options::typed_value<T>* Value(T* field, const char* unit = "TEXT") {
  return boost::program_options::value(field)->value_name(unit);
}

/// The same; the help shows what `field` holds by default.
template <typename T>
boost::program_options::typed_value<T>* ValueOrDefault(T* field, const char* unit) {
  std::ostringstream text;
  text << *field;
  return Value(field, unit)->default_value(*field, text.str());
}

/// Adds options that OptionsOf() has, with dashes in their names; `names`: only these.
void AddRequestOptions(const std::vector<RequestOption>& added,
                       boost::program_options::options_description* options,
                       const std::vector<std::string>& names = {});

/// Arguments without a name: at most `count` of them (-1: any number) go to the option `name`.
struct Unnamed {
  const char* name;
  const boost::program_options::value_semantic* value;
  int count = 1;
};

/// Reads a command line into what `options` refer to. Names must be spelled out.
void ParseCommandLine(int argc, char** argv, boost::program_options::options_description options,
                      const std::optional<Unnamed>& unnamed = std::nullopt);

/// The same with an option --help: prints `usage`, the options and `end`, and returns false when it
/// is given.
bool ParseOrHelp(int argc, char** argv, const std::string& usage,
                 boost::program_options::options_description options, const std::string& end,
                 const std::optional<Unnamed>& unnamed = std::nullopt);

/// Runs an executable and returns its exit status: 0, 2 for data that cannot be calibrated, 1 for
/// any other error. `report` is given the text of the error on one line.
int RunToExitStatus(const std::function<void()>& run,
                    const std::function<void(const std::string&)>& report);

/// The same for a command: the error goes to stderr.
int RunCommand(const std::string& name, const std::function<void()>& run);

/// A line on stderr for each stage of a calibration, with the time and the iterations that it took;
/// nothing when `quiet`, or when stderr is no terminal.
Progress ShowProgress(bool quiet);

}  // namespace imu_pose_calib
