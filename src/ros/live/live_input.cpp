#include "imu_pose_calib/ros/live/live_input.h"

#include <algorithm>
#include <boost/function.hpp>
#include <iterator>

#include "imu_pose_calib/ros/io/conversions.h"

namespace imu_pose_calib {
namespace {

/// How far apart links of tf with the same stamp may arrive [s].
constexpr double kTfCache = 10.0;
/// After this the master counts as away [s].
constexpr double kMasterTimeout = 2.0;

/// Why no poses come from tf.
std::string LookAt(const TfChain& chain) {
  try {
    chain.Check();
    return "/tf: the frames are connected, but no pose has come in yet";
  } catch (const InputError& error) {
    return error.what();
  }
}

}  // namespace

LiveInput::LiveInput(const ros::NodeHandle& node, const OfflineRequest& request, std::mutex* mutex,
                     LiveCalibration* live, const std::function<void(const PoseSample&)>& on_pose)
    : node_(node), request_(request), mutex_(mutex), live_(live), on_pose_(on_pose) {
  const BagRequest& topics = request_.bag;
  const bool is_split = !topics.gyro_topic.empty();
  const std::vector<std::string> gyros =
      SplitNames(is_split ? topics.gyro_topic : topics.imu_topic);
  const std::vector<std::string> accels = SplitNames(topics.accel_topic);
  for (size_t i = 0; i < gyros.size(); ++i) {
    const auto listen = [&](const char* parameter, const std::string& topic, bool gyro,
                            bool accel) {
      std::vector<std::string> types = {kImuType};
      if (is_split) types.emplace_back(kVectorType);
      return AddSource(parameter, topic, types, [=](const TopicSource::Message& message) {
        OnImu(message, i, gyro, accel);
      });
    };
    const TopicSource* gyro =
        listen(is_split ? "gyro_topic" : "imu_topic", gyros[i], true, !is_split);
    imus_.push_back({gyro, is_split ? listen("accel_topic", accels[i], false, true) : gyro});
  }
  const auto listen = [this](const char* parameter, const std::string& topic,
                             const std::optional<TfFrames>& tf) {
    const size_t source = poses_.size();
    Poses& poses = poses_.emplace_back();
    poses.name = topic;
    poses.tf = tf;
    if (!tf)
      poses.topic = AddSource(
          parameter, topic, PoseTypeNames(),
          [this, source](const TopicSource::Message& message) { OnPose(message, source); });
    poses.Forget({});
  };
  const TfFrames marker(FrameName(topics.tf_parent, ""), FrameName(topics.tf_child, ""));
  listen("pose_topic", topics.pose_topic,
         topics.tf_parent.empty() ? std::nullopt : std::optional(marker));
  for (const std::string& name : topics.pose_sensors) listen("pose_sensor", name, SplitTf(name));
  for (const bool fixed : {false, true})
    tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
        fixed ? "/tf_static" : "/tf", 0,
        boost::function<void(const TfEvent&)>(
            [this, fixed](const TfEvent& event) { OnTransforms(event, fixed); })));
}

const TopicSource* LiveInput::AddSource(const std::string& parameter, const std::string& topic,
                                        const std::vector<std::string>& types,
                                        const TopicSource::Callback& add) {
  return &sources_.emplace_back(node_, parameter, topic, types,
                                [this, add](const TopicSource::Message& message) {
                                  const std::lock_guard<std::mutex> lock(*mutex_);
                                  ForgetAfterReset();
                                  add(message);
                                });
}

void LiveInput::OnImu(const TopicSource::Message& message, size_t imu, bool is_gyro,
                      bool is_accel) {
  const auto& [gyro, accel, frame] =
      ReadImuContent(message.getMessage()->getDataType(), *message.getMessage());
  const double now = message.getReceiptTime().toSec();
  if (is_gyro) imus_[imu].frame = frame;
  if (is_gyro) imus_[imu].lacks_gyro = !gyro;
  if (is_accel) imus_[imu].lacks_accel = !accel;
  if (is_gyro && gyro) live_->AddGyro(*gyro, now, imu);
  if (is_accel && accel) live_->AddAccel(*accel, now, imu);
}

void LiveInput::OnPose(const TopicSource::Message& message, size_t source) {
  const FramedPose framed = ReadPose(message.getMessage()->getDataType(), *message.getMessage());
  Poses& poses = poses_[source];
  const PoseSensorInfo names =
      source == 0 ? PoseSensorInfo{"", FrameName(framed.marker_frame, "marker"),
                                   FrameName(framed.world_frame, "world")}
                  : NamePoseSensor(poses.name, framed.world_frame, framed.marker_frame);
  if (poses.world_frame.empty()) {
    poses.world_frame = names.world_frame;
    poses.frame = names.frame;
  }
  if (names.world_frame == poses.world_frame && names.frame == poses.frame)
    AddPose(framed.pose, message.getReceiptTime(), source);
  else
    ++poses.foreign;
}

void LiveInput::OnTransforms(const TfEvent& event, bool fixed) {
  if (event.getPublisherName() == ros::this_node::getName()) return;
  const std::lock_guard<std::mutex> lock(*mutex_);
  ForgetAfterReset();
  for (geometry_msgs::TransformStamped link : event.getMessage()->transforms) {
    link.header.frame_id = FrameName(link.header.frame_id, "");
    link.child_frame_id = FrameName(link.child_frame_id, "");
    (fixed ? fixed_links_ : links_)[link.child_frame_id] = link;
  }
  for (size_t k = 0; k < poses_.size(); ++k) {
    if (!poses_[k].chain) continue;
    poses_[k].chain->Add(*event.getMessage(), fixed);
    for (const PoseSample& pose : poses_[k].chain->TakePoses()) AddPose(pose, ros::Time::now(), k);
  }
}

void LiveInput::ForgetAfterReset() {
  if (resets_ == live_->resets()) return;
  resets_ = live_->resets();
  for (Imu& imu : imus_) imu.frame.clear();
  for (Poses& poses : poses_) poses.Forget(fixed_links_);
  links_.clear();
}

void LiveInput::Poses::Forget(const Links& fixed_links) {
  foreign = 0;
  world_frame = tf ? tf->first : "";
  frame = tf ? tf->second : "";
  if (!tf) return;
  chain.emplace(tf->first, tf->second, kTfCache);
  tf2_msgs::TFMessage fixed;
  for (const auto& [child, link] : fixed_links) fixed.transforms.push_back(link);
  chain->Add(fixed, true);
}

void LiveInput::AddPose(const PoseSample& recorded, const ros::Time& now, size_t source) {
  if (source > 0)
    live_->AddSensorPose(recorded, now.toSec(), source - 1);
  else if (live_->AddPose(recorded, now.toSec()))
    on_pose_(*live_->pose());
}

RecordingInfo LiveInput::Info() const {
  RecordingInfo info;
  const Poses& marker = poses_.front();
  info.world_frame = FrameName(marker.world_frame, "world");
  info.marker_frame = FrameName(marker.frame, "marker");
  info.pose_topic = marker.tf ? "/tf" : marker.topic->topic();
  for (size_t k = 1; k < poses_.size(); ++k)
    info.pose_sensors.push_back(
        NamePoseSensor(poses_[k].name, poses_[k].world_frame, poses_[k].frame));
  info.imus.resize(imus_.size());
  for (size_t i = 0; i < imus_.size(); ++i) {
    const Imu& imu = imus_[i];
    info.imus[i].imu_frame = FrameName(imu.frame, "imu");
    const bool is_split = imu.gyro != imu.accel;
    (is_split ? info.imus[i].gyro_topic : info.imus[i].imu_topic) = imu.gyro->topic();
    if (is_split) info.imus[i].accel_topic = imu.accel->topic();
  }
  info.imu_yaml = request_.imu_yaml;
  NameFrames(request_.marker_frame, request_.imu_frame, &info);
  return info;
}

const geometry_msgs::TransformStamped* LiveInput::OtherParent(
    const std::vector<std::string>& frames) const {
  const std::string marker_frame = Info().marker_frame;
  for (const Links* links : {&fixed_links_, &links_})
    for (const std::string& frame : frames)
      if (const auto link = links->find(frame);
          link != links->end() && link->second.header.frame_id != marker_frame)
        return &link->second;
  return nullptr;
}

const geometry_msgs::TransformStamped* LiveInput::OtherParent() const {
  std::vector<std::string> frames;
  for (const ImuInfo& imu : Info().imus) frames.push_back(imu.imu_frame);
  return OtherParent(frames);
}

std::string LiveInput::Dropped() const {
  std::string text;
  for (const Poses& poses : poses_)
    if (poses.foreign > 0)
      text += (text.empty() ? "" : "; ") + std::to_string(poses.foreign) +
              " poses of other frames than " + poses.world_frame + " -> " + poses.frame +
              " were dropped";
  return text;
}

bool LiveInput::IsLooking() const {
  return look_.valid() && look_.wait_for(std::chrono::seconds(0)) != std::future_status::ready;
}

std::string LiveInput::Look() {
  const ros::SteadyTime now = ros::SteadyTime::now();
  const bool hangs = IsLooking() && (now - look_start_).toSec() > kMasterTimeout;
  if (!IsLooking()) {
    if (look_.valid()) master_answers_ = look_.get();
    look_start_ = now;
    look_ = std::async(std::launch::async, [this] {
      ros::master::V_TopicInfo published;
      if (!ros::master::getTopics(published)) return false;
      ros::master::V_TopicInfo others;  // where the marker may be found
      const auto& sensors = request_.bag.pose_sensors;
      std::copy_if(published.begin(), published.end(), std::back_inserter(others),
                   [&](const ros::master::TopicInfo& topic) {
                     return std::count(sensors.begin(), sensors.end(), topic.name) == 0;
                   });
      for (TopicSource& source : sources_)
        if (!source.HasData()) source.Look(&source == poses_.front().topic ? others : published);
      return true;
    });
  }
  std::string problems;
  const auto say = [&](const std::string& sentence) {
    if (!sentence.empty()) problems += (problems.empty() ? "" : "; ") + sentence;
  };
  if (hangs || !master_answers_) {
    say("the ROS master does not answer");
  } else {
    for (const TopicSource& source : sources_)
      if (!source.HasData()) say(source.State());
  }
  const auto lacks = [&](const TopicSource& source, const std::string& sensor) {
    say(source.topic() + " gives no " + sensor + ": its covariance starts with -1");
  };
  for (const Imu& imu : imus_) {
    if (imu.lacks_gyro) lacks(*imu.gyro, "gyroscope");
    if (imu.lacks_accel) lacks(*imu.accel, "accelerometer");
  }
  if (poses_.front().chain && !live_->pose()) say(LookAt(*poses_.front().chain));
  for (size_t k = 1; k < poses_.size(); ++k)
    if (poses_[k].chain && !live_->HasSensorPoses(k - 1))
      say(poses_[k].name + ": " + LookAt(*poses_[k].chain));
  return problems;
}

}  // namespace imu_pose_calib
