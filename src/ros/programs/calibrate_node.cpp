// Node imu_pose_calib: calibrates from a recording, or from topics as they arrive when none is
// given, and offers the result in the ROS graph.

#include <ros/ros.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <csignal>
#include <cstdio>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/live/live_node.h"
#include "imu_pose_calib/ros/live/parameter.h"
#include "imu_pose_calib/ros/offline/command_line.h"

namespace imu_pose_calib {
namespace {

/// The private parameters that a command line sets, "~bag" for "_bag:=FILE". ros::init() takes them
/// out.
std::vector<std::string> ParametersOf(int argc, char** argv) {
  std::vector<std::string> names;
  for (int k = 1; k < argc; ++k) {
    const std::string argument = argv[k];
    const size_t end = argument.find(":=");
    if (end != std::string::npos && argument[0] == '_' && argument[1] != '_')
      names.push_back("~" + argument.substr(1, end - 1));
  }
  return names;
}

struct Job {
  OfflineRequest request;
  bool exit = false, verbose = false;
};

Job ReadJob() {
  Job job;
  OfflineRequest& request = job.request;
  const RequestOptions known = OptionsOf(&request);
  for (const auto& options : {known.common, known.others})
    for (const auto& [name, field, text, unit] : options)
      if (std::string(name) != "report")  // here it is whether there is one
        std::visit([name = name](auto value) { *value = RosParameter(name, *value); }, field);
  job.exit = RosParameter("exit", job.exit);
  job.verbose = RosParameter("verbose", job.verbose);
  request.paths = SplitPaths(RosParameter<std::string>("bag", ""));
  if (RosParameter("report", false)) request.report = ReportPath(request);
  return job;
}

/// Reads the job and deletes those of its parameters that are from the command line: ros::init()
/// has put them on the parameter server, which keeps them, and the next run would calibrate the
/// same bag again. Parameters that somebody else has set stay: roslaunch sets them once, also for
/// the runs after a respawn, and clears those of an earlier launch (clear_params).
Job TakeJob(const std::vector<std::string>& given) {
  const std::shared_ptr<void> forget(nullptr, [&given](void*) {  // also after an error
    for (const std::string& name : given) ros::param::del(name);
  });
  return ReadJob();
}

/// Publishes the result and the static transform until the node is shut down. It joins the graph,
/// with its first handle, when there is something to offer: until then the process has no threads
/// of ROS, and an interrupt ends it at once.
void RunOffline(const Job& job, std::optional<ros::NodeHandle>* node) {
  std::signal(SIGINT, SIG_DFL);  // as later in the graph, also when a shell has it ignored
  auto guard = std::make_unique<InterruptGuard>();
  OfflineResult offline = CalibrateOffline(job.request, ShowProgress(false));
  const std::string failure = WriteResult(&offline);
  std::cout << Describe(offline, job.verbose) << std::flush;
  if (!failure.empty() && job.exit) throw InputError(failure);
  if (!failure.empty()) ROS_ERROR("%s", Printable(failure).c_str());  // the result is offered
  guard.reset();
  if (job.exit) return;

  auto publisher = node->emplace("~").advertise<CalibrationResult>("result", 1, true);
  publisher.publish(ToMsg(offline.result, offline.infos.front(), ros::Time::now()));
  tf2_ros::StaticTransformBroadcaster broadcaster;
  broadcaster.sendTransform(ToTransforms(offline.result, offline.infos.front(), ros::Time::now()));
  ros::spin();
}

void Run(const std::vector<std::string>& given, std::optional<ros::NodeHandle>* node) {
  if (ros::param::has("~bag") || ros::param::has("~poses")) {
    RunOffline(TakeJob(given), node);
  } else {
    RunLive(node->emplace("~"), ReadJob().request);
  }
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  std::setvbuf(stdout, nullptr, _IOLBF, BUFSIZ);  // also where roslaunch's output goes into a pipe
  const std::vector<std::string> given = imu_pose_calib::ParametersOf(argc, argv);
  ros::init(argc, argv, "imu_pose_calib");
  // Outlives the error message: when the last handle goes, the console is shut down.
  std::optional<ros::NodeHandle> node;
  return imu_pose_calib::RunToExitStatus(
      [&] { imu_pose_calib::Run(given, &node); },
      [](const std::string& error) { ROS_FATAL("%s", error.c_str()); });
}
