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
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/live/live_node.h"
#include "imu_pose_calib/ros/live/live_settings.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/offline.h"

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

struct OfflineJob {
  OfflineRequest request;
  bool exit, verbose;
};

OfflineJob ReadJob() {
  const auto text = [](const char* name) {
    return Param<std::string>(std::string("~") + name, "", "a string");
  };
  const auto number = [](const char* name, double fallback = 0.0) {
    return Param<double>(std::string("~") + name, fallback, "a number");
  };
  const auto flag = [](const char* name) {
    return Param<bool>(std::string("~") + name, false, "true or false");
  };
  OfflineJob job;
  job.exit = flag("exit");
  job.verbose = flag("verbose");
  OfflineRequest& request = job.request;
  request.bag.paths = SplitBags(text("bag"));
  request.bag.body = text("body");
  request.bag.imu_topic = text("imu_topic");
  request.bag.pose_topic = text("pose_topic");
  request.bag.gyro_topic = text("gyro_topic");
  request.bag.accel_topic = text("accel_topic");
  request.bag.tf_parent = text("tf_parent");
  request.bag.tf_child = text("tf_child");
  request.bag.start_s = number("start");
  request.bag.duration_s = number("duration");
  request.one_recording = flag("one_recording");
  request.bag.record_time = flag("record_time");
  request.text.poses = text("poses");
  request.text.imu = text("imu");
  request.text.gyro = text("gyro");
  request.text.accel = text("accel");
  request.imu_yaml = text("imu_yaml");
  request.config = text("config");
  request.method = text("method");
  request.output = text("output");
  request.exports = text("export");
  if (flag("report")) request.report = ReportPath(request);
  request.marker_frame = text("marker_frame");
  request.imu_frame = text("imu_frame");
  request.trajectory.path = text("trajectory");
  request.trajectory.format = text("trajectory_format");
  request.trajectory.clock = text("trajectory_clock");
  request.trajectory.rate_hz = number("trajectory_rate");
  request.trajectory.max_gap_s = number("trajectory_gaps", request.trajectory.max_gap_s);
  return job;
}

/// Reads the job and deletes those of its parameters that are from the command line: ros::init()
/// has put them on the parameter server, which keeps them, and the next run would calibrate the
/// same bag again. Parameters that somebody else has set stay: roslaunch sets them once, also for
/// the runs after a respawn, and clears those of an earlier launch (clear_params).
OfflineJob TakeJob(const std::vector<std::string>& given) {
  const auto forget = [&given] {
    for (const std::string& name : given) ros::param::del(name);
  };
  try {
    OfflineJob job = ReadJob();
    forget();
    return job;
  } catch (const InputError&) {
    forget();
    throw;
  }
}

/// Publishes the result and the static transform until the node is shut down.
void Offer(const OfflineResult& offline, ros::NodeHandle* node) {
  auto publisher = node->advertise<CalibrationResult>("result", 1, true);
  publisher.publish(ToMsg(offline.result, offline.infos.front(), ros::Time::now()));

  tf2_ros::StaticTransformBroadcaster broadcaster;
  broadcaster.sendTransform(ToTransforms(offline.result, offline.infos.front(), ros::Time::now()));
  ros::spin();
}

/// The node joins the graph, with its first handle, when there is something to offer. Until then
/// the process has no threads of ROS, which could hold a lock while ReadBag() forks, and an
/// interrupt ends it at once.
void RunOffline(const OfflineJob& job, std::optional<ros::NodeHandle>* node) {
  std::signal(SIGINT, SIG_DFL);  // as later in the graph, also when a shell has it ignored
  auto guard = std::make_unique<InterruptGuard>();
  OfflineResult offline = CalibrateOffline(job.request, ShowProgress(false));
  const std::string failure = WriteResult(&offline);
  std::cout << Describe(offline, job.verbose) << std::flush;
  if (!failure.empty() && job.exit) throw InputError(failure);
  if (!failure.empty()) ROS_ERROR("%s", Printable(failure).c_str());  // the result is offered
  guard.reset();
  if (!job.exit) Offer(offline, &node->emplace("~"));
}

void Run(const std::vector<std::string>& given, std::optional<ros::NodeHandle>* node) {
  if (ros::param::has("~bag") || ros::param::has("~poses")) {
    RunOffline(TakeJob(given), node);
  } else {
    RunLive(node->emplace("~"));
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
