#include "imu_pose_calib/ros/live/live_input.h"

#include <boost/function.hpp>

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
  if (topics.tf_parent.empty())
    AddSource("pose_topic", topics.pose_topic, PoseTypeNames(),
              [this](const TopicSource::Message& message) { OnPose(message); });
  else
    chain_.emplace(topics.tf_parent, topics.tf_child, kTfCache);
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

void LiveInput::OnPose(const TopicSource::Message& message) {
  const FramedPose framed = ReadPose(message.getMessage()->getDataType(), *message.getMessage());
  const std::string world_frame = FrameName(framed.world_frame, "world");
  const std::string marker_frame = FrameName(framed.marker_frame, "marker");
  if (world_frame_.empty()) {
    world_frame_ = world_frame;
    marker_frame_ = marker_frame;
  }
  if (world_frame == world_frame_ && marker_frame == marker_frame_)
    AddPose(framed.pose, message.getReceiptTime());
  else
    ++foreign_poses_;
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
  if (!chain_) return;
  chain_->Add(*event.getMessage(), fixed);
  for (const PoseSample& pose : chain_->TakePoses()) AddPose(pose, ros::Time::now());
}

void LiveInput::ForgetAfterReset() {
  if (resets_ == live_->resets()) return;
  resets_ = live_->resets();
  // Only the static transforms stay: they are not sent again.
  for (Imu& imu : imus_) imu.frame.clear();
  foreign_poses_ = 0;
  links_.clear();
  world_frame_.clear();
  marker_frame_.clear();
  if (!chain_) return;
  chain_.emplace(request_.bag.tf_parent, request_.bag.tf_child, kTfCache);
  tf2_msgs::TFMessage fixed;
  for (const auto& [child, link] : fixed_links_) fixed.transforms.push_back(link);
  chain_->Add(fixed, true);
}

void LiveInput::AddPose(const PoseSample& recorded, const ros::Time& now) {
  if (live_->AddPose(recorded, now.toSec())) on_pose_(*live_->pose());
}

RecordingInfo LiveInput::Info() const {
  RecordingInfo info;
  info.world_frame = FrameName(chain_ ? request_.bag.tf_parent : world_frame_, "world");
  info.marker_frame = FrameName(chain_ ? request_.bag.tf_child : marker_frame_, "marker");
  info.pose_topic = chain_ ? "/tf" : sources_.back().topic();
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

const geometry_msgs::TransformStamped* LiveInput::OtherParent() const {
  const RecordingInfo info = Info();
  for (const Links* links : {&fixed_links_, &links_})
    for (const ImuInfo& imu : info.imus)
      if (const auto link = links->find(imu.imu_frame);
          link != links->end() && link->second.header.frame_id != info.marker_frame)
        return &link->second;
  return nullptr;
}

std::string LiveInput::Dropped() const {
  if (foreign_poses_ == 0) return "";
  return std::to_string(foreign_poses_) + " poses of other frames than " + world_frame_ + " -> " +
         marker_frame_ + " were dropped";
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
      for (TopicSource& source : sources_)
        if (!source.HasData()) source.Look(published);
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
  if (chain_ && !live_->pose()) say(LookAt(*chain_));
  return problems;
}

}  // namespace imu_pose_calib
