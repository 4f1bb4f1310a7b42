#include "imu_pose_calib/ros/offline/command_line.h"

#include <unistd.h>

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <memory>
#include <variant>

namespace imu_pose_calib {

namespace po = boost::program_options;

void AddRequestOptions(const std::vector<RequestOption>& added, po::options_description* options,
                       const std::vector<std::string>& names) {
  for (const auto& [name, field, text, unit] : added) {
    if (!names.empty() && std::count(names.begin(), names.end(), name) == 0) continue;
    const std::string dashed = boost::replace_all_copy<std::string>(name, "_", "-");
    const auto add = [&, text = text](const po::value_semantic* value) {
      options->add_options()(dashed.c_str(), value, text);
    };
    if (const auto* flag = std::get_if<bool*>(&field)) add(po::bool_switch(*flag));
    if (const auto* number = std::get_if<double*>(&field)) add(Value(*number, unit));
    if (const auto* one = std::get_if<std::string*>(&field)) add(Value(*one, unit));
    if (const auto* list = std::get_if<RequestOption::List>(&field))  // given again and again
      add(po::value<std::vector<std::string>>()->composing()->value_name(unit)->notifier(
          [list = *list](const auto& values) { *list = boost::join(values, " "); }));
  }
}

void ParseCommandLine(int argc, char** argv, po::options_description options,
                      const std::optional<Unnamed>& unnamed) {
  po::positional_options_description positional;
  if (unnamed) {
    options.add_options()(unnamed->name, unnamed->value);
    positional.add(unnamed->name, unnamed->count);
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

bool ParseOrHelp(int argc, char** argv, const std::string& usage, po::options_description options,
                 const std::string& end, const std::optional<Unnamed>& unnamed) {
  bool wants_help = false;
  options.add_options()("help", po::bool_switch(&wants_help), "print this text");
  ParseCommandLine(argc, argv, options, unnamed);
  if (wants_help) std::cout << usage << options << end;
  return !wants_help;
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
