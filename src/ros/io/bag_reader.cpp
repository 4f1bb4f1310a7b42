#include "imu_pose_calib/ros/io/bag_reader.h"

#include <console_bridge/console.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <set>
#include <sstream>
#include <vector>

#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/pose_messages.h"
#include "imu_pose_calib/ros/io/tf_chain.h"

namespace imu_pose_calib {
namespace {

template <typename Msg>
boost::shared_ptr<Msg> Instantiate(const rosbag::MessageInstance& instance) {
  auto msg = instance.instantiate<Msg>();
  if (!msg)
    throw InputError("topic '" + instance.getTopic() + "' has another definition of " +
                     instance.getDataType() + " than this computer");
  return msg;
}

// --- Message types ---

/// A message of a bag, as PoseType reads it.
struct BagMessage {
  const rosbag::MessageInstance& instance;
  template <typename Msg>
  boost::shared_ptr<Msg> instantiate() const {
    return Instantiate<Msg>(instance);
  }
};

std::string PoseTypeList() {
  std::string list;
  for (const std::string& name : PoseTypeNames()) list += (list.empty() ? "" : " or ") + name;
  return list;
}

/// What a message of an IMU topic carries.
struct ImuContent {
  std::optional<ImuSample> gyro, accel;
  std::string frame;
};

/// A vector may be either sensor.
ImuContent ReadImuMessage(const rosbag::MessageInstance& instance) {
  ImuContent content;
  if (instance.getDataType() == kVectorType) {
    const auto msg = Instantiate<geometry_msgs::Vector3Stamped>(instance);
    content.gyro = content.accel = ToImuSample(*msg);
    content.frame = msg->header.frame_id;
  } else {
    const auto msg = Instantiate<sensor_msgs::Imu>(instance);
    if (IsGiven(msg->angular_velocity_covariance)) content.gyro = ToGyroSample(*msg);
    if (IsGiven(msg->linear_acceleration_covariance)) content.accel = ToAccelSample(*msg);
    content.frame = msg->header.frame_id;
  }
  return content;
}

// --- Bags ---

struct Topic {
  std::string name, type;
  uint32_t count = 0;
  bool IsImu() const { return type == kImuType; }
  bool IsVector() const { return type == kVectorType; }
  bool IsPose() const { return FindPoseType<BagMessage>(type) != nullptr; }
  bool IsTf() const { return type == "tf2_msgs/TFMessage" || type == "tf/tfMessage"; }
  bool IsFixedTf() const {
    const std::string ending = "tf_static";
    return IsTf() && name.size() >= ending.size() &&
           name.compare(name.size() - ending.size(), ending.size(), ending) == 0;
  }
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

  const std::string magic = "#ROSBAG V";
  std::string header(magic.size() + 3, '\0');
  file.read(header.data(), static_cast<std::streamsize>(header.size()));
  if (header.compare(0, magic.size(), magic) != 0)
    throw InputError("'" + path + "' is not a ROS 1 bag");
  const std::string version = header.substr(magic.size());
  if (version != "1.2" && version != "2.0")
    throw InputError("bag '" + path + "' is of version " + version + ", must be 1.2 or 2.0");
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

std::string FileNames(const std::vector<std::string>& paths) {
  std::string names;
  for (const std::string& path : paths)
    names += (names.empty() ? "" : ", ") + std::filesystem::path(path).filename().string();
  return names;
}

std::string Seconds(double value) {
  std::ostringstream text;
  text << value << " s";
  return text.str();
}

/// Open bags as one recording, limited to the requested span of record time.
class Bags {
 public:
  explicit Bags(const BagRequest& request) : paths_(request.paths) {
    std::set<std::filesystem::path> known;
    for (const std::string& path : paths_) {
      bags_.push_back(std::make_unique<rosbag::Bag>());
      Open(path, bags_.back().get());
      if (!known.insert(std::filesystem::canonical(path)).second)
        throw InputError("bag '" + path + "' is given twice");
    }
    SetSpan(request.start_s, request.duration_s);
    ListTopics();
  }

  const std::vector<Topic>& topics() const { return topics_; }
  double duration_s() const { return (end_ - begin_).toSec(); }

  /// Calls `use(message)` for the messages of a topic in the order of recording while it is true.
  template <typename Use>
  void ForEach(const Topic& topic, Use use) const {
    const auto view = View({topic}, start_, end_);
    for (const rosbag::MessageInstance& message : *view)
      if (!use(message)) return;
  }

  /// Calls `use(message)` for the tf messages: first all fixed ones of the whole bags, which are
  /// sent once, then the others in the order of recording.
  template <typename Use>
  void ForEachTf(Use use) const {
    const auto fixed = [](const Topic& topic) { return topic.IsFixedTf(); };
    const auto moving = [](const Topic& topic) { return topic.IsTf() && !topic.IsFixedTf(); };
    const auto all_fixed = View(Select(fixed), begin_, bag_end_);
    for (const rosbag::MessageInstance& message : *all_fixed) use(message, true);
    const auto all_moving = View(Select(moving), start_, end_);
    for (const rosbag::MessageInstance& message : *all_moving) use(message, false);
  }

  /// The topic that `field` of the request names; InputError when the bags do not have it.
  const Topic& Find(const std::string& field, const std::string& name) const {
    for (const Topic& topic : topics_) {
      if (topic.name != name) continue;
      if (topic.count == 0)
        throw InputError(field + " '" + name + "' has no messages within the span used (" +
                         Seconds((start_ - begin_).toSec()) + " to " + Seconds(duration_s()) +
                         " after the start)");
      return topic;
    }
    throw InputError(field + " '" + name + "' is not in " + Contents());
  }

  template <typename Wanted>
  std::vector<Topic> Select(Wanted wanted) const {
    std::vector<Topic> selected;
    for (const Topic& topic : topics_)
      if (wanted(topic)) selected.push_back(topic);
    return selected;
  }

  /// "NAMES; it has: TOPICS" for error messages.
  std::string Contents() const { return FileNames(paths_) + "; it has: " + Describe(topics_); }

 private:
  std::unique_ptr<rosbag::View> View(const std::vector<Topic>& topics,
                                     const ros::Time& start,
                                     const ros::Time& end) const {
    std::vector<std::string> names;
    for (const Topic& topic : topics) names.push_back(topic.name);
    auto view = std::make_unique<rosbag::View>();
    if (names.empty()) return view;
    for (const auto& bag : bags_) view->addQuery(*bag, rosbag::TopicQuery(names), start, end);
    return view;
  }

  void SetSpan(double start_s, double duration_s) {
    CheckSpan(start_s, duration_s);
    rosbag::View all;
    for (const auto& bag : bags_) all.addQuery(*bag);
    if (all.size() == 0) throw InputError("bag '" + FileNames(paths_) + "' holds no messages");
    begin_ = all.getBeginTime();
    bag_end_ = all.getEndTime();
    const double length_s = (bag_end_ - begin_).toSec();
    if (start_s > length_s)
      throw InputError("start = " + Seconds(start_s) +
                       " is beyond the end of the bag, which lasts " + Seconds(length_s));
    start_ = begin_ + ros::Duration(start_s);
    end_ = bag_end_;
    if (duration_s > 0.0 && start_s + duration_s < length_s)
      end_ = start_ + ros::Duration(duration_s);
  }

  void ListTopics() {
    std::map<std::string, std::set<std::string>> types;
    for (const auto& bag : bags_) {
      rosbag::View view(*bag);
      for (const rosbag::ConnectionInfo* connection : view.getConnections())
        types[connection->topic].insert(connection->datatype);
    }
    for (const auto& [name, names] : types) {
      Topic topic{name, *names.begin()};
      if (names.size() > 1) topic.type += " and " + *names.rbegin();  // fits no role
      topic.count = View({topic}, start_, end_)->size();
      topics_.push_back(topic);
    }
  }

  std::vector<std::string> paths_;
  std::vector<std::unique_ptr<rosbag::Bag>> bags_;
  ros::Time begin_, bag_end_;  ///< record time of the first and last message
  ros::Time start_, end_;      ///< record time, the span to use
  std::vector<Topic> topics_;
};

// --- Which topics ---

/// Whether the messages of a topic carry gyroscope and accelerometer samples that are not always
/// exactly zero.
struct ImuSensors {
  bool gyro = false, accel = false;
};

ImuSensors FindSensors(const Bags& bags, const Topic& topic) {
  ImuSensors sensors;
  bags.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
    const ImuContent content = ReadImuMessage(instance);
    if (content.gyro && !content.gyro->value.isZero(0.0)) sensors.gyro = true;
    if (content.accel && !content.accel->value.isZero(0.0)) sensors.accel = true;
    return !(sensors.gyro && sensors.accel);
  });
  return sensors;
}

Topic NamedImu(const Bags& bags, const std::string& field, const std::string& name) {
  const Topic& topic = bags.Find(field, name);
  const bool may_be_vector = field != "imu_topic";
  if (!topic.IsImu() && !(may_be_vector && topic.IsVector()))
    throw InputError(field + " '" + name + "' is " + topic.type + ", must be " + kImuType +
                     (may_be_vector ? std::string(" or ") + kVectorType : ""));
  return topic;
}

/// The topics of gyroscope and accelerometer; the same for an IMU on one topic.
struct ImuTopics {
  Topic gyro, accel;
};

ImuTopics FindImu(const Bags& bags) {
  const std::vector<Topic> candidates =
      bags.Select([](const Topic& t) { return t.count > 0 && t.IsImu(); });
  if (candidates.empty()) {
    const bool has_vectors =
        !bags.Select([](const Topic& t) { return t.count > 0 && t.IsVector(); }).empty();
    throw InputError(std::string("no topic of type ") + kImuType + " in " + bags.Contents() +
                     (has_vectors ? std::string("; say which ") + kVectorType +
                                        " is which with gyro_topic and accel_topic"
                                  : ""));
  }
  if (candidates.size() == 1) return {candidates[0], candidates[0]};

  std::vector<Topic> gyros, accels;
  for (const Topic& topic : candidates) {
    const ImuSensors sensors = FindSensors(bags, topic);
    if (sensors.gyro) gyros.push_back(topic);
    if (sensors.accel) accels.push_back(topic);
  }
  if (gyros.size() != 1 || accels.size() != 1)
    throw InputError("several IMU topics: " + Describe(candidates) +
                     "; choose with imu_topic, or with gyro_topic and accel_topic");
  return {gyros[0], accels[0]};
}

ImuTopics ChooseImu(const Bags& bags, const BagRequest& request) {
  if (IsPair({"imu_topic", request.imu_topic},
             {"gyro_topic", request.gyro_topic},
             {"accel_topic", request.accel_topic}))
    return {NamedImu(bags, "gyro_topic", request.gyro_topic),
            NamedImu(bags, "accel_topic", request.accel_topic)};
  if (!request.imu_topic.empty()) {
    const Topic topic = NamedImu(bags, "imu_topic", request.imu_topic);
    return {topic, topic};
  }
  for (const Topic& topic : bags.topics())
    if (topic.IsImu() && topic.count > 0 && topic.name == request.usual_imu_topic)
      return {topic, topic};
  return FindImu(bags);
}

/// A topic without the data that are to come from it is a mistake in the topics, not bad data.
void CheckContent(const Bags& bags, const ImuTopics& imu) {
  const auto fail = [](const Topic& topic, const char* what) {
    throw InputError(
        "'" + topic.name + "' carries no " + what +
        " (all zero, or covariance -1); choose with imu_topic, or with gyro_topic and " +
        "accel_topic");
  };
  if (imu.gyro.count > 0 && !FindSensors(bags, imu.gyro).gyro) fail(imu.gyro, "angular velocity");
  if (imu.accel.count > 0 && !FindSensors(bags, imu.accel).accel)
    fail(imu.accel, "linear acceleration");
}

/// What poses could come from when there is no pose topic.
std::string TfHint(const Bags& bags) {
  if (bags.Select([](const Topic& t) { return t.IsTf(); }).empty()) return "";
  TfChain links("", "", 0.0);
  bags.ForEachTf([&](const rosbag::MessageInstance& instance, bool fixed) {
    links.Add(*Instantiate<tf2_msgs::TFMessage>(instance), fixed);
  });
  return "; for poses from tf give tf_parent and tf_child, its frames are: " + links.Links();
}

Topic ChoosePose(const Bags& bags, const std::string& name) {
  if (!name.empty()) {
    const Topic& topic = bags.Find("pose_topic", name);
    if (topic.IsTf())
      throw InputError("pose_topic '" + name + "' is " + topic.type + "; leave it empty" +
                       TfHint(bags));
    if (!topic.IsPose())
      throw InputError("pose_topic '" + name + "' is " + topic.type + ", must be " +
                       PoseTypeList());
    return topic;
  }
  const std::vector<Topic> candidates =
      bags.Select([](const Topic& t) { return t.count > 0 && t.IsPose(); });
  if (candidates.empty())
    throw InputError("no topic of type " + PoseTypeList() + " in " + bags.Contents() +
                     TfHint(bags));
  if (candidates.size() > 1)
    throw InputError("several pose topics: " + Describe(candidates) + "; choose with pose_topic");
  return candidates[0];
}

/// Whether poses are to come from tf.
bool WantsTf(const BagRequest& request) {
  return IsPair({"pose_topic", request.pose_topic},
                {"tf_parent", request.tf_parent},
                {"tf_child", request.tf_child});
}

// --- Samples ---

template <typename Sample>
void CheckStamps(const std::string& topic, const std::vector<Sample>& samples) {
  const bool has_stamps =
      std::any_of(samples.begin(), samples.end(), [](const Sample& s) { return s.t_ns != 0; });
  if (!samples.empty() && !has_stamps)
    throw InputError("'" + topic +
                     "' has no header stamps (all are 0); record_time takes the times of "
                     "recording instead, which are less exact");
}

/// Record time minus header stamp [s] of the messages of one stream.
class Delays {
 public:
  void Add(const rosbag::MessageInstance& instance, int64_t stamp_ns) {
    delays_s_.push_back(1e-9 * static_cast<double>(ToNanoseconds(instance.getTime()) - stamp_ns));
  }

  std::optional<Latency> Summarise() && {
    if (delays_s_.empty()) return std::nullopt;
    Latency latency;
    latency.median_s = Median(delays_s_);
    for (double& delay : delays_s_) delay = std::abs(delay - latency.median_s);
    latency.spread_s = kMadToSigma * Median(std::move(delays_s_));
    return latency;
  }

 private:
  std::vector<double> delays_s_;
};

void ReadImu(const Bags& bags, const ImuTopics& imu, bool record_time, Recording* recording) {
  const auto add = [record_time](ImuSample sample,
                                 const rosbag::MessageInstance& instance,
                                 std::vector<ImuSample>* samples,
                                 Delays* delays) {
    delays->Add(instance, sample.t_ns);
    if (record_time) sample.t_ns = ToNanoseconds(instance.getTime());
    samples->push_back(sample);
  };
  std::string frame;
  Delays gyro_delays, accel_delays;
  const auto read = [&](const Topic& topic, bool gyro, bool accel) {
    bags.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
      const ImuContent content = ReadImuMessage(instance);
      if (gyro && content.gyro) add(*content.gyro, instance, &recording->data.gyro, &gyro_delays);
      if (accel && content.accel)
        add(*content.accel, instance, &recording->data.accel, &accel_delays);
      if (gyro) frame = content.frame;
      return true;
    });
  };
  const bool is_split = imu.gyro.name != imu.accel.name;
  read(imu.gyro, true, !is_split);
  if (is_split) read(imu.accel, false, true);
  CheckStamps(imu.gyro.name, recording->data.gyro);
  CheckStamps(imu.accel.name, recording->data.accel);
  recording->info.imu_frame = FrameName(frame, "imu");
  recording->info.gyro_latency = std::move(gyro_delays).Summarise();
  recording->info.accel_latency = std::move(accel_delays).Summarise();
}

/// Median of each sigma that is stated; no value when none is.
std::optional<PoseStd> MedianStd(const std::vector<PoseSample>& poses) {
  std::vector<double> position, rotation;
  for (const PoseSample& pose : poses) {
    if (pose.stated_std.position == 0.0) continue;
    position.push_back(pose.stated_std.position);
    rotation.push_back(pose.stated_std.rotation);
  }
  if (position.empty()) return std::nullopt;
  return PoseStd{Median(position), Median(rotation)};
}

void ReadPoses(const Bags& bags, const Topic& topic, bool record_time, Recording* recording) {
  const PoseType<BagMessage>& type = *FindPoseType<BagMessage>(topic.type);
  FramedPose first;
  Delays delays;
  bags.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
    FramedPose framed = type.read({instance});
    delays.Add(instance, framed.pose.t_ns);
    if (record_time) framed.pose.t_ns = ToNanoseconds(instance.getTime());
    if (recording->data.poses.empty()) first = framed;
    if (framed.world_frame != first.world_frame || framed.marker_frame != first.marker_frame)
      throw InputError("pose_topic '" + topic.name + "' mixes poses of several frames: '" +
                       first.world_frame + "' -> '" + first.marker_frame + "' and '" +
                       framed.world_frame + "' -> '" + framed.marker_frame + "'");
    recording->data.poses.push_back(framed.pose);
    return true;
  });
  CheckStamps(topic.name, recording->data.poses);
  recording->info.pose_topic = topic.name;
  recording->info.pose_latency = std::move(delays).Summarise();
  recording->info.world_frame = FrameName(first.world_frame, "world");
  recording->info.marker_frame = FrameName(first.marker_frame, "marker");
  recording->info.stated_pose_std = MedianStd(recording->data.poses);
}

void ReadTf(const Bags& bags, const BagRequest& request, Recording* recording) {
  std::vector<PoseSample>& poses = recording->data.poses;
  Delays delays;
  TfChain chain(request.tf_parent, request.tf_child, bags.duration_s());
  bags.ForEachTf([&](const rosbag::MessageInstance& instance, bool fixed) {
    const auto msg = Instantiate<tf2_msgs::TFMessage>(instance);
    if (request.record_time)
      for (auto& transform : msg->transforms) transform.header.stamp = instance.getTime();
    chain.Add(*msg, fixed);
    for (const PoseSample& pose : chain.TakePoses()) {
      if (!request.record_time) delays.Add(instance, pose.t_ns);
      poses.push_back(pose);
    }
  });
  if (poses.empty()) {
    chain.Check();
    throw InputError("at no stamp are all links between tf_parent '" + request.tf_parent +
                     "' and tf_child '" + request.tf_child + "' known");
  }
  recording->info.pose_topic = "/tf";
  recording->info.pose_latency = std::move(delays).Summarise();
  recording->info.world_frame = FrameName(request.tf_parent, "");
  recording->info.marker_frame = FrameName(request.tf_child, "");
}

Recording Read(const BagRequest& request) {
  const Bags bags(request);
  const bool tf = WantsTf(request);
  const ImuTopics imu = ChooseImu(bags, request);
  const Topic pose = tf ? Topic() : ChoosePose(bags, request.pose_topic);
  CheckContent(bags, imu);

  Recording recording;
  for (const std::string& path : request.paths)
    recording.info.bag += (recording.info.bag.empty() ? "" : " ") + path;
  if (imu.gyro.name == imu.accel.name) {
    recording.info.imu_topic = imu.gyro.name;
  } else {
    recording.info.gyro_topic = imu.gyro.name;
    recording.info.accel_topic = imu.accel.name;
  }
  ReadImu(bags, imu, request.record_time, &recording);
  if (tf)
    ReadTf(bags, request, &recording);
  else
    ReadPoses(bags, pose, request.record_time, &recording);
  return recording;
}

/// "'A.bag', 'B.bag' ..." and what to run, for damage that rosbag does not pin down.
[[noreturn]] void FailDamaged(const BagRequest& request, const std::string& reason) {
  std::string reindex;
  for (const std::string& path : request.paths) reindex += " " + path;
  throw InputError("bag '" + FileNames(request.paths) + "' is damaged (" + reason +
                   "); run: rosbag reindex" + reindex);
}

Recording ReadOrFail(const BagRequest& request) {
  try {
    return Read(request);
  } catch (const InputError&) {
    throw;
  } catch (const std::runtime_error& error) {  // rosbag, deserialisation, times out of range
    FailDamaged(request, error.what());
  }
}

/// Keeps rosbag and tf2 from printing: what they find is reported by exceptions.
class Silence {
 public:
  Silence() { console_bridge::noOutputHandler(); }
  ~Silence() { console_bridge::restorePreviousOutputHandler(); }
};

/// Far above what any bag of this size needs.
uint64_t MaxCpuSeconds(uint64_t bytes) { return 10 + bytes / 1'000'000; }
uint64_t MaxMemory(uint64_t bytes) { return 4'000'000'000 + 8 * bytes; }

}  // namespace

Recording ReadBag(const BagRequest& request) {
  const Silence silence;
  uint64_t bytes = 0;
  for (const std::string& path : request.paths) {
    std::error_code ignored;
    const auto size = std::filesystem::file_size(path, ignored);
    if (!ignored) bytes += size;
  }
  auto recording = RunApart(
      [&] { return ToBytes(ReadOrFail(request)); }, MaxCpuSeconds(bytes), MaxMemory(bytes));
  if (!recording) FailDamaged(request, "rosbag cannot cope with it");
  return FromBytes(*std::move(recording));
}

}  // namespace imu_pose_calib
