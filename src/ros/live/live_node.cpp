#include "imu_pose_calib/ros/live/live_node.h"

#include <diagnostic_updater/diagnostic_updater.h>
#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Path.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_msgs/TFMessage.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <future>
#include <iostream>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <optional>

#include "imu_pose_calib/CalibrationStatus.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/imu_yaml.h"
#include "imu_pose_calib/ros/io/pose_messages.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/tf_chain.h"
#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/ros/live/markers.h"
#include "imu_pose_calib/ros/live/parameters.h"
#include "imu_pose_calib/ros/live/topic_source.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

using Trigger = std_srvs::Trigger;
using diagnostic_msgs::DiagnosticStatus;

/// How far apart links of tf with the same stamp may arrive [s].
constexpr double kTfCache = 10.0;

constexpr double kTickPeriod = 0.1;  // [s]
constexpr int kTicksPerStatus = 5;
constexpr int kTicksPerDiagnostics = 10;
constexpr double kPathStep = 0.05;  // [s]

/// Parameters of the node.
struct Settings {
  std::string imu_topic, gyro_topic, accel_topic, pose_topic, tf_parent, tf_child;
  std::string marker_frame, imu_frame;  ///< empty: of the messages
  std::string output, imu_yaml;
  bool auto_save = false;
  CalibrationOptions calibration;
  LiveOptions live;
};

Settings ReadSettings(const ros::NodeHandle& node) {
  const auto text = [&](const char* name) {
    return Param<std::string>(node, name, "", "a string");
  };
  const auto number = [&](const char* name, double* value) {
    *value = Param<double>(node, name, *value, "a number");
  };
  Settings settings;
  settings.imu_topic = text("imu_topic");
  settings.gyro_topic = text("gyro_topic");
  settings.accel_topic = text("accel_topic");
  settings.pose_topic = text("pose_topic");
  const bool is_split = IsPair({"imu_topic", settings.imu_topic},
                               {"gyro_topic", settings.gyro_topic},
                               {"accel_topic", settings.accel_topic});
  settings.tf_parent = text("tf_parent");
  settings.tf_child = text("tf_child");
  IsPair({"pose_topic", settings.pose_topic},
         {"tf_parent", settings.tf_parent},
         {"tf_child", settings.tf_child});
  settings.marker_frame = text("marker_frame");
  settings.imu_frame = text("imu_frame");

  const std::string output = text("output");
  settings.output =
      std::filesystem::absolute(output.empty() ? "imu_pose_calib.calibration.yaml" : output);
  settings.auto_save = Param<bool>(node, "auto_save", false, "true or false");

  if (const std::string config = text("config"); !config.empty())
    settings.calibration = LoadOptions(config);
  settings.imu_yaml = text("imu_yaml");
  if (!settings.imu_yaml.empty()) {
    const ImuYaml imu = LoadImuYaml(settings.imu_yaml);
    imu.CopyNoise(&settings.calibration);
    if (settings.imu_topic.empty() && !is_split) settings.imu_topic = imu.rostopic;
  }
  if (const std::string method = text("method"); !method.empty())
    settings.calibration.method = ParseMethod(method);
  number("window", &settings.live.window);
  number("min_duration", &settings.live.min_duration);
  number("solve_interval", &settings.live.solve_interval);
  number("lost_timeout", &settings.live.lost_timeout);
  number("target_rotation_std", &settings.live.target_rotation_std);
  number("target_translation_std", &settings.live.target_translation_std);
  number("target_time_shift_std", &settings.live.target_time_shift_std);
  return settings;
}

/// T_WI at the pose T_WM.
geometry_msgs::PoseStamped ToImuPose(const PoseSample& pose,
                                     const Rigid3& T_MI,
                                     const std::string& world_frame) {
  const Eigen::Quaterniond q_WM = pose.q_WM.normalized();
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = FromNanoseconds(pose.t_ns);
  msg.header.frame_id = world_frame;
  msg.pose.position = ToPointMsg(pose.p_WM + q_WM * T_MI.p);
  msg.pose.orientation = ToQuaternionMsg(q_WM * T_MI.q);
  return msg;
}

/// "rotation    x [######----]  60 %"
std::string Bar(const std::string& motion, char axis, double share) {
  const int filled = static_cast<int>(std::floor(10.0 * share));
  const std::string bar = std::string(static_cast<size_t>(filled), '#') +
                          std::string(static_cast<size_t>(10 - filled), '-');
  char line[64];
  std::snprintf(
      line, sizeof(line), "%-11s %c [%s] %3.0f %%", motion.c_str(), axis, bar.c_str(), 100 * share);
  return line;
}

std::vector<std::string> Bars(const Excitation& excitation) {
  std::vector<std::string> bars;
  for (int axis = 0; axis < 3; ++axis)
    bars.push_back(Bar("rotation", "xyz"[axis], excitation.rotation[axis]));
  for (int axis = 0; axis < 3; ++axis)
    bars.push_back(Bar("translation", "xyz"[axis], excitation.translation[axis]));
  return bars;
}

void Append(const std::string& sentence, std::string* text) {
  *text += (text->empty() ? "" : "; ") + sentence;
}

/// Why no poses come from tf.
std::string LookAt(const TfChain& chain) {
  try {
    chain.Check();
    return "/tf: the frames are connected, but no pose has come in yet";
  } catch (const InputError& error) {
    return error.what();
  }
}

/// A sample of one sensor of a split IMU.
struct FramedSample {
  ImuSample sample;
  std::string frame;
};

FramedSample ToSample(const topic_tools::ShapeShifter& message,
                      ImuSample (*to_sample)(const sensor_msgs::Imu&)) {
  if (message.getDataType() == kVectorType) {
    const auto vector = message.instantiate<geometry_msgs::Vector3Stamped>();
    return {ToImuSample(*vector), vector->header.frame_id};
  }
  const auto imu = message.instantiate<sensor_msgs::Imu>();
  return {to_sample(*imu), imu->header.frame_id};
}

/// Subscribers, publishers, services and the thread of a solve around a LiveCalibration.
class LiveNode {
 public:
  explicit LiveNode(const ros::NodeHandle& node);
  bool IsSolving();

 private:
  void AddSource(const std::string& parameter,
                 const std::string& topic,
                 const std::vector<std::string>& types,
                 void (LiveNode::*add)(const TopicSource::Message&));
  void OnImu(const TopicSource::Message& message);
  void OnGyro(const TopicSource::Message& message);
  void OnAccel(const TopicSource::Message& message);
  void OnPose(const TopicSource::Message& message);
  void OnTransforms(const tf2_msgs::TFMessage& message, bool fixed);
  void AddPose(const PoseSample& recorded, const ros::Time& now);

  void Tick();
  void StartSolve();
  void TakeResult();
  void PublishResult();
  std::string Save();
  void AutoSave();
  bool OnCalibrate(Trigger::Request&, Trigger::Response& response);
  bool OnSave(Trigger::Request&, Trigger::Response& response);
  bool OnReset(Trigger::Request&, Trigger::Response& response);

  RecordingInfo Info() const;
  std::string Progress() const;
  void UpdateStatus();
  void PublishStatus();
  void PublishMotion();
  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper);

  ros::NodeHandle node_;
  const Settings settings_;

  /// Of everything below: messages and services have a thread each.
  std::mutex mutex_;
  LiveCalibration live_;
  std::list<TopicSource> sources_;
  std::optional<TfChain> chain_;  ///< when poses come from tf
  /// Of /tf_static by child, for a new chain after a reset.
  std::map<std::string, geometry_msgs::TransformStamped> fixed_links_;
  size_t chain_resets_ = 0;                             ///< of live_, when the chain was made
  std::string world_frame_, marker_frame_, imu_frame_;  ///< of the messages
  size_t foreign_poses_ = 0;                            ///< of other frames, dropped
  std::string other_parent_;                            ///< of the imu frame in tf
  std::deque<PoseSample> path_;

  std::shared_future<Calibration> solve_;  ///< valid while one runs
  ros::SteadyTime solve_start_;
  double last_solve_time_ = 0.0;  ///< [s] 0: none has ended yet
  std::string save_error_;        ///< of an automatic save
  LiveStatus status_;
  std::string waiting_for_;  ///< which topics, and why
  int ticks_ = 0;
  ros::Time now_;  ///< of the last tick
  ros::SteadyTime clock_moved_ = ros::SteadyTime::now();

  ros::Publisher status_publisher_, result_publisher_, pose_publisher_, path_publisher_,
      marker_publisher_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  diagnostic_updater::Updater diagnostics_;
  std::vector<ros::Subscriber> tf_;
  ros::WallTimer timer_;

  ros::CallbackQueue service_queue_;
  std::vector<ros::ServiceServer> services_;
  /// One thread each: ~reset and ~save need not wait for ~calibrate.
  ros::AsyncSpinner service_spinner_{3, &service_queue_};
};

LiveNode::LiveNode(const ros::NodeHandle& node)
    : node_(node),
      settings_(ReadSettings(node)),
      live_(settings_.live, settings_.calibration),
      diagnostics_(ros::NodeHandle(), node) {
  status_publisher_ = node_.advertise<CalibrationStatus>("status", 10);
  result_publisher_ = node_.advertise<CalibrationResult>("result", 1, true);
  pose_publisher_ = node_.advertise<geometry_msgs::PoseStamped>("imu_pose", 100);
  path_publisher_ = node_.advertise<nav_msgs::Path>("imu_path", 1);
  marker_publisher_ = node_.advertise<visualization_msgs::MarkerArray>("markers", 1);

  const std::vector<std::string> split = {kImuType, kVectorType};
  if (settings_.gyro_topic.empty()) {
    AddSource("imu_topic", settings_.imu_topic, {kImuType}, &LiveNode::OnImu);
  } else {
    AddSource("gyro_topic", settings_.gyro_topic, split, &LiveNode::OnGyro);
    AddSource("accel_topic", settings_.accel_topic, split, &LiveNode::OnAccel);
  }
  if (settings_.tf_parent.empty()) {
    AddSource("pose_topic", settings_.pose_topic, PoseTypeNames(), &LiveNode::OnPose);
  } else {
    chain_.emplace(settings_.tf_parent, settings_.tf_child, kTfCache);
    world_frame_ = FrameName(settings_.tf_parent, "");
    marker_frame_ = FrameName(settings_.tf_child, "");
  }
  for (const bool fixed : {false, true})
    tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
        fixed ? "/tf_static" : "/tf",
        0,
        boost::function<void(const tf2_msgs::TFMessage::ConstPtr&)>(
            [this, fixed](const tf2_msgs::TFMessage::ConstPtr& message) {
              OnTransforms(*message, fixed);
            })));

  diagnostics_.setHardwareID("none");
  diagnostics_.add("calibration", this, &LiveNode::Diagnose);
  timer_ = node_.createWallTimer(ros::WallDuration(kTickPeriod),
                                 [this](const ros::WallTimerEvent&) { Tick(); });

  ros::NodeHandle services = node_;
  services.setCallbackQueue(&service_queue_);
  services_ = {services.advertiseService("calibrate", &LiveNode::OnCalibrate, this),
               services.advertiseService("save", &LiveNode::OnSave, this),
               services.advertiseService("reset", &LiveNode::OnReset, this)};
  service_spinner_.start();
}

void LiveNode::AddSource(const std::string& parameter,
                         const std::string& topic,
                         const std::vector<std::string>& types,
                         void (LiveNode::*add)(const TopicSource::Message&)) {
  sources_.emplace_back(
      node_, parameter, topic, types, [this, add](const TopicSource::Message& message) {
        const std::lock_guard<std::mutex> lock(mutex_);
        (this->*add)(message);
      });
}

// --- Messages ---

void LiveNode::OnImu(const TopicSource::Message& message) {
  OnGyro(message);
  OnAccel(message);
}

void LiveNode::OnGyro(const TopicSource::Message& message) {
  const FramedSample gyro = ToSample(*message.getMessage(), ToGyroSample);
  imu_frame_ = gyro.frame;
  live_.AddGyro(gyro.sample, message.getReceiptTime().toSec());
}

void LiveNode::OnAccel(const TopicSource::Message& message) {
  const FramedSample accel = ToSample(*message.getMessage(), ToAccelSample);
  live_.AddAccel(accel.sample, message.getReceiptTime().toSec());
}

void LiveNode::OnPose(const TopicSource::Message& message) {
  const FramedPose framed = ToFramedPose(*message.getMessage());
  if (world_frame_.empty()) {
    world_frame_ = FrameName(framed.world_frame, "world");
    marker_frame_ = FrameName(framed.marker_frame, "marker");
  }
  if (FrameName(framed.world_frame, "world") == world_frame_ &&
      FrameName(framed.marker_frame, "marker") == marker_frame_) {
    AddPose(framed.pose, message.getReceiptTime());
  } else {
    ++foreign_poses_;
  }
}

void LiveNode::OnTransforms(const tf2_msgs::TFMessage& message, bool fixed) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const RecordingInfo info = Info();
  for (const geometry_msgs::TransformStamped& transform : message.transforms) {
    const std::string parent = FrameName(transform.header.frame_id, "");
    if (FrameName(transform.child_frame_id, "") == info.imu_frame && parent != info.marker_frame)
      other_parent_ = parent;
  }
  if (!chain_) return;
  if (fixed)
    for (const auto& transform : message.transforms)
      fixed_links_[transform.child_frame_id] = transform;
  chain_->Add(message, fixed);
  for (const PoseSample& pose : chain_->TakePoses()) AddPose(pose, ros::Time::now());
  if (chain_resets_ == live_.resets()) return;
  // The links known so far belong to another time.
  chain_resets_ = live_.resets();
  chain_.emplace(settings_.tf_parent, settings_.tf_child, kTfCache);
  tf2_msgs::TFMessage links;
  for (const auto& [child, transform] : fixed_links_) links.transforms.push_back(transform);
  chain_->Add(links, true);
}

void LiveNode::AddPose(const PoseSample& recorded, const ros::Time& now) {
  live_.AddPose(recorded, now.toSec());
  if (!live_.pose() || live_.pose()->t_ns != recorded.t_ns) return;  // not valid
  const PoseSample pose = *live_.pose();
  const auto seconds_since = [&](const PoseSample& old) {
    return 1e-9 * static_cast<double>(pose.t_ns - old.t_ns);
  };
  if (path_.empty() || std::abs(seconds_since(path_.back())) > kPathStep) path_.push_back(pose);
  while (seconds_since(path_.front()) > settings_.live.window || seconds_since(path_.front()) < 0.0)
    path_.pop_front();
  if (live_.result() && pose_publisher_.getNumSubscribers() > 0)
    pose_publisher_.publish(ToImuPose(pose, live_.result()->imus[0].T_MI, world_frame_));
}

/// Topics, and frames as they are published.
RecordingInfo LiveNode::Info() const {
  RecordingInfo info;
  info.world_frame = FrameName(world_frame_, "world");
  info.marker_frame = FrameName(settings_.marker_frame, FrameName(marker_frame_, "marker"));
  info.imu_frame = FrameName(settings_.imu_frame, FrameName(imu_frame_, "imu"));
  info.pose_topic = chain_ ? "/tf" : sources_.back().topic();
  if (settings_.gyro_topic.empty()) {
    info.imu_topic = sources_.front().topic();
  } else {
    info.gyro_topic = settings_.gyro_topic;
    info.accel_topic = settings_.accel_topic;
  }
  info.imu_yaml = settings_.imu_yaml;
  return info;
}

// --- Solves ---

bool LiveNode::IsSolving() {
  const std::lock_guard<std::mutex> lock(mutex_);
  return solve_.valid();
}

void LiveNode::StartSolve() {
  solve_start_ = ros::SteadyTime::now();
  solve_ =
      std::async(std::launch::async, [options = settings_.calibration, data = live_.BeginSolve()] {
        return Calibrate(options, data);
      });
}

/// Takes the result of a solve that has ended.
void LiveNode::TakeResult() {
  if (!solve_.valid() || solve_.wait_for(std::chrono::seconds(0)) != std::future_status::ready)
    return;
  last_solve_time_ = (ros::SteadyTime::now() - solve_start_).toSec();
  const std::shared_future<Calibration> ended = std::move(solve_);
  solve_ = {};
  try {
    if (live_.EndSolve(ended.get())) PublishResult();
  } catch (const std::exception& error) {
    live_.FailSolve(OneLine(error));
  }
}

void LiveNode::PublishResult() {
  const RecordingInfo info = Info();
  const ros::Time now = ros::Time::now();
  result_publisher_.publish(ToMsg(*live_.result(), info, now));
  if (info.marker_frame != info.imu_frame) {
    broadcaster_.sendTransform(ToTransformStamped(*live_.result(), info, now));
  } else {
    ROS_ERROR(
        "No transform is published: the marker and the imu frame are both called '%s'; set "
        "marker_frame or imu_frame",
        info.imu_frame.c_str());
  }
  if (!other_parent_.empty())
    ROS_WARN("tf has two parents of '%s': '%s' from elsewhere and '%s' from here; set imu_frame",
             info.imu_frame.c_str(),
             other_parent_.c_str(),
             info.marker_frame.c_str());
}

/// Writes the best result and freezes it. Returns what was done.
std::string LiveNode::Save() {
  WriteFile(settings_.output, ToYaml(*live_.result(), Info(), settings_.calibration));
  std::string message = "saved to " + settings_.output + "; call reset to start anew";
  live_.Freeze(message);
  save_error_.clear();
  std::cout << Summary(*live_.result(), Info()) << std::flush;
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
  std::shared_future<Calibration> solve;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (live_.IsFrozen() || status_.phase == Phase::kWaiting) {
      response.message = status_.message;
      return true;
    }
    if (!solve_.valid()) StartSolve();
    solve = solve_;
  }
  try {
    const Calibration& result = solve.get();
    response.success = result.IsUsable();
    response.message = std::string(ToString(result.status)) + ": " + result.message;
  } catch (const std::exception& error) {
    response.message = OneLine(error);
  }
  const std::lock_guard<std::mutex> lock(mutex_);
  TakeResult();
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
  save_error_.clear();
  return true;
}

// --- Status ---

void LiveNode::Tick() {
  const std::lock_guard<std::mutex> lock(mutex_);
  TakeResult();
  if (!solve_.valid() && live_.WantsSolve()) StartSolve();
  const Phase last_phase = status_.phase;
  UpdateStatus();
  if (status_.phase == Phase::kConverged && settings_.auto_save && save_error_.empty()) AutoSave();
  if (status_.phase != last_phase || ticks_ == 0)
    ROS_INFO("%s: %s", ToString(status_.phase), status_.message.c_str());
  if (ticks_ % kTicksPerStatus == 0) PublishStatus();
  if (ticks_ % kTicksPerDiagnostics == 0) diagnostics_.force_update();
  PublishMotion();
  ++ticks_;
}

/// "3 s of about 4 s: "
std::string LiveNode::Progress() const {
  const double seconds = (ros::SteadyTime::now() - solve_start_).toSec();
  char text[64];
  if (last_solve_time_ > 0.0)
    std::snprintf(text, sizeof(text), "%.0f s of about %.0f s: ", seconds, last_solve_time_);
  else
    std::snprintf(text, sizeof(text), "%.0f s so far: ", seconds);
  return text;
}

void LiveNode::UpdateStatus() {
  const ros::Time now = ros::Time::now();
  if (now != now_) clock_moved_ = ros::SteadyTime::now();
  now_ = now;
  status_ = live_.Status(now.toSec());
  if (status_.phase == Phase::kSolving) status_.message = Progress() + status_.message;
  if (live_.result() && !other_parent_.empty())
    status_.message +=
        "; tf has another parent of " + Info().imu_frame + ", " + other_parent_ + ": set imu_frame";
  if (!save_error_.empty()) status_.message += "; " + save_error_;
  if (foreign_poses_ > 0)
    status_.message += "; " + std::to_string(foreign_poses_) + " poses of other frames than " +
                       world_frame_ + " -> " + marker_frame_ + " were dropped";
  if (status_.phase == Phase::kWaiting) {
    if (ticks_ % kTicksPerStatus == 0) {
      waiting_for_.clear();
      for (TopicSource& source : sources_)
        if (!source.HasData()) Append(source.Look(), &waiting_for_);
      if (chain_ && status_.poses.received == 0) Append(LookAt(*chain_), &waiting_for_);
    }
    if (!waiting_for_.empty()) status_.message = waiting_for_;
  } else {
    waiting_for_.clear();
  }
  if ((ros::SteadyTime::now() - clock_moved_).toSec() > 1.0)
    status_.message +=
        now.isZero() ? "; use_sim_time is set, but there is no /clock" : "; /clock stands still";
}

void LiveNode::PublishStatus() {
  CalibrationStatus msg;
  msg.header.stamp = now_;
  msg.phase = static_cast<uint8_t>(status_.phase);
  msg.phase_text = ToString(status_.phase);
  msg.message = status_.message;
  msg.buffered =
      std::min({status_.poses.buffered_s, status_.gyro.buffered_s, status_.accel.buffered_s});
  msg.pose_rate = status_.poses.rate_hz;
  msg.gyro_rate = status_.gyro.rate_hz;
  msg.accel_rate = status_.accel.rate_hz;
  msg.pose_count = status_.poses.received;
  msg.gyro_count = status_.gyro.received;
  msg.accel_count = status_.accel.received;
  msg.rotation_excitation = ToVector3Msg(status_.excitation.rotation);
  msg.translation_excitation = ToVector3Msg(status_.excitation.translation);
  msg.bars = Bars(status_.excitation);
  msg.solves = static_cast<uint32_t>(status_.solves);
  if (solve_.valid()) msg.solve_time = (ros::SteadyTime::now() - solve_start_).toSec();
  if (live_.result()) {
    const LargestStd std_dev = MaxStd(*live_.result());
    msg.rotation_std = std_dev.rotation;
    msg.translation_std = std_dev.translation;
    msg.time_shift_std = std_dev.time_shift;
    msg.warnings = live_.result()->warnings;
  }
  status_publisher_.publish(msg);
}

void LiveNode::PublishMotion() {
  if (marker_publisher_.getNumSubscribers() > 0) {
    const Scene scene{FrameName(world_frame_, "world"),
                      status_,
                      live_.result() ? &*live_.result() : nullptr,
                      live_.pose() ? &*live_.pose() : nullptr,
                      path_};
    marker_publisher_.publish(Draw(scene, now_));
  }
  if (live_.result() && path_publisher_.getNumSubscribers() > 0 && ticks_ % kTicksPerStatus == 0) {
    nav_msgs::Path path;
    path.header.stamp = now_;
    path.header.frame_id = world_frame_;
    for (const PoseSample& pose : path_)
      path.poses.push_back(ToImuPose(pose, live_.result()->imus[0].T_MI, world_frame_));
    path_publisher_.publish(path);
  }
}

void LiveNode::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper) {
  const bool bad = status_.phase == Phase::kWaiting || status_.phase == Phase::kDegraded;
  wrapper.summary(bad ? DiagnosticStatus::WARN : DiagnosticStatus::OK,
                  std::string(ToString(status_.phase)) + ": " + status_.message);
  const auto stream = [&](const std::string& name, const StreamStatus& status) {
    wrapper.addf(name + " rate", "%.1f Hz", status.rate_hz);
    wrapper.addf(name + " delay", "%.4f s", status.delay_s);
    wrapper.add(name + " received", status.received);
  };
  stream("pose", status_.poses);
  stream("gyro", status_.gyro);
  stream("accel", status_.accel);
  wrapper.add("verdict", live_.result() ? live_.result()->message : "none yet");
  if (!live_.result()) return;
  for (const std::string& warning : live_.result()->warnings) wrapper.add("warning", warning);
}

}  // namespace

void RunLive(const ros::NodeHandle& node) {
  LiveNode live(node);
  ros::spin();
  if (!live.IsSolving()) return;
  // A solve cannot be interrupted, and nobody waits for this one any more.
  ros::shutdown();
  std::fflush(nullptr);
  std::_Exit(0);
}

}  // namespace imu_pose_calib
