#include "imu_pose_calib/ros/live/live_node.h"

#include <diagnostic_updater/diagnostic_updater.h>
#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Path.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_msgs/TFMessage.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <topic_tools/shape_shifter.h>

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <filesystem>
#include <future>
#include <iostream>
#include <map>
#include <mutex>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/tf_chain.h"
#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/ros/live/markers.h"
#include "imu_pose_calib/ros/live/parameter.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

using std_srvs::Trigger;

constexpr double kTickPeriod = 0.1;  // [s]
constexpr int kTicksPerStatus = 5;
/// How far apart links of tf with the same stamp may arrive [s].
constexpr double kTfCache = 10.0;
/// After this the master counts as away [s], and a topic as silent.
constexpr double kMasterTimeout = 2.0, kSilence = 1.0;

/// Types without their packages.
std::string ShortNames(std::vector<std::string> types) {
  for (std::string& type : types) type.erase(0, type.find('/') + 1);
  return boost::join(types, ", ");
}

/// Why no poses come from tf.
std::string LookAt(const TfChain& chain) {
  const std::string problem = chain.Problem();
  return problem.empty() ? "/tf: the frames are connected, but no pose has come in yet" : problem;
}

/// The full names of the pose sensors.
std::vector<std::string> PoseSensors(const RecordingRequest& request) {
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
  if (!request.pose_topic.empty()) marker = ros::names::resolve(request.pose_topic);
  if (!request.tf_parent.empty())
    marker = JoinTf({FrameName(request.tf_parent, ""), FrameName(request.tf_child, "")});
  CheckPoseSensors(marker, names);
  return names;
}

/// Of each IMU, or of its gyroscope.
std::vector<std::string> GyroTopics(const RecordingRequest& request) {
  return SplitNames(request.gyro_topic.empty() ? request.imu_topic : request.gyro_topic);
}

/// The request with its defaults.
OfflineRequest Checked(OfflineRequest request) {
  const bool is_split = IsPair({"imu_topic", request.imu_topic}, {"gyro_topic", request.gyro_topic},
                               {"accel_topic", request.accel_topic});
  IsPair({"pose_topic", request.pose_topic}, {"tf_parent", request.tf_parent},
         {"tf_child", request.tf_child});
  request.pose_sensors = boost::join(PoseSensors(request), " ");
  if (!request.imu_yaml.empty() && request.imu_topic.empty() && !is_split)
    request.imu_topic = LoadImuYaml(request.imu_yaml);
  for (const auto& [name, value] :
       {Given{"imu_frame", request.imu_frame}, Given{"accel_topic", request.accel_topic}})
    if (const size_t count = SplitNames(value).size(), imus = GyroTopics(request).size();
        !value.empty() && count != imus)
      throw InputError(Format("%s has %zu names for %zu imus", name, count, imus));
  request.output = std::filesystem::absolute(
      request.output.empty() ? "imu_pose_calib.calibration.yaml" : request.output);
  return request;
}

LiveOptions ReadLiveOptions() {
  LiveOptions options;
  for (const auto& [name, field] : kLiveOptions)
    options.*field = RosParameter(name, options.*field);
  return options;
}

/// Listens to the topics of the live node: hands samples to a LiveCalibration and keeps what the
/// messages say about frames. A topic need not exist yet; when it is not named, it is the one topic
/// of its types. No message is dropped on this side.
///
/// `mutex` guards the LiveCalibration and this. The callbacks of the topics lock it; everything
/// public is called with it held. The master is asked on a thread of its own and without the mutex,
/// since it may be away: the end of the object waits for that.
class LiveInput {
 public:
  /// Topics, tf and frames are those of `request`. `on_pose` is called, with the mutex held, for
  /// each valid pose.
  LiveInput(const ros::NodeHandle& node, const OfflineRequest& request, std::mutex* mutex,
            LiveCalibration* live, const std::function<void(const PoseSample&)>& on_pose)
      : node_(node), request_(request), mutex_(mutex), live_(live), on_pose_(on_pose) {
    live_->OnReset([this] { Forget(); });
    const bool is_split = !request.gyro_topic.empty();
    const std::vector<std::string> gyros = GyroTopics(request),
                                   accels = SplitNames(request.accel_topic);
    imus_.resize(gyros.size());
    for (size_t i = 0; i < gyros.size(); ++i) {
      ImuInfo& imu = imus_[i];
      const auto read = [this, i](bool is_gyro, bool is_accel) {
        return [=](const Message& message) { return OnImu(message, i, is_gyro, is_accel); };
      };
      if (is_split) {
        Listen("gyro_topic", gyros[i], &imu.gyro_topic, {kImuType, kVectorType}, read(true, false));
        Listen("accel_topic", accels[i], &imu.accel_topic, {kImuType, kVectorType},
               read(false, true));
      } else {
        Listen("imu_topic", gyros[i], &imu.imu_topic, {kImuType}, read(true, true));
      }
    }
    const TfFrames marker(FrameName(request.tf_parent, ""), FrameName(request.tf_child, ""));
    ListenToPoses("pose_topic", request.pose_topic,
                  request.tf_parent.empty() ? std::nullopt : std::optional(marker));
    for (const std::string& name : SplitPaths(request.pose_sensors))
      ListenToPoses("pose_sensor", name, SplitTf(name));
    for (const bool fixed : {false, true})
      tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
          fixed ? "/tf_static" : "/tf", 0,
          boost::function<void(const TfEvent&)>(
              [this, fixed](const TfEvent& event) { OnTransforms(event, fixed); })));
  }

  /// Topics, and frames as they are published.
  RecordingInfo Info() const {
    RecordingInfo info;
    info.imus = imus_;
    for (ImuInfo& imu : info.imus) imu.imu_frame = FrameName(imu.imu_frame, "imu");
    for (size_t k = 0; k < poses_.size(); ++k)
      info.pose_sensors.push_back(Named(k, poses_[k].info.world_frame, poses_[k].info.frame));
    const PoseSensorInfo& marker = info.pose_sensors.front();
    info.pose_topic = marker.topic;
    info.world_frame = marker.world_frame;
    info.marker_frame = marker.frame;
    info.pose_sensors.erase(info.pose_sensors.begin());
    info.imu_yaml = request_.imu_yaml;
    NameFrames(request_.marker_frame, request_.imu_frame, &info);
    return info;
  }

  /// The parent of a frame in tf, from elsewhere; empty: none, or the marker.
  std::string OtherParent(const std::string& frame) const {
    const std::string marker_frame = Info().marker_frame;
    for (const Links* links : {&fixed_links_, &links_})
      if (const auto link = links->find(frame);
          link != links->end() && link->second.header.frame_id != marker_frame)
        return link->second.header.frame_id;
    return "";
  }

  /// What was dropped, as a sentence; empty: nothing.
  std::string Dropped() const {
    std::vector<std::string> notes;
    for (const Poses& poses : poses_)
      if (poses.foreign > 0)
        notes.push_back(std::to_string(poses.foreign) + " poses of other frames than " +
                        poses.info.world_frame + " -> " + poses.info.frame + " were dropped");
    return boost::join(notes, "; ");
  }

  /// Has the topics looked for that bring nothing, and says what was the matter with them last
  /// time.
  std::string Look() {
    const ros::SteadyTime now = ros::SteadyTime::now();
    const bool hangs = IsLooking() && (now - look_start_).toSec() > kMasterTimeout;
    if (!IsLooking()) {
      if (look_.valid()) master_answers_ = look_.get();
      look_start_ = now;
      look_ = std::async(std::launch::async, [this] { return AskMaster(); });
    }
    std::vector<std::string> problems;
    const bool is_away = hangs || !master_answers_;
    if (is_away) problems.emplace_back("the ROS master does not answer");
    for (const Topic& topic : topics_)
      if (!topic.problem.empty())
        problems.push_back(*topic.name + " " + topic.problem);
      else if (topic.IsSilent() && !topic.state.empty() && !is_away)
        problems.push_back(topic.state);
    for (size_t k = 0; k < poses_.size(); ++k)
      if (poses_[k].chain && !live_->HasPoses(k))
        problems.push_back((k > 0 ? poses_[k].info.topic + ": " : "") + LookAt(*poses_[k].chain));
    return boost::join(problems, "; ");
  }

  bool IsLooking() const {
    return look_.valid() && look_.wait_for(std::chrono::seconds(0)) != std::future_status::ready;
  }

 private:
  using Message = ros::MessageEvent<const topic_tools::ShapeShifter>;
  using TfEvent = ros::MessageEvent<const tf2_msgs::TFMessage>;
  using Links = std::map<std::string, geometry_msgs::TransformStamped>;  ///< by child
  /// Reads a message of a topic; returns what it lacks, empty for nothing.
  using Read = std::function<std::string(const Message&)>;

  struct Topic {
    std::string parameter;  ///< that names it
    std::string* name;      ///< empty until it is named or found
    std::vector<std::string> types;
    Read read;
    bool is_named = !name->empty();
    bool has_data = false;
    std::string problem = {};         ///< of the last message
    std::string state = {};           ///< why nothing comes in, as the last look found
    ros::Subscriber subscriber = {};  ///< of the thread that looks
    ros::SteadyTime since = ros::SteadyTime::now();  ///< of the last message, or the start

    double Waited() const { return (ros::SteadyTime::now() - since).toSec(); }
    bool IsSilent() const { return !has_data || Waited() > kSilence; }
    bool Accepts(const std::string& type) const {
      return std::find(types.begin(), types.end(), type) != types.end();
    }

    /// Sets the state; true when there is another name to listen to. Of one that is not named: the
    /// one topic of these types, but for `others`.
    bool Look(const ros::master::V_TopicInfo& published, const std::vector<std::string>& others) {
      const std::string all = boost::join(types, " or "), before = *name;
      std::vector<std::string> found;
      for (const ros::master::TopicInfo& info : published)
        if (Accepts(info.datatype) && std::count(others.begin(), others.end(), info.name) == 0 &&
            !boost::algorithm::ends_with(info.name, "/imu_pose"))  // of nodes of this package
          found.push_back(info.name);
      const bool is_known = is_named || has_data;
      if (!is_known && found.size() != 1) {
        state = found.empty() ? "no topic of type " + all + " is published"
                              : "several topics of type " + all + ": " + boost::join(found, ", ") +
                                    "; choose with " + parameter;
        return false;
      }
      if (!is_known) *name = found.front();
      const auto info =
          std::find_if(published.begin(), published.end(),
                       [&](const auto& candidate) { return candidate.name == *name; });
      const std::string waited = Format(" for %.0f s", std::floor(Waited()));
      if (info == published.end())
        state = *name + " (" + ShortNames(types) + "): nobody has published it" + waited;
      else if (!Accepts(info->datatype))
        state = *name + " is " + info->datatype + ", must be " + all;
      else
        state = *name + " (" + info->datatype +
                ", publishers connected: " + std::to_string(subscriber.getNumPublishers()) +
                "): no message" + waited;
      return *name != before;
    }
  };
  /// Of the marker, or of a pose sensor.
  struct Poses {
    PoseSensorInfo info;           ///< frames of the messages
    std::optional<TfChain> chain;  ///< if they are from tf
    size_t foreign = 0;            ///< of other frames, dropped

    /// All but the static transforms: they are not sent again.
    void Forget(const Links& fixed_links) {
      foreign = 0;
      if (!chain) {
        info.world_frame = info.frame = "";
        return;
      }
      chain.emplace(info.world_frame, info.frame, kTfCache);
      tf2_msgs::TFMessage fixed;
      for (const auto& [child, link] : fixed_links) fixed.transforms.push_back(link);
      chain->Add(fixed, true);
    }
  };

  // --- Topics ---

  void ListenToPoses(const std::string& parameter, const std::string& name,
                     const std::optional<TfFrames>& tf) {
    const size_t source = poses_.size();
    Poses& poses = poses_.emplace_back();
    if (tf) {
      poses.info = {name.empty() ? "/tf" : name, tf->second, tf->first};
      poses.chain.emplace(tf->first, tf->second, kTfCache);
      return;
    }
    Listen(parameter, name, &poses.info.topic, kPoseTypes,
           [this, source](const Message& message) { return OnPose(message, source); });
  }

  /// To `name` or, when it is empty, to what is found; `*topic` tells which.
  void Listen(const std::string& parameter, const std::string& name, std::string* topic,
              const std::vector<std::string>& types, const Read& read) {
    *topic = name.empty() ? "" : ros::names::resolve(name);
    topics_.push_back({parameter, topic, types, read});
    if (!name.empty()) Subscribe(&topics_.back());
  }

  void Subscribe(Topic* topic) {
    topic->subscriber = node_.subscribe<topic_tools::ShapeShifter>(
        *topic->name,
        0,  // a queue without bound
        boost::function<void(const Message&)>(
            [this, topic](const Message& message) { OnMessage(message, topic); }),
        ros::VoidConstPtr(), ros::TransportHints().tcpNoDelay());
  }

  /// Looks for the topics that bring nothing; false when the master does not answer.
  bool AskMaster() {
    ros::master::V_TopicInfo published;
    if (!ros::master::getTopics(published)) return false;
    for (Topic& topic : topics_) {
      std::unique_lock<std::mutex> lock(*mutex_);
      if (!topic.IsSilent() || !topic.Look(published, SplitPaths(request_.pose_sensors))) continue;
      lock.unlock();  // the master may be away by now
      Subscribe(&topic);
    }
    return true;
  }

  // --- Messages ---

  /// Frames and what was dropped belong to the data of the LiveCalibration.
  void Forget() {
    for (ImuInfo& imu : imus_) imu.imu_frame.clear();
    for (Poses& poses : poses_) poses.Forget(fixed_links_);
    links_.clear();
  }

  void OnMessage(const Message& message, Topic* topic) {
    const std::lock_guard<std::mutex> lock(*mutex_);
    const std::string& type = message.getMessage()->getDataType();
    if (!topic->Accepts(type)) {
      topic->problem = "is " + type + ", must be " + boost::join(topic->types, " or ");
      return;
    }
    try {
      topic->problem = topic->read(message);
      topic->has_data = true;
      topic->since = ros::SteadyTime::now();
      topic->state.clear();
    } catch (const ros::Exception& error) {
      topic->problem =
          "has another definition of " + type + " than this computer (" + error.what() + ")";
    }
  }

  /// A message of the gyroscope or the accelerometer of an IMU, or of both.
  std::string OnImu(const Message& message, size_t imu, bool is_gyro, bool is_accel) {
    const auto& [gyro, accel, frame] =
        ReadImuContent(message.getMessage()->getDataType(), *message.getMessage());
    const double now = message.getReceiptTime().toSec();
    if (is_gyro && gyro) live_->AddGyro(*gyro, now, imu);
    if (is_accel && accel) live_->AddAccel(*accel, now, imu);
    if (is_gyro) imus_[imu].imu_frame = frame;
    std::vector<std::string> lacks;
    if (is_gyro && !gyro) lacks.emplace_back("no gyroscope");
    if (is_accel && !accel) lacks.emplace_back("no accelerometer");
    if (lacks.empty()) return "";
    return "gives " + boost::join(lacks, " and ") + ": its covariance starts with -1";
  }

  std::string OnPose(const Message& message, size_t source) {
    const FramedPose framed = ReadPose(message.getMessage()->getDataType(), *message.getMessage());
    Poses& poses = poses_[source];
    const PoseSensorInfo named = Named(source, framed.world_frame, framed.marker_frame);
    if (poses.info.world_frame.empty()) poses.info = named;
    if (named.world_frame == poses.info.world_frame && named.frame == poses.info.frame)
      AddPose(framed.pose, message.getReceiptTime(), source);
    else
      ++poses.foreign;
    return "";
  }

  void OnTransforms(const TfEvent& event, bool fixed) {
    if (event.getPublisherName() == ros::this_node::getName()) return;
    const std::lock_guard<std::mutex> lock(*mutex_);
    for (geometry_msgs::TransformStamped link : event.getMessage()->transforms) {
      link.header.frame_id = FrameName(link.header.frame_id, "");
      link.child_frame_id = FrameName(link.child_frame_id, "");
      (fixed ? fixed_links_ : links_)[link.child_frame_id] = link;
    }
    for (size_t k = 0; k < poses_.size(); ++k) {
      if (!poses_[k].chain) continue;
      poses_[k].chain->Add(*event.getMessage(), fixed);
      for (const PoseSample& pose : poses_[k].chain->TakePoses())
        AddPose(pose, ros::Time::now(), k);
    }
  }

  void AddPose(const PoseSample& recorded, const ros::Time& now, size_t source) {
    if (live_->AddPose(recorded, now.toSec(), source)) on_pose_(*live_->pose());
  }

  /// Source of poses, with names for frames that messages leave without.
  PoseSensorInfo Named(size_t source, const std::string& world_frame,
                       const std::string& frame) const {
    const std::string& topic = poses_[source].info.topic;
    if (source > 0) return NamePoseSensor(topic, world_frame, frame);
    return {topic, FrameName(frame, "marker"), FrameName(world_frame, "world")};
  }

  ros::NodeHandle node_;
  const OfflineRequest& request_;
  std::mutex* const mutex_;
  LiveCalibration* const live_;
  const std::function<void(const PoseSample&)> on_pose_;

  std::deque<Poses> poses_;  ///< the marker, then the pose sensors
  std::vector<ImuInfo> imus_;
  Links fixed_links_, links_;  ///< of /tf_static and of /tf, as others than this node say

  std::deque<Topic> topics_;
  std::vector<ros::Subscriber> tf_;

  ros::SteadyTime look_start_;
  bool master_answers_ = true;
  std::future<bool> look_;  ///< AskMaster(); the last member: it uses others
};

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
        live_(ReadLiveOptions(), options_, GyroTopics(request_).size(),
              SplitPaths(request_.pose_sensors)),
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
        if (const std::string parent = input_.OtherParent(imu.imu_frame); !parent.empty())
          message +=
              "; tf has another parent of " + imu.imu_frame + ", " + parent + ": set imu_frame";
    if (!save_error_.empty()) message += "; " + save_error_;
    if (const std::string dropped = input_.Dropped(); !dropped.empty()) message += "; " + dropped;
    const bool is_waiting = status_.phase == CalibrationStatus::WAITING;
    if (is_waiting || status_.phase == CalibrationStatus::DEGRADED ||
        (live_.LacksSensor() && !live_.IsFrozen())) {
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

  /// T_WI of the first IMU at the pose T_WM, by the result.
  geometry_msgs::PoseStamped ImuPose(const PoseSample& pose, const std::string& world_frame) const {
    geometry_msgs::PoseStamped msg;
    msg.header = MakeHeader(FromNanoseconds(pose.t_ns), world_frame);
    msg.pose = ToPoseMsg(Rigid3{pose.q_WM.normalized(), pose.p_WM} * live_.result()->imus[0].T_MI);
    return msg;
  }

  void PublishPose(const PoseSample& pose) {
    if (live_.result() && pose_publisher_.getNumSubscribers() > 0)
      pose_publisher_.publish(ImuPose(pose, input_.Info().world_frame));
  }

  void PublishPath() {
    if (!live_.result() || path_publisher_.getNumSubscribers() == 0) return;
    nav_msgs::Path path;
    path.header = MakeHeader(status_.header.stamp, input_.Info().world_frame);
    for (const PoseSample& pose : live_.path())
      path.poses.push_back(ImuPose(pose, path.header.frame_id));
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
    const std::string parent = input_.OtherParent(frame);
    if (parent.empty()) return true;
    if (is_imu)
      ROS_WARN("tf has two parents of '%s': '%s' from elsewhere and '%s' from here; set imu_frame",
               frame.c_str(), parent.c_str(), marker.c_str());
    else  // may be in the tf of a robot, as one from tf is
      ROS_WARN("No transform of '%s' is published: its parent in tf is '%s' already", frame.c_str(),
               parent.c_str());
    return is_imu;
  }

  ros::NodeHandle node_;
  const OfflineRequest request_;
  const CalibrationOptions options_;
  const bool auto_save_ = RosParameter("auto_save", false);
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
