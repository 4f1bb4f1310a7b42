#include "imu_pose_calib/ros/live/live_node.h"

#include <diagnostic_updater/diagnostic_updater.h>
#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Path.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <iostream>
#include <mutex>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/live/live_input.h"
#include "imu_pose_calib/ros/live/markers.h"
#include "imu_pose_calib/ros/live/parameter.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

using std_srvs::Trigger;

constexpr double kTickPeriod = 0.1;  // [s]
constexpr int kTicksPerStatus = 5;

/// The full names of the pose sensors.
std::vector<std::string> PoseSensors(const OfflineRequest& request) {
  const BagRequest& topics = request.bag;
  std::vector<std::string> names;
  for (const std::string& name : SplitNames(request.pose_sensors)) {
    if (name.empty()) continue;
    const auto tf = SplitTf(name);
    std::string ignored;
    if (!tf && (!ros::names::validate(name, ignored) || std::filesystem::is_regular_file(name)))
      throw InputError("pose_sensor '" + name +
                       "' must be a topic or tf:PARENT:CHILD; text files go with bags");
    names.push_back(tf ? JoinTf(*tf) : ros::names::resolve(name));
  }
  std::string marker;
  if (!topics.pose_topic.empty()) marker = ros::names::resolve(topics.pose_topic);
  if (!topics.tf_parent.empty())
    marker = JoinTf({FrameName(topics.tf_parent, ""), FrameName(topics.tf_child, "")});
  CheckPoseSensors(marker, names);
  return names;
}

size_t CountImus(const BagRequest& topics) {
  return SplitNames(topics.gyro_topic.empty() ? topics.imu_topic : topics.gyro_topic).size();
}

/// The request with its defaults.
OfflineRequest Checked(OfflineRequest request) {
  BagRequest& topics = request.bag;
  const bool is_split = IsPair({"imu_topic", topics.imu_topic}, {"gyro_topic", topics.gyro_topic},
                               {"accel_topic", topics.accel_topic});
  IsPair({"pose_topic", topics.pose_topic}, {"tf_parent", topics.tf_parent},
         {"tf_child", topics.tf_child});
  topics.pose_sensors = PoseSensors(request);
  if (!request.imu_yaml.empty() && topics.imu_topic.empty() && !is_split)
    topics.imu_topic = LoadImuYaml(request.imu_yaml);
  for (const auto& [name, value] :
       {Given{"imu_frame", request.imu_frame}, Given{"accel_topic", topics.accel_topic}})
    if (const size_t count = SplitNames(value).size(), imus = CountImus(topics);
        !value.empty() && count != imus)
      throw InputError(Format("%s has %zu names for %zu imus", name, count, imus));
  request.output = std::filesystem::absolute(
      request.output.empty() ? "imu_pose_calib.calibration.yaml" : request.output);
  return request;
}

LiveOptions ReadLiveOptions() {
  LiveOptions options;
  for (const auto& [name, field] : kLiveOptions) options.*field = Parameter(name, options.*field);
  return options;
}

/// T_WI at the pose T_WM.
geometry_msgs::PoseStamped ToImuPose(const PoseSample& pose, const Rigid3& T_MI,
                                     const std::string& world_frame) {
  geometry_msgs::PoseStamped msg;
  msg.header = MakeHeader(FromNanoseconds(pose.t_ns), world_frame);
  msg.pose = ToPoseMsg(Rigid3{pose.q_WM.normalized(), pose.p_WM} * T_MI);
  return msg;
}

/// A LiveCalibration with what listens, solves and publishes around it; its services and status.
///
/// One mutex guards all of it. Messages and the timer come on the thread of ros::spin(), services
/// have threads of their own, and so have solves and questions to the master; each locks first.
/// Nobody holds the mutex while waiting for a solve or for the master.
class LiveNode {
 public:
  LiveNode(const ros::NodeHandle& node, const OfflineRequest& request)
      : node_(node),
        request_(Checked(request)),
        options_(Options(request_)),
        live_(ReadLiveOptions(), options_, CountImus(request_.bag), request_.bag.pose_sensors),
        input_(node, request_, &mutex_, &live_,
               [this](const PoseSample& pose) { PublishPose(pose); }),
        solver_(
            &mutex_, &live_,
            [this](const SessionData& data) { return imu_pose_calib::Calibrate(options_, data); },
            [this] { PublishResult(); }) {
    diagnostics_.setHardwareID("none");
    diagnostics_.add("calibration", this, &LiveNode::Diagnose);
    timer_ = node_.createWallTimer(ros::WallDuration(kTickPeriod),
                                   [this](const ros::WallTimerEvent&) { Tick(); });

    Serve("calibrate", &LiveNode::Calibrate);
    Serve("save", &LiveNode::Save);
    Serve("reset", &LiveNode::Reset);
    service_spinner_.start();
  }

  /// A solve is running, or the master is being asked.
  bool IsBusy() {
    const std::lock_guard<std::mutex> lock(mutex_);
    return live_.IsSolving() || input_.IsLooking();
  }

 private:
  using Verdict = LiveSolver::Verdict;

  // --- Services ---

  void Serve(const std::string& name, Verdict (LiveNode::*answer)()) {
    ros::NodeHandle node = node_;
    node.setCallbackQueue(&service_queue_);
    services_.push_back(node.advertiseService<Trigger::Request, Trigger::Response>(
        name, [=](Trigger::Request&, Trigger::Response& response) {
          const auto [success, message] = (this->*answer)();
          response.success = success;
          response.message = message;
          return true;
        }));
  }

  /// Waits for the solve, while messages come in.
  Verdict Calibrate() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      // Not the one of the last tick, which may be from before a reset.
      const CalibrationStatus status = live_.Status(ros::Time::now().toSec());
      if (status.phase == CalibrationStatus::SAVED || status.phase == CalibrationStatus::WAITING)
        return {false, (status.phase == status_.phase ? status_ : status).message};
    }
    return solver_.Calibrate();
  }

  Verdict Save() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!live_.result()) return {false, "there is no result to save; " + status_.message};
    return WriteResult();
  }

  Verdict Reset() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const bool has_result = live_.result().has_value();
    live_.Reset("", ros::Time::now().toSec());
    input_.ForgetAfterReset();
    save_error_.clear();
    return {true, has_result ? "started anew; tf keeps the last result until there is another"
                             : "started anew"};
  }

  /// Writes the best result and freezes it. Says what was done, or why it could not be.
  Verdict WriteResult() {
    const std::string& path = request_.output;
    try {
      OutputFiles outputs;
      outputs.Write(path, ToYaml(*live_.result(), {input_.Info()}, options_, {outputs.run_id()}));
      outputs.Commit();
    } catch (const InputError& error) {
      return {false, OneLine(error)};
    }
    const std::string message = "saved to " + path + "; call reset to start anew";
    live_.Freeze(message);
    save_error_.clear();
    std::cout << Summary(*live_.result(), {input_.Info()}) << std::flush;
    return {true, message};
  }

  // --- Status ---

  void Tick() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (live_.WantsSolve()) solver_.Start();
    const uint8_t last_phase = status_.phase;
    UpdateStatus();
    if (status_.phase == CalibrationStatus::CONVERGED && auto_save_ && save_error_.empty()) {
      if (const Verdict saved = WriteResult(); !saved.success) {
        save_error_ = saved.message;
        ROS_ERROR("%s", save_error_.c_str());
      }
      UpdateStatus();
    }
    // The first time when there has been a look at the topics.
    if (status_.phase != last_phase || ticks_ == kTicksPerStatus)
      ROS_INFO("%s: %s", status_.phase_text.c_str(), status_.message.c_str());
    if (ticks_ % kTicksPerStatus == 0) {
      status_publisher_.publish(status_);
      diagnostics_.force_update();
      PublishPath();
    }
    if (marker_publisher_.getNumSubscribers() > 0)
      marker_publisher_.publish(Draw(live_, status_, input_.Info().world_frame));
    ++ticks_;
  }

  void UpdateStatus() {
    const ros::Time now = ros::Time::now();
    const bool was_waiting = status_.phase == CalibrationStatus::WAITING;
    if (now != status_.header.stamp) clock_moved_ = ros::SteadyTime::now();
    status_ = live_.Status(now.toSec());
    status_.header.stamp = now;
    status_.solve_time = solver_.SolveTime();
    std::string& message = status_.message;
    if (status_.phase == CalibrationStatus::SOLVING) {
      const double last = solver_.last_solve_time();
      const std::string of = last > 0.0 ? Format("of about %.0f s", last) : "so far";
      message = Format("%.0f s %s: ", status_.solve_time, of.c_str()) + message;
    }
    if (live_.result())
      for (const ImuInfo& imu : input_.Info().imus)
        if (const auto* link = input_.OtherParent(imu.imu_frame))
          message += "; tf has another parent of " + imu.imu_frame + ", " + link->header.frame_id +
                     ": set imu_frame";
    if (!save_error_.empty()) message += "; " + save_error_;
    if (const std::string dropped = input_.Dropped(); !dropped.empty()) message += "; " + dropped;
    const bool is_waiting = status_.phase == CalibrationStatus::WAITING;
    if (is_waiting || (live_.LacksSensor() && !live_.IsFrozen())) {
      if (ticks_ % kTicksPerStatus == 0 || is_waiting != was_waiting) waiting_for_ = input_.Look();
      if (!waiting_for_.empty())
        message = is_waiting ? waiting_for_ : message + "; " + waiting_for_;
    } else {
      waiting_for_.clear();
    }
    if ((ros::SteadyTime::now() - clock_moved_).toSec() > 1.0)
      message +=
          now.isZero() ? "; use_sim_time is set, but there is no /clock" : "; /clock stands still";
  }

  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper) {
    const bool is_bad =
        status_.phase == CalibrationStatus::WAITING || status_.phase == CalibrationStatus::DEGRADED;
    wrapper.summary(is_bad ? wrapper.WARN : wrapper.OK,
                    status_.phase_text + ": " + status_.message);
    const std::array<StreamStatus, 3> streams = live_.Streams();
    for (size_t k = 0; k < streams.size(); ++k) {
      const std::string name = std::array{"pose", "gyro", "accel"}[k];
      wrapper.addf(name + " rate", "%.1f Hz", streams[k].rate_hz);
      wrapper.addf(name + " delay", "%.4f s", streams[k].delay_s);
      wrapper.add(name + " received", streams[k].received);
    }
    wrapper.add("verdict", live_.result() ? live_.result()->message : "none yet");
    for (const std::string& warning : status_.warnings) wrapper.add("warning", warning);
  }

  void PublishPose(const PoseSample& pose) {
    if (!live_.result() || pose_publisher_.getNumSubscribers() == 0) return;
    pose_publisher_.publish(
        ToImuPose(pose, live_.result()->imus[0].T_MI, input_.Info().world_frame));
  }

  void PublishPath() {
    if (!live_.result() || path_publisher_.getNumSubscribers() == 0) return;
    nav_msgs::Path path;
    path.header = MakeHeader(status_.header.stamp, input_.Info().world_frame);
    for (const PoseSample& pose : live_.path())
      path.poses.push_back(ToImuPose(pose, live_.result()->imus[0].T_MI, path.header.frame_id));
    path_publisher_.publish(path);
  }

  /// As a message, and as static transforms.
  void PublishResult() {
    const RecordingInfo info = input_.Info();
    const ros::Time now = ros::Time::now();
    result_publisher_.publish(ToMsg(*live_.result(), info, now));
    const auto all = ToTransforms(*live_.result(), info, now);
    std::vector<geometry_msgs::TransformStamped> transforms;
    for (size_t k = 0; k < all.size(); ++k)
      if (HasPlaceInTf(all[k], /*is_imu=*/k < info.imus.size())) transforms.push_back(all[k]);
    broadcaster_.sendTransform(transforms);
  }

  /// Says why a transform is not published, or should not be.
  bool HasPlaceInTf(const geometry_msgs::TransformStamped& transform, bool is_imu) const {
    const std::string &marker = transform.header.frame_id, &frame = transform.child_frame_id;
    if (frame == marker) {
      ROS_ERROR(
          "No transform is published: the marker and the imu frame are both called '%s'; set "
          "marker_frame or imu_frame",
          marker.c_str());
      return false;
    }
    const auto* link = input_.OtherParent(frame);
    if (!link) return true;
    const char* parent = link->header.frame_id.c_str();
    if (is_imu)
      ROS_WARN("tf has two parents of '%s': '%s' from elsewhere and '%s' from here; set imu_frame",
               frame.c_str(), parent, marker.c_str());
    else  // may be in the tf of a robot, as one from tf is
      ROS_WARN("No transform of '%s' is published: its parent in tf is '%s' already", frame.c_str(),
               parent);
    return is_imu;
  }

  ros::NodeHandle node_;
  const OfflineRequest request_;
  const CalibrationOptions options_;
  const bool auto_save_ = Parameter("auto_save", false);
  ros::Publisher status_publisher_ = node_.advertise<CalibrationStatus>("status", 10),
                 result_publisher_ = node_.advertise<CalibrationResult>("result", 1, true),
                 pose_publisher_ = node_.advertise<geometry_msgs::PoseStamped>("imu_pose", 100),
                 path_publisher_ = node_.advertise<nav_msgs::Path>("imu_path", 1),
                 marker_publisher_ = node_.advertise<visualization_msgs::MarkerArray>("markers", 1);
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  diagnostic_updater::Updater diagnostics_{ros::NodeHandle(), node_};

  std::mutex mutex_;  ///< of everything below, and of publishing
  LiveCalibration live_;
  LiveInput input_;
  LiveSolver solver_;

  std::string save_error_;  ///< of an automatic save
  CalibrationStatus status_;
  std::string waiting_for_;  ///< which topics, and why
  int ticks_ = 0;
  ros::SteadyTime clock_moved_ = ros::SteadyTime::now();
  ros::WallTimer timer_;

  ros::CallbackQueue service_queue_;
  std::vector<ros::ServiceServer> services_;
  /// One thread each: ~reset and ~save need not wait for ~calibrate. Ends before the solver, which
  /// a service may wait for.
  ros::AsyncSpinner service_spinner_{3, &service_queue_};
};

}  // namespace

void RunLive(const ros::NodeHandle& node, const OfflineRequest& request) {
  LiveNode live(node, request);
  ros::spin();
  if (!live.IsBusy()) return;
  // Neither can be interrupted, and nobody waits for them any more.
  ros::shutdown();
  std::fflush(nullptr);
  std::_Exit(0);
}

}  // namespace imu_pose_calib
