#include "imu_pose_calib/ros/bag_reader.h"

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sensor_msgs/Imu.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <vector>

#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/ros/conversions.h"

namespace imu_pose_calib {
namespace {

const char kImuType[] = "sensor_msgs/Imu";

/// A pose as it comes out of any of the pose messages.
struct FramedPose {
  PoseSample pose;
  std::string world_frame, marker_frame;  ///< as in the message
};

template <typename Msg>
typename Msg::ConstPtr Instantiate(const rosbag::MessageInstance& instance) {
  const auto msg = instance.instantiate<Msg>();
  if (!msg)
    throw InputError("topic '" + instance.getTopic() + "' has another definition of " +
                     instance.getDataType() + " than this computer");
  return msg;
}

FramedPose ReadPoseStamped(const rosbag::MessageInstance& instance) {
  const auto msg = Instantiate<geometry_msgs::PoseStamped>(instance);
  return {ToPoseSample(msg->header.stamp, msg->pose), msg->header.frame_id, ""};
}

FramedPose ReadTransformStamped(const rosbag::MessageInstance& instance) {
  const auto msg = Instantiate<geometry_msgs::TransformStamped>(instance);
  return {
      ToPoseSample(msg->header.stamp, msg->transform), msg->header.frame_id, msg->child_frame_id};
}

/// The message types that hold poses, and how to read them.
struct PoseType {
  const char* name;
  FramedPose (*read)(const rosbag::MessageInstance&);
};
constexpr PoseType kPoseTypes[] = {
    {"geometry_msgs/PoseStamped", ReadPoseStamped},
    {"geometry_msgs/TransformStamped", ReadTransformStamped},
};

const PoseType* FindPoseType(const std::string& name) {
  for (const PoseType& type : kPoseTypes)
    if (name == type.name) return &type;
  return nullptr;
}

std::string PoseTypeNames() {
  std::string names;
  for (const PoseType& type : kPoseTypes)
    names += (names.empty() ? "" : " or ") + std::string(type.name);
  return names;
}

struct Topic {
  std::string name, type;
  uint32_t count = 0;
  bool IsImu() const { return type == kImuType; }
  bool IsPose() const { return FindPoseType(type) != nullptr; }
};

std::string Describe(const std::vector<Topic>& topics) {
  std::string text;
  for (const Topic& topic : topics)
    text += (text.empty() ? "" : ", ") + topic.name + " (" + topic.type + ", " +
            std::to_string(topic.count) + ")";
  return text;
}

/// Opens a bag or throws InputError with the reason and the remedy.
void Open(const std::string& path, rosbag::Bag* bag) {
  if (!std::filesystem::exists(path)) throw InputError("bag '" + path + "' does not exist");
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw InputError("bag '" + path + "' cannot be read: " + std::strerror(errno));

  std::string magic(7, '\0');
  file.read(magic.data(), 7);
  if (magic != "#ROSBAG") throw InputError("'" + path + "' is not a ROS 1 bag");
  try {
    bag->open(path);
  } catch (const rosbag::BagUnindexedException&) {
    throw InputError("bag '" + path + "' has no index, its recording was cut off; run: rosbag " +
                     "reindex " + path);
  } catch (const rosbag::BagException& error) {
    throw InputError("bag '" + path + "' is damaged or cut off (" + error.what() +
                     "); run: rosbag reindex " + path);
  }
}

/// One open bag, limited to the requested span of record time.
class BagFile {
 public:
  explicit BagFile(const BagRequest& request) : path_(request.path) {
    Open(path_, &bag_);
    SetSpan(request.start_s, request.duration_s);
    ListTopics();
  }

  const std::vector<Topic>& topics() const { return topics_; }

  /// Calls `use(message)` for the messages of a topic in the order of recording while it is true.
  template <typename Use>
  void ForEach(const Topic& topic, Use use) const {
    rosbag::View view(bag_, rosbag::TopicQuery(topic.name), start_, end_);
    for (const rosbag::MessageInstance& message : view)
      if (!use(message)) return;
  }

  /// The topic that `field` of the request names; InputError when the bag does not have it.
  const Topic& Find(const std::string& field, const std::string& name) const {
    for (const Topic& topic : topics_)
      if (topic.name == name) return topic;
    throw InputError(field + " '" + name + "' is not in " + Contents());
  }

  /// "NAME; it has: TOPICS" for error messages.
  std::string Contents() const {
    return std::filesystem::path(path_).filename().string() + "; it has: " + Describe(topics_);
  }

 private:
  void SetSpan(double start_s, double duration_s) {
    if (!(start_s >= 0.0))
      throw InputError("start = " + Seconds(start_s) + " must not be negative");
    if (!(duration_s >= 0.0))
      throw InputError("duration = " + Seconds(duration_s) + " must not be negative (0: all)");
    rosbag::View all(bag_);
    if (all.size() == 0) throw InputError("bag '" + path_ + "' holds no messages");
    const double length_s = (all.getEndTime() - all.getBeginTime()).toSec();
    if (start_s > length_s)
      throw InputError("start = " + Seconds(start_s) +
                       " is beyond the end of the bag, which lasts " + Seconds(length_s));
    start_ = all.getBeginTime() + ros::Duration(start_s);
    end_ = all.getEndTime();
    if (duration_s > 0.0 && start_s + duration_s < length_s)
      end_ = start_ + ros::Duration(duration_s);
  }

  void ListTopics() {
    std::map<std::string, std::string> types;
    for (const rosbag::ConnectionInfo* connection : rosbag::View(bag_).getConnections())
      types.emplace(connection->topic, connection->datatype);
    for (const auto& [name, type] : types)
      topics_.push_back(
          {name, type, rosbag::View(bag_, rosbag::TopicQuery(name), start_, end_).size()});
  }

  static std::string Seconds(double value) {
    std::ostringstream text;
    text << value << " s";
    return text.str();
  }

  std::string path_;
  rosbag::Bag bag_;
  ros::Time start_, end_;  ///< record time
  std::vector<Topic> topics_;
};

std::vector<Topic> Select(const std::vector<Topic>& topics, bool (*wanted)(const Topic&)) {
  std::vector<Topic> selected;
  for (const Topic& topic : topics)
    if (topic.count > 0 && wanted(topic)) selected.push_back(topic);
  return selected;
}

// --- Which topics ---

/// What the Imu messages of a topic carry.
struct ImuContent {
  bool gyro = false, accel = false;
};

/// A sensor is there when its covariance does not start with -1 (sensor_msgs/Imu) and its values
/// are not always exactly zero.
ImuContent FindContent(const BagFile& bag, const Topic& topic) {
  ImuContent content;
  bag.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
    const auto msg = Instantiate<sensor_msgs::Imu>(instance);
    if (msg->angular_velocity_covariance[0] != -1.0 && !ToGyroSample(*msg).value.isZero(0.0))
      content.gyro = true;
    if (msg->linear_acceleration_covariance[0] != -1.0 && !ToAccelSample(*msg).value.isZero(0.0))
      content.accel = true;
    return !(content.gyro && content.accel);
  });
  return content;
}

Topic NamedImu(const BagFile& bag, const std::string& field, const std::string& name) {
  const Topic& topic = bag.Find(field, name);
  if (!topic.IsImu())
    throw InputError(field + " '" + name + "' is " + topic.type + ", must be " + kImuType);
  return topic;
}

/// The topics of gyroscope and accelerometer; the same for an IMU on one topic.
struct ImuTopics {
  Topic gyro, accel;
};

ImuTopics FindImu(const BagFile& bag) {
  const std::vector<Topic> candidates =
      Select(bag.topics(), [](const Topic& t) { return t.IsImu(); });
  if (candidates.empty())
    throw InputError(std::string("no topic of type ") + kImuType + " in " + bag.Contents());
  if (candidates.size() == 1) return {candidates[0], candidates[0]};

  std::vector<Topic> gyros, accels;
  for (const Topic& topic : candidates) {
    const ImuContent content = FindContent(bag, topic);
    if (content.gyro) gyros.push_back(topic);
    if (content.accel) accels.push_back(topic);
  }
  if (gyros.size() != 1 || accels.size() != 1)
    throw InputError("several IMU topics: " + Describe(candidates) +
                     "; choose with imu_topic, or with gyro_topic and accel_topic");
  return {gyros[0], accels[0]};
}

ImuTopics ChooseImu(const BagFile& bag, const BagRequest& request) {
  const bool split = !request.gyro_topic.empty() || !request.accel_topic.empty();
  if (!split && request.imu_topic.empty()) return FindImu(bag);
  if (!split) {
    const Topic topic = NamedImu(bag, "imu_topic", request.imu_topic);
    return {topic, topic};
  }
  if (!request.imu_topic.empty())
    throw InputError("give either imu_topic, or gyro_topic and accel_topic, not all");
  if (request.gyro_topic.empty() || request.accel_topic.empty())
    throw InputError("gyro_topic and accel_topic belong together: " +
                     std::string(request.gyro_topic.empty() ? "gyro_topic" : "accel_topic") +
                     " is missing");
  return {NamedImu(bag, "gyro_topic", request.gyro_topic),
          NamedImu(bag, "accel_topic", request.accel_topic)};
}

/// A topic without the data that are to come from it is a mistake in the topics, not bad data.
void CheckContent(const BagFile& bag, const ImuTopics& imu) {
  const auto fail = [](const Topic& topic, const char* what) {
    throw InputError(
        "'" + topic.name + "' carries no " + what +
        " (all zero, or covariance -1); choose with imu_topic, or with gyro_topic and " +
        "accel_topic");
  };
  if (imu.gyro.count > 0 && !FindContent(bag, imu.gyro).gyro) fail(imu.gyro, "angular velocity");
  if (imu.accel.count > 0 && !FindContent(bag, imu.accel).accel)
    fail(imu.accel, "linear acceleration");
}

Topic ChoosePose(const BagFile& bag, const std::string& name) {
  if (!name.empty()) {
    const Topic& topic = bag.Find("pose_topic", name);
    if (!topic.IsPose())
      throw InputError("pose_topic '" + name + "' is " + topic.type + ", must be " +
                       PoseTypeNames());
    return topic;
  }
  const std::vector<Topic> candidates =
      Select(bag.topics(), [](const Topic& t) { return t.IsPose(); });
  if (candidates.empty())
    throw InputError("no topic of type " + PoseTypeNames() + " in " + bag.Contents());
  if (candidates.size() > 1)
    throw InputError("several pose topics: " + Describe(candidates) + "; choose with pose_topic");
  return candidates[0];
}

// --- Samples ---

template <typename Sample>
void CheckStamps(const std::string& topic, const std::vector<Sample>& samples) {
  const bool has_stamps =
      std::any_of(samples.begin(), samples.end(), [](const Sample& s) { return s.t_ns != 0; });
  if (!samples.empty() && !has_stamps)
    throw InputError("'" + topic + "' has no header stamps (all are 0); they are needed");
}

/// Record time minus stamp [s].
double Delay(const rosbag::MessageInstance& instance, int64_t stamp_ns) {
  return 1e-9 * static_cast<double>(ToNanoseconds(instance.getTime()) - stamp_ns);
}

Latency Summarise(std::vector<double> delays) {
  Latency latency;
  if (delays.empty()) return latency;
  latency.median_s = Median(delays);
  for (double& delay : delays) delay = std::abs(delay - latency.median_s);
  latency.spread_s = 1.4826 * Median(std::move(delays));
  return latency;
}

void ReadImu(const BagFile& bag, const ImuTopics& imu, Recording* recording) {
  std::string frame;
  std::vector<double> gyro_delays, accel_delays;
  bag.ForEach(imu.gyro, [&](const rosbag::MessageInstance& instance) {
    const auto msg = Instantiate<sensor_msgs::Imu>(instance);
    recording->data.gyro.push_back(ToGyroSample(*msg));
    gyro_delays.push_back(Delay(instance, recording->data.gyro.back().t_ns));
    frame = msg->header.frame_id;
    return true;
  });
  bag.ForEach(imu.accel, [&](const rosbag::MessageInstance& instance) {
    recording->data.accel.push_back(ToAccelSample(*Instantiate<sensor_msgs::Imu>(instance)));
    accel_delays.push_back(Delay(instance, recording->data.accel.back().t_ns));
    return true;
  });
  CheckStamps(imu.gyro.name, recording->data.gyro);
  CheckStamps(imu.accel.name, recording->data.accel);
  recording->info.imu_frame = FrameName(frame, "imu");
  recording->info.gyro_latency = Summarise(std::move(gyro_delays));
  recording->info.accel_latency = Summarise(std::move(accel_delays));
}

void ReadPoses(const BagFile& bag, const Topic& topic, Recording* recording) {
  const PoseType& type = *FindPoseType(topic.type);
  FramedPose first;
  std::vector<double> delays;
  bag.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
    const FramedPose framed = type.read(instance);
    if (recording->data.poses.empty()) first = framed;
    if (framed.world_frame != first.world_frame || framed.marker_frame != first.marker_frame)
      throw InputError("pose_topic '" + topic.name + "' mixes poses of several frames: '" +
                       first.world_frame + "' -> '" + first.marker_frame + "' and '" +
                       framed.world_frame + "' -> '" + framed.marker_frame + "'");
    recording->data.poses.push_back(framed.pose);
    delays.push_back(Delay(instance, framed.pose.t_ns));
    return true;
  });
  CheckStamps(topic.name, recording->data.poses);
  recording->info.pose_latency = Summarise(std::move(delays));
  recording->info.world_frame = FrameName(first.world_frame, "world");
  recording->info.marker_frame = FrameName(first.marker_frame, "marker");
}

Recording Read(const BagRequest& request) {
  const BagFile bag(request);
  const ImuTopics imu = ChooseImu(bag, request);
  const Topic pose = ChoosePose(bag, request.pose_topic);
  CheckContent(bag, imu);

  Recording recording;
  recording.info.bag = request.path;
  recording.info.pose_topic = pose.name;
  if (imu.gyro.name == imu.accel.name) {
    recording.info.imu_topic = imu.gyro.name;
  } else {
    recording.info.gyro_topic = imu.gyro.name;
    recording.info.accel_topic = imu.accel.name;
  }
  ReadImu(bag, imu, &recording);
  ReadPoses(bag, pose, &recording);
  return recording;
}

}  // namespace

Recording ReadBag(const BagRequest& request) {
  try {
    return Read(request);
  } catch (const ros::Exception& error) {  // rosbag and deserialisation
    throw InputError("bag '" + request.path + "' is damaged (" + error.what() +
                     "); run: rosbag reindex " + request.path);
  }
}

}  // namespace imu_pose_calib
