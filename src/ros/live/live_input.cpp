#include "imu_pose_calib/ros/live/live_input.h"

#include <boost/function.hpp>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/pose_messages.h"

namespace imu_pose_calib {
namespace {

/// How far apart links of tf with the same stamp may arrive [s].
constexpr double kTfCache = 10.0;
/// After this the master counts as away [s].
constexpr double kMasterTimeout = 2.0;

void Append(const std::string& sentence, std::string* text) {
  if (sentence.empty()) return;
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

/// What one message of an IMU gives; a vector may be of either sensor.
struct ImuContent {
  std::optional<ImuSample> gyro, accel;
  std::string frame;
};

ImuContent ReadImu(const topic_tools::ShapeShifter& message) {
  ImuContent content;
  if (message.getDataType() == kVectorType) {
    const auto vector = message.instantiate<geometry_msgs::Vector3Stamped>();
    content.gyro = content.accel = ToImuSample(*vector);
    content.frame = vector->header.frame_id;
  } else {
    const auto imu = message.instantiate<sensor_msgs::Imu>();
    if (IsGiven(imu->angular_velocity_covariance)) content.gyro = ToGyroSample(*imu);
    if (IsGiven(imu->linear_acceleration_covariance)) content.accel = ToAccelSample(*imu);
    content.frame = imu->header.frame_id;
  }
  return content;
}

}  // namespace

LiveInput::LiveInput(const ros::NodeHandle& node,
                     const LiveSettings& settings,
                     std::mutex* mutex,
                     LiveCalibration* live,
                     const std::function<void(const PoseSample&)>& on_pose)
    : node_(node), settings_(settings), mutex_(mutex), live_(live), on_pose_(on_pose) {
  const std::vector<std::string> split = {kImuType, kVectorType};
  if (settings_.gyro_topic.empty()) {
    AddSource("imu_topic", settings_.imu_topic, {kImuType}, &LiveInput::OnImu);
  } else {
    AddSource("gyro_topic", settings_.gyro_topic, split, &LiveInput::OnGyro);
    AddSource("accel_topic", settings_.accel_topic, split, &LiveInput::OnAccel);
  }
  if (settings_.tf_parent.empty()) {
    AddSource("pose_topic", settings_.pose_topic, PoseTypeNames(), &LiveInput::OnPose);
  } else {
    chain_.emplace(settings_.tf_parent, settings_.tf_child, kTfCache);
    world_frame_ = FrameName(settings_.tf_parent, "");
    marker_frame_ = FrameName(settings_.tf_child, "");
  }
  using TfEvent = ros::MessageEvent<const tf2_msgs::TFMessage>;
  for (const bool fixed : {false, true})
    tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
        fixed ? "/tf_static" : "/tf",
        0,
        boost::function<void(const TfEvent&)>(
            [this, fixed](const TfEvent& event) { OnTransforms(event, fixed); })));
  thread_ = std::thread([this] { AskMaster(); });
}

LiveInput::~LiveInput() {
  {
    const std::lock_guard<std::mutex> lock(*mutex_);
    is_ending_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void LiveInput::AddSource(const std::string& parameter,
                          const std::string& topic,
                          const std::vector<std::string>& types,
                          void (LiveInput::*add)(const TopicSource::Message&)) {
  sources_.emplace_back(
      node_, parameter, topic, types, [this, add](const TopicSource::Message& message) {
        const std::lock_guard<std::mutex> lock(*mutex_);
        ForgetAfterReset();
        (this->*add)(message);
      });
}

void LiveInput::OnImu(const TopicSource::Message& message) {
  OnGyro(message);
  OnAccel(message);
}

void LiveInput::OnGyro(const TopicSource::Message& message) {
  const ImuContent content = ReadImu(*message.getMessage());
  imu_frame_ = content.frame;
  lacks_gyro_ = !content.gyro;
  if (content.gyro) live_->AddGyro(*content.gyro, message.getReceiptTime().toSec());
}

void LiveInput::OnAccel(const TopicSource::Message& message) {
  const ImuContent content = ReadImu(*message.getMessage());
  lacks_accel_ = !content.accel;
  if (content.accel) live_->AddAccel(*content.accel, message.getReceiptTime().toSec());
}

void LiveInput::OnPose(const TopicSource::Message& message) {
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

void LiveInput::OnTransforms(const ros::MessageEvent<const tf2_msgs::TFMessage>& event,
                             bool fixed) {
  const std::lock_guard<std::mutex> lock(*mutex_);
  ForgetAfterReset();
  const tf2_msgs::TFMessage& message = *event.getMessage();
  if (event.getPublisherName() != ros::this_node::getName())
    for (const geometry_msgs::TransformStamped& transform : message.transforms)
      (fixed ? fixed_parents_ : parents_)[FrameName(transform.child_frame_id, "")] =
          FrameName(transform.header.frame_id, "");
  if (!chain_) return;
  if (fixed)
    for (const auto& transform : message.transforms)
      fixed_links_[transform.child_frame_id] = transform;
  chain_->Add(message, fixed);
  for (const PoseSample& pose : chain_->TakePoses()) AddPose(pose, ros::Time::now());
}

void LiveInput::ForgetAfterReset() {
  if (resets_ == live_->resets()) return;
  resets_ = live_->resets();
  // Only the static transforms stay: they are not sent again.
  imu_frame_.clear();
  foreign_poses_ = 0;
  parents_.clear();
  if (!chain_) {
    world_frame_.clear();
    marker_frame_.clear();
    return;
  }
  chain_.emplace(settings_.tf_parent, settings_.tf_child, kTfCache);
  tf2_msgs::TFMessage links;
  for (const auto& [child, transform] : fixed_links_) links.transforms.push_back(transform);
  chain_->Add(links, true);
}

void LiveInput::AddPose(const PoseSample& recorded, const ros::Time& now) {
  if (live_->AddPose(recorded, now.toSec())) on_pose_(*live_->pose());
}

RecordingInfo LiveInput::Info() const {
  RecordingInfo info;
  info.world_frame = FrameName(world_frame_, "world");
  info.marker_frame = FrameName(settings_.marker_frame, FrameName(marker_frame_, "marker"));
  info.imus[0].imu_frame = FrameName(settings_.imu_frame, FrameName(imu_frame_, "imu"));
  info.pose_topic = chain_ ? "/tf" : sources_.back().topic();
  if (settings_.gyro_topic.empty()) {
    info.imus[0].imu_topic = sources_.front().topic();
  } else {
    info.imus[0].gyro_topic = settings_.gyro_topic;
    info.imus[0].accel_topic = settings_.accel_topic;
  }
  info.imu_yaml = settings_.imu_yaml;
  return info;
}

std::string LiveInput::OtherParent() const {
  const RecordingInfo info = Info();
  for (const auto* parents : {&fixed_parents_, &parents_}) {
    const auto link = parents->find(info.imus[0].imu_frame);
    if (link != parents->end() && link->second != info.marker_frame) return link->second;
  }
  return "";
}

std::string LiveInput::Dropped() const {
  if (foreign_poses_ == 0) return "";
  return std::to_string(foreign_poses_) + " poses of other frames than " + world_frame_ + " -> " +
         marker_frame_ + " were dropped";
}

/// Looks whenever it is asked for.
void LiveInput::AskMaster() {
  std::unique_lock<std::mutex> lock(*mutex_);
  while (true) {
    changed_.wait(lock, [&] { return is_looking_ || is_ending_; });
    if (is_ending_) return;
    lock.unlock();
    ros::master::V_TopicInfo published;
    const bool answers = ros::master::getTopics(published);
    if (answers)
      for (TopicSource& source : sources_)
        if (!source.HasData()) source.Look(published);
    lock.lock();
    is_looking_ = false;
    master_answers_ = answers;
  }
}

std::string LiveInput::Look() {
  const ros::SteadyTime now = ros::SteadyTime::now();
  const bool hangs = is_looking_ && (now - look_start_).toSec() > kMasterTimeout;
  if (!is_looking_) {
    is_looking_ = true;
    look_start_ = now;
    changed_.notify_all();
  }
  std::string problems;
  if (hangs || !master_answers_) {
    problems = "the ROS master does not answer";
  } else {
    for (const TopicSource& source : sources_)
      if (!source.HasData()) Append(source.State(), &problems);
  }
  const RecordingInfo info = Info();
  const auto lacks = [&](const std::string& topic, const std::string& sensor) {
    Append((info.imus[0].imu_topic.empty() ? topic : info.imus[0].imu_topic) + " gives no " +
               sensor + ": its covariance starts with -1",
           &problems);
  };
  if (lacks_gyro_) lacks(info.imus[0].gyro_topic, "gyroscope");
  if (lacks_accel_) lacks(info.imus[0].accel_topic, "accelerometer");
  if (chain_ && !live_->pose()) Append(LookAt(*chain_), &problems);
  return problems;
}

}  // namespace imu_pose_calib
