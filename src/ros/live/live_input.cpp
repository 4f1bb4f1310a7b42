#include "imu_pose_calib/ros/live/live_input.h"

#include <boost/function.hpp>

#include "imu_pose_calib/ros/io/conversions.h"

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

}  // namespace

LiveInput::LiveInput(const ros::NodeHandle& node, const LiveSettings& settings, std::mutex* mutex,
                     LiveCalibration* live, const std::function<void(const PoseSample&)>& on_pose)
    : node_(node), settings_(settings), mutex_(mutex), live_(live), on_pose_(on_pose) {
  const std::vector<std::string> split = {kImuType, kVectorType};
  const bool is_split = !settings_.gyro_topic.empty();
  const std::vector<std::string> gyros =
      SplitNames(is_split ? settings_.gyro_topic : settings_.imu_topic);
  const std::vector<std::string> accels = SplitNames(settings_.accel_topic);
  for (size_t i = 0; i < gyros.size(); ++i) {
    const auto listen = [this, i](bool is_gyro, bool is_accel) {
      return [=](const TopicSource::Message& m) { OnImu(m, i, is_gyro, is_accel); };
    };
    if (is_split) {
      AddSource("gyro_topic", gyros[i], split, listen(true, false));
      const TopicSource* gyro = &sources_.back();
      AddSource("accel_topic", accels[i], split, listen(false, true));
      imus_.push_back({gyro, &sources_.back(), ""});
    } else {
      AddSource("imu_topic", gyros[i], {kImuType}, listen(true, true));
      imus_.push_back({&sources_.back(), &sources_.back(), ""});
    }
  }
  if (settings_.tf_parent.empty()) {
    AddSource("pose_topic", settings_.pose_topic, PoseTypeNames(),
              [this](const TopicSource::Message& message) { OnPose(message); });
  } else {
    chain_.emplace(settings_.tf_parent, settings_.tf_child, kTfCache);
    world_frame_ = FrameName(settings_.tf_parent, "");
    marker_frame_ = FrameName(settings_.tf_child, "");
  }
  using TfEvent = ros::MessageEvent<const tf2_msgs::TFMessage>;
  for (const bool fixed : {false, true})
    tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
        fixed ? "/tf_static" : "/tf", 0,
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

void LiveInput::AddSource(const std::string& parameter, const std::string& topic,
                          const std::vector<std::string>& types, const TopicSource::Callback& add) {
  sources_.emplace_back(node_, parameter, topic, types,
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
  for (Imu& imu : imus_) imu.frame.clear();
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
  info.marker_frame = FrameName(marker_frame_, "marker");
  info.pose_topic = chain_ ? "/tf" : sources_.back().topic();
  info.imus.resize(imus_.size());
  for (size_t i = 0; i < imus_.size(); ++i) {
    info.imus[i].imu_frame = FrameName(imus_[i].frame, "imu");
    if (imus_[i].gyro == imus_[i].accel) {
      info.imus[i].imu_topic = imus_[i].gyro->topic();
    } else {
      info.imus[i].gyro_topic = imus_[i].gyro->topic();
      info.imus[i].accel_topic = imus_[i].accel->topic();
    }
  }
  info.imu_yaml = settings_.imu_yaml;
  NameFrames(settings_.marker_frame, settings_.imu_frame, &info);
  return info;
}

LiveInput::ForeignLink LiveInput::OtherParent() const {
  const RecordingInfo info = Info();
  for (const auto* parents : {&fixed_parents_, &parents_}) {
    for (const ImuInfo& imu : info.imus) {
      const auto link = parents->find(imu.imu_frame);
      if (link != parents->end() && link->second != info.marker_frame)
        return {imu.imu_frame, link->second};
    }
  }
  return {};
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
  const auto lacks = [&](const TopicSource& source, const char* sensor) {
    Append(source.topic() + " gives no " + sensor + ": its covariance starts with -1", &problems);
  };
  for (const Imu& imu : imus_) {
    if (imu.lacks_gyro) lacks(*imu.gyro, "gyroscope");
    if (imu.lacks_accel) lacks(*imu.accel, "accelerometer");
  }
  if (chain_ && !live_->pose()) Append(LookAt(*chain_), &problems);
  return problems;
}

}  // namespace imu_pose_calib
