#pragma once

#include <fcntl.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <signal.h>
#include <std_srvs/Trigger.h>
#include <sys/wait.h>
#include <unistd.h>

#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "imu_pose_calib/CalibrationResult.h"
#include "imu_pose_calib/CalibrationStatus.h"
#include "test_util.h"

namespace imu_pose_calib {

using Arguments = std::vector<std::string>;

constexpr double kTimeout = 150.0;  // [s] far more than a machine that is not overloaded needs

/// Handles messages until `done` or until the time is over.
inline bool WaitFor(const std::function<bool()>& done, double timeout_s = kTimeout) {
  const ros::SteadyTime end = ros::SteadyTime::now() + ros::WallDuration(timeout_s);
  while (!done()) {
    if (ros::SteadyTime::now() > end) return false;
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.1));
  }
  return true;
}

/// A child with a process group of its own, ended with the object.
class Process {
 public:
  explicit Process(const Arguments& arguments) : pid_(fork()) {
    if (pid_ != 0) return;
    setpgid(0, 0);
    std::vector<char*> argv;
    for (const std::string& argument : arguments)
      argv.push_back(const_cast<char*>(argument.data()));
    argv.push_back(nullptr);
    execvp(argv[0], argv.data());
    _exit(127);
  }
  Process(const Process&) = delete;
  Process& operator=(const Process&) = delete;
  ~Process() { End(SIGINT); }

  bool IsRunning() {
    if (pid_ > 0 && waitpid(pid_, nullptr, WNOHANG) == pid_) pid_ = 0;
    return pid_ > 0;
  }
  void Send(int signal) {
    if (!IsRunning()) return;
    setpgid(pid_, pid_);  // should the child not have come that far
    kill(-pid_, signal);
  }
  void End(int signal) {
    if (!IsRunning()) return;
    Send(signal);
    waitpid(pid_, nullptr, 0);
    pid_ = 0;
  }

 private:
  pid_t pid_;
};

inline Arguments Concatenate(Arguments a, const Arguments& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

/// A live node in the namespace `name`, and what it publishes.
class Node {
 public:
  Node(const std::string& name, const Arguments& parameters)
      : prefix_("/" + name + "/imu_pose_calib/"),
        command_(
            Concatenate({IMU_POSE_CALIB_BIN_DIR "/calibrate_node", "__ns:=/" + name}, parameters)) {
    Listen("status", &Node::OnStatus);
    Listen("result", &Node::OnResult);
    Start();
  }

  void Start() { process_ = std::make_unique<Process>(command_); }
  void Kill() { process_->End(SIGKILL); }

  bool WaitForPhase(uint8_t phase) {
    return WaitFor([&] { return status.phase == phase; });
  }
  bool WaitForResult() {
    return WaitFor([&] { return result.has_value(); });
  }
  std_srvs::Trigger::Response Call(const std::string& service) {
    std_srvs::Trigger trigger;
    EXPECT_TRUE(ros::service::waitForService(prefix_ + service, 1000 * static_cast<int>(kTimeout)));
    EXPECT_TRUE(ros::service::call(prefix_ + service, trigger));
    return trigger.response;
  }
  template <typename Msg>
  void Listen(const std::string& topic,
              void (Node::*callback)(const boost::shared_ptr<const Msg>&)) {
    subscribers_.push_back(node_.subscribe<Msg>(prefix_ + topic, 100, callback, this));
  }
  const std::string& prefix() const { return prefix_; }

  CalibrationStatus status;
  std::optional<CalibrationResult> result;
  std::set<uint8_t> phases;        ///< seen so far
  std::set<std::string> degraded;  ///< messages of this phase

 private:
  void OnStatus(const CalibrationStatus::ConstPtr& msg) {
    status = *msg;
    phases.insert(msg->phase);
    if (msg->phase == CalibrationStatus::DEGRADED) degraded.insert(msg->message);
  }
  void OnResult(const CalibrationResult::ConstPtr& msg) { result = *msg; }

  ros::NodeHandle node_;
  const std::string prefix_;
  const Arguments command_;
  std::vector<ros::Subscriber> subscribers_;
  std::unique_ptr<Process> process_;
};

}  // namespace imu_pose_calib
