#include "imu_pose_calib/ros/live/live_input.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>

#include "imu_pose_calib/ros/io/conversions.h"

namespace imu_pose_calib {
namespace {

/// How far apart links of tf with the same stamp may arrive [s].
constexpr double kTfCache = 10.0;
/// After this the master counts as away [s].
constexpr double kMasterTimeout = 2.0;

/// Types without their packages.
std::string ShortNames(std::vector<std::string> types) {
  for (std::string& type : types) type.erase(0, type.find('/') + 1);
  return boost::join(types, ", ");
}

/// What nodes of this package publish is no input.
bool IsOurs(const std::string& topic) { return boost::algorithm::ends_with(topic, "/imu_pose"); }

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
  const BagRequest& names = request_.bag;
  const bool is_split = !names.gyro_topic.empty();
  const std::vector<std::string> gyros = SplitNames(is_split ? names.gyro_topic : names.imu_topic),
                                 accels = SplitNames(names.accel_topic);
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
  const TfFrames marker(FrameName(names.tf_parent, ""), FrameName(names.tf_child, ""));
  ListenToPoses("pose_topic", names.pose_topic,
                names.tf_parent.empty() ? std::nullopt : std::optional(marker));
  for (const std::string& name : names.pose_sensors)
    ListenToPoses("pose_sensor", name, SplitTf(name));
  for (const bool fixed : {false, true})
    tf_.push_back(node_.subscribe<tf2_msgs::TFMessage>(
        fixed ? "/tf_static" : "/tf", 0,
        boost::function<void(const TfEvent&)>(
            [this, fixed](const TfEvent& event) { OnTransforms(event, fixed); })));
}

// --- Topics ---

void LiveInput::ListenToPoses(const std::string& parameter, const std::string& name,
                              const std::optional<TfFrames>& tf) {
  const size_t source = poses_.size();
  Poses& poses = poses_.emplace_back();
  poses.info.topic = tf && name.empty() ? "/tf" : name;
  poses.tf = tf;
  poses.Forget({});
  if (tf) return;
  const auto read = [this, source](const Message& message) {
    OnPose(message, source);
    return "";
  };
  Listen(parameter, name, &poses.info.topic, PoseTypeNames(), read);
}

void LiveInput::Listen(const std::string& parameter, const std::string& name, std::string* topic,
                       const std::vector<std::string>& types, const Read& read) {
  *topic = name.empty() ? "" : ros::names::resolve(name);
  topics_.push_back({parameter, topic, types, read});
  if (!name.empty()) Subscribe(&topics_.back());
}

void LiveInput::Subscribe(Topic* topic) {
  topic->subscriber = node_.subscribe<topic_tools::ShapeShifter>(
      *topic->name,
      0,  // a queue without bound
      boost::function<void(const Message&)>(
          [this, topic](const Message& message) { OnMessage(message, topic); }),
      ros::VoidConstPtr(), ros::TransportHints().tcpNoDelay());
}

void LiveInput::OnMessage(const Message& message, Topic* topic) {
  const std::lock_guard<std::mutex> lock(*mutex_);
  const std::string& type = message.getMessage()->getDataType();
  if (!topic->Accepts(type)) {
    topic->problem = "is " + type + ", must be " + boost::join(topic->types, " or ");
    return;
  }
  ForgetAfterReset();
  try {
    topic->problem = topic->read(message);
    topic->has_data = true;
  } catch (const ros::Exception& error) {
    topic->problem =
        "has another definition of " + type + " than this computer (" + error.what() + ")";
  }
}

bool LiveInput::Topic::Accepts(const std::string& type) const {
  return std::find(types.begin(), types.end(), type) != types.end();
}

std::string LiveInput::Topic::Find(const ros::master::V_TopicInfo& published,
                                   const std::vector<std::string>& others) {
  std::vector<std::string> found;
  for (const ros::master::TopicInfo& info : published)
    if (Accepts(info.datatype) && !IsOurs(info.name) &&
        std::find(others.begin(), others.end(), info.name) == others.end())
      found.push_back(info.name);
  if (found.size() == 1) return found.front();
  const std::string all = boost::join(types, " or ");
  state = found.empty() ? "no topic of type " + all + " is published"
                        : "several topics of type " + all + ": " + boost::join(found, ", ") +
                              "; choose with " + parameter;
  return "";
}

std::string LiveInput::Topic::Inspect(const ros::master::V_TopicInfo& published) const {
  const auto info = std::find_if(published.begin(), published.end(),
                                 [&](const auto& candidate) { return candidate.name == *name; });
  const int seconds = static_cast<int>((ros::SteadyTime::now() - start).toSec());
  const std::string waited = " for " + std::to_string(seconds) + " s";
  if (info == published.end())
    return *name + " (" + ShortNames(types) + "): nobody has published it" + waited;
  if (!Accepts(info->datatype))
    return *name + " is " + info->datatype + ", must be " + boost::join(types, " or ");
  return *name + " (" + info->datatype +
         ", publishers connected: " + std::to_string(subscriber.getNumPublishers()) +
         "): no message" + waited;
}

bool LiveInput::AskMaster() {
  ros::master::V_TopicInfo published;
  if (!ros::master::getTopics(published)) return false;
  for (Topic& topic : topics_) {
    std::unique_lock<std::mutex> lock(*mutex_);
    if (topic.has_data) continue;
    topic.state.clear();
    const std::string found =
        topic.is_named ? *topic.name : topic.Find(published, request_.bag.pose_sensors);
    const bool is_new = !found.empty() && found != *topic.name;
    if (is_new) *topic.name = found;
    if (topic.state.empty()) topic.state = topic.Inspect(published);
    lock.unlock();
    if (is_new) Subscribe(&topic);
  }
  return true;
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
    look_ = std::async(std::launch::async, [this] { return AskMaster(); });
  }
  std::vector<std::string> problems;
  const bool is_away = hangs || !master_answers_;
  if (is_away) problems.emplace_back("the ROS master does not answer");
  for (const Topic& topic : topics_)
    if (!topic.problem.empty())
      problems.push_back(*topic.name + " " + topic.problem);
    else if (!topic.has_data && !topic.state.empty() && !is_away)
      problems.push_back(topic.state);
  for (size_t k = 0; k < poses_.size(); ++k)
    if (poses_[k].chain && !live_->HasPoses(k))
      problems.push_back((k > 0 ? poses_[k].info.topic + ": " : "") + LookAt(*poses_[k].chain));
  return boost::join(problems, "; ");
}

// --- Messages ---

std::string LiveInput::OnImu(const Message& message, size_t imu, bool is_gyro, bool is_accel) {
  const auto& [gyro, accel, frame] =
      ReadImuContent(message.getMessage()->getDataType(), *message.getMessage());
  const double now = message.getReceiptTime().toSec();
  if (is_gyro) imus_[imu].imu_frame = frame;
  if (is_gyro && gyro) live_->AddGyro(*gyro, now, imu);
  if (is_accel && accel) live_->AddAccel(*accel, now, imu);
  std::vector<std::string> lacks;
  if (is_gyro && !gyro) lacks.emplace_back("no gyroscope");
  if (is_accel && !accel) lacks.emplace_back("no accelerometer");
  if (lacks.empty()) return "";
  return "gives " + boost::join(lacks, " and ") + ": its covariance starts with -1";
}

void LiveInput::OnPose(const Message& message, size_t source) {
  const FramedPose framed = ReadPose(message.getMessage()->getDataType(), *message.getMessage());
  Poses& poses = poses_[source];
  const PoseSensorInfo named = Named(source, framed.world_frame, framed.marker_frame);
  if (poses.info.world_frame.empty()) poses.info = named;
  if (named.world_frame == poses.info.world_frame && named.frame == poses.info.frame)
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

void LiveInput::AddPose(const PoseSample& recorded, const ros::Time& now, size_t source) {
  if (live_->AddPose(recorded, now.toSec(), source)) on_pose_(*live_->pose());
}

void LiveInput::ForgetAfterReset() {
  if (resets_ == live_->resets()) return;
  resets_ = live_->resets();
  for (ImuInfo& imu : imus_) imu.imu_frame.clear();
  for (Poses& poses : poses_) poses.Forget(fixed_links_);
  links_.clear();
}

void LiveInput::Poses::Forget(const Links& fixed_links) {
  foreign = 0;
  info.world_frame = tf ? tf->first : "";
  info.frame = tf ? tf->second : "";
  if (!tf) return;
  chain.emplace(tf->first, tf->second, kTfCache);
  tf2_msgs::TFMessage fixed;
  for (const auto& [child, link] : fixed_links) fixed.transforms.push_back(link);
  chain->Add(fixed, true);
}

// --- What the messages say ---

PoseSensorInfo LiveInput::Named(size_t source, const std::string& world_frame,
                                const std::string& frame) const {
  const std::string& topic = poses_[source].info.topic;
  if (source > 0) return NamePoseSensor(topic, world_frame, frame);
  return {topic, FrameName(frame, "marker"), FrameName(world_frame, "world")};
}

RecordingInfo LiveInput::Info() const {
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

const geometry_msgs::TransformStamped* LiveInput::OtherParent(const std::string& frame) const {
  const std::string marker_frame = Info().marker_frame;
  for (const Links* links : {&fixed_links_, &links_})
    if (const auto link = links->find(frame);
        link != links->end() && link->second.header.frame_id != marker_frame)
      return &link->second;
  return nullptr;
}

std::string LiveInput::Dropped() const {
  std::vector<std::string> notes;
  for (const Poses& poses : poses_)
    if (poses.foreign > 0)
      notes.push_back(std::to_string(poses.foreign) + " poses of other frames than " +
                      poses.info.world_frame + " -> " + poses.info.frame + " were dropped");
  return boost::join(notes, "; ");
}

}  // namespace imu_pose_calib
