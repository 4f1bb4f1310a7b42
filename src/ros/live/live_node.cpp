#include "imu_pose_calib/ros/live/live_node.h"

#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>

#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <mutex>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/ros/live/live_input.h"
#include "imu_pose_calib/ros/live/live_output.h"
#include "imu_pose_calib/ros/live/live_settings.h"
#include "imu_pose_calib/ros/live/live_solver.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/offline/summary.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

using Trigger = std_srvs::Trigger;

constexpr double kTickPeriod = 0.1;  // [s]
constexpr int kTicksPerStatus = 5;
constexpr int kTicksPerDiagnostics = 10;

/// A LiveCalibration with what listens, solves and publishes around it; its services and status.
///
/// One mutex guards all of it. Messages and the timer come on the thread of ros::spin(), services
/// have threads of their own, and so have solves and questions to the master; each locks first.
/// Nobody holds the mutex while waiting for a solve or for the master.
class LiveNode {
 public:
  explicit LiveNode(const ros::NodeHandle& node);
  /// A solve is running, or the master is being asked.
  bool IsBusy();

 private:
  void Tick();
  std::string Save();
  void AutoSave();
  bool OnCalibrate(Trigger::Request&, Trigger::Response& response);
  bool OnSave(Trigger::Request&, Trigger::Response& response);
  bool OnReset(Trigger::Request&, Trigger::Response& response);

  std::string Progress() const;
  void UpdateStatus();

  ros::NodeHandle node_;
  const LiveSettings settings_;

  std::mutex mutex_;  ///< of everything below
  LiveCalibration live_;
  LiveOutput output_;
  LiveInput input_;
  LiveSolver solver_;

  std::string save_error_;  ///< of an automatic save
  LiveStatus status_;
  std::string waiting_for_;  ///< which topics, and why
  int ticks_ = 0;
  ros::Time now_;  ///< of the last tick
  ros::SteadyTime clock_moved_ = ros::SteadyTime::now();
  ros::WallTimer timer_;

  ros::CallbackQueue service_queue_;
  std::vector<ros::ServiceServer> services_;
  /// One thread each: ~reset and ~save need not wait for ~calibrate. Ends before the solver, which
  /// a service may wait for.
  ros::AsyncSpinner service_spinner_{3, &service_queue_};
};

LiveNode::LiveNode(const ros::NodeHandle& node)
    : node_(node),
      settings_(ReadLiveSettings(node)),
      live_(settings_.live, settings_.calibration,
            SplitNames(settings_.gyro_topic.empty() ? settings_.imu_topic : settings_.gyro_topic)
                .size()),
      output_(node, &live_),
      input_(node, settings_, &mutex_, &live_,
             [this](const PoseSample& pose) { output_.PublishPose(pose, input_.Info()); }),
      solver_(
          &mutex_, &live_,
          [this](const SessionData& data) { return Calibrate(settings_.calibration, data); },
          [this] {
            const auto [frame, parent] = input_.OtherParent();
            output_.PublishResult(input_.Info(), frame, parent);
          }) {
  timer_ = node_.createWallTimer(ros::WallDuration(kTickPeriod),
                                 [this](const ros::WallTimerEvent&) { Tick(); });

  ros::NodeHandle services = node_;
  services.setCallbackQueue(&service_queue_);
  services_ = {services.advertiseService("calibrate", &LiveNode::OnCalibrate, this),
               services.advertiseService("save", &LiveNode::OnSave, this),
               services.advertiseService("reset", &LiveNode::OnReset, this)};
  service_spinner_.start();
}

bool LiveNode::IsBusy() {
  const std::lock_guard<std::mutex> lock(mutex_);
  return solver_.IsSolving() || input_.IsLooking();
}

/// Writes the best result and freezes it. Returns what was done.
std::string LiveNode::Save() {
  OutputFiles outputs;
  outputs.Write(settings_.output, ToYaml(*live_.result(), {input_.Info()}, settings_.calibration,
                                         {outputs.run_id()}));
  outputs.Commit();
  std::string message = "saved to " + settings_.output + "; call reset to start anew";
  live_.Freeze(message);
  save_error_.clear();
  std::cout << Summary(*live_.result(), {input_.Info()}) << std::flush;
  return message;
}

void LiveNode::AutoSave() {
  try {
    Save();
  } catch (const InputError& error) {
    save_error_ = OneLine(error);
    ROS_ERROR("%s", save_error_.c_str());
  }
  UpdateStatus();
}

// --- Services ---

/// Waits for the solve on a thread of its own, while messages come in.
bool LiveNode::OnCalibrate(Trigger::Request&, Trigger::Response& response) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    // Not the one of the last tick, which may be from before a reset.
    const LiveStatus status = live_.Status(ros::Time::now().toSec());
    if (status.phase == Phase::kSaved || status.phase == Phase::kWaiting) {
      response.message = status.phase == status_.phase ? status_.message : status.message;
      return true;
    }
  }
  const LiveSolver::Verdict verdict = solver_.Calibrate();
  response.success = verdict.success;
  response.message = verdict.message;
  return true;
}

bool LiveNode::OnSave(Trigger::Request&, Trigger::Response& response) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!live_.result()) {
    response.message = "there is no result to save; " + status_.message;
    return true;
  }
  try {
    response.message = Save();
    response.success = true;
  } catch (const InputError& error) {
    response.message = OneLine(error);
  }
  return true;
}

bool LiveNode::OnReset(Trigger::Request&, Trigger::Response& response) {
  const std::lock_guard<std::mutex> lock(mutex_);
  response.success = true;
  response.message = live_.result()
                         ? "started anew; tf keeps the last result until there is another"
                         : "started anew";
  live_.Reset("", ros::Time::now().toSec());
  input_.ForgetAfterReset();
  save_error_.clear();
  return true;
}

// --- Status ---

void LiveNode::Tick() {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (live_.WantsSolve()) solver_.Start();
  const Phase last_phase = status_.phase;
  UpdateStatus();
  if (status_.phase == Phase::kConverged && settings_.auto_save && save_error_.empty()) AutoSave();
  // The first time when there has been a look at the topics.
  if (status_.phase != last_phase || ticks_ == kTicksPerStatus)
    ROS_INFO("%s: %s", ToString(status_.phase), status_.message.c_str());
  const LiveView view{status_, input_.Info(), solver_.SolveTime(), now_};
  if (ticks_ % kTicksPerStatus == 0) output_.PublishStatus(view);
  if (ticks_ % kTicksPerDiagnostics == 0) output_.PublishDiagnostics(status_);
  output_.PublishMarkers(view);
  if (ticks_ % kTicksPerStatus == 0) output_.PublishPath(view);
  ++ticks_;
}

/// "3 s of about 4 s: "
std::string LiveNode::Progress() const {
  const double seconds = solver_.SolveTime(), last = solver_.last_solve_time();
  return last > 0.0 ? Format("%.0f s of about %.0f s: ", seconds, last)
                    : Format("%.0f s so far: ", seconds);
}

void LiveNode::UpdateStatus() {
  const ros::Time now = ros::Time::now();
  if (now != now_) clock_moved_ = ros::SteadyTime::now();
  now_ = now;
  status_ = live_.Status(now.toSec());
  if (status_.phase == Phase::kSolving) status_.message = Progress() + status_.message;
  if (const auto other = input_.OtherParent(); live_.result() && !other.parent.empty())
    status_.message +=
        "; tf has another parent of " + other.imu_frame + ", " + other.parent + ": set imu_frame";
  if (!save_error_.empty()) status_.message += "; " + save_error_;
  if (const std::string dropped = input_.Dropped(); !dropped.empty())
    status_.message += "; " + dropped;
  if (status_.phase == Phase::kWaiting) {
    if (ticks_ % kTicksPerStatus == 0) waiting_for_ = input_.Look();
    if (!waiting_for_.empty()) status_.message = waiting_for_;
  } else {
    waiting_for_.clear();
  }
  if ((ros::SteadyTime::now() - clock_moved_).toSec() > 1.0)
    status_.message +=
        now.isZero() ? "; use_sim_time is set, but there is no /clock" : "; /clock stands still";
}

}  // namespace

void RunLive(const ros::NodeHandle& node) {
  LiveNode live(node);
  ros::spin();
  if (!live.IsBusy()) return;
  // Neither can be interrupted, and nobody waits for them any more.
  ros::shutdown();
  std::fflush(nullptr);
  std::_Exit(0);
}

}  // namespace imu_pose_calib
