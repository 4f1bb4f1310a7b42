#include "imu_pose_calib/ros/io/bag_reader.h"

#include <console_bridge/console.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <sstream>
#include <vector>

#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/pose_messages.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/io/tf_chain.h"

namespace imu_pose_calib {
namespace {

/// Bags of one recording follow each other by no more than this, or overlap by as little [s].
constexpr double kMaxPause = 2.0, kMaxOverlap = 0.5;

std::string PoseTypeList() {
  std::string list;
  for (const std::string& name : PoseTypeNames()) list += (list.empty() ? "" : " or ") + name;
  return list;
}

ImuContent ReadImuMessage(const rosbag::MessageInstance& instance) {
  return ReadImuContent(instance.getDataType(), BagMessage{instance});
}

// --- Which topics ---

/// Whether the messages of a topic carry gyroscope and accelerometer samples that are not always
/// exactly zero.
struct ImuSensors {
  bool gyro = false, accel = false;
};

ImuSensors FindSensors(const Bags& bags, const BagTopic& topic) {
  ImuSensors sensors;
  bags.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
    const ImuContent content = ReadImuMessage(instance);
    if (content.gyro && !content.gyro->value.isZero(0.0)) sensors.gyro = true;
    if (content.accel && !content.accel->value.isZero(0.0)) sensors.accel = true;
    return !(sensors.gyro && sensors.accel);
  });
  return sensors;
}

BagTopic NamedImu(const Bags& bags, const std::string& field, const std::string& name) {
  const BagTopic& topic = bags.Find(field, name);
  const bool may_be_vector = field != "imu_topic";
  if (!topic.IsImu() && !(may_be_vector && topic.IsVector()))
    throw InputError(field + " '" + name + "' is " + topic.type + ", must be " + kImuType +
                     (may_be_vector ? std::string(" or ") + kVectorType : ""));
  return topic;
}

/// The topics of gyroscope and accelerometer; the same for an IMU on one topic.
struct ImuTopics {
  BagTopic gyro, accel;
};

ImuTopics FindImu(const Bags& bags) {
  const std::vector<BagTopic> candidates =
      bags.Select([](const BagTopic& t) { return t.count > 0 && t.IsImu(); });
  if (candidates.empty()) {
    const bool has_vectors =
        !bags.Select([](const BagTopic& t) { return t.count > 0 && t.IsVector(); }).empty();
    throw InputError(std::string("no topic of type ") + kImuType + " in " + bags.Contents() +
                     (has_vectors ? std::string("; say which ") + kVectorType +
                                        " is which with gyro_topic and accel_topic"
                                  : ""));
  }
  if (candidates.size() == 1) return {candidates[0], candidates[0]};

  std::vector<BagTopic> gyros, accels;
  for (const BagTopic& topic : candidates) {
    const ImuSensors sensors = FindSensors(bags, topic);
    if (sensors.gyro) gyros.push_back(topic);
    if (sensors.accel) accels.push_back(topic);
  }
  if (gyros.size() != 1 || accels.size() != 1)
    throw InputError("several IMU topics: " + Describe(candidates) +
                     "; choose with imu_topic, or with gyro_topic and accel_topic; several IMUs of "
                     "one body have white space between their topics");
  return {gyros[0], accels[0]};
}

/// Whether the bags lack a topic that other sessions of the rig have.
bool IsMissing(const Bags& bags, const BagRequest& request, const std::string& name) {
  const auto is_it = [&name](const BagTopic& topic) { return topic.name == name; };
  return request.may_lack_imus && bags.Select(is_it).empty();
}

/// The topics of each IMU; nameless for one that is missing.
std::vector<ImuTopics> ChooseImus(const Bags& bags, const BagRequest& request) {
  std::vector<ImuTopics> imus;
  if (IsPair({"imu_topic", request.imu_topic},
             {"gyro_topic", request.gyro_topic},
             {"accel_topic", request.accel_topic})) {
    const std::vector<std::string> gyros = SplitNames(request.gyro_topic);
    const std::vector<std::string> accels = SplitNames(request.accel_topic);
    if (gyros.size() != accels.size())
      throw InputError("gyro_topic names " + std::to_string(gyros.size()) +
                       " topics and accel_topic " + std::to_string(accels.size()) +
                       "; give as many of both, in the same order");
    for (size_t i = 0; i < gyros.size(); ++i) {
      const bool is_missing =
          IsMissing(bags, request, gyros[i]) && IsMissing(bags, request, accels[i]);
      imus.push_back(is_missing ? ImuTopics()
                                : ImuTopics{NamedImu(bags, "gyro_topic", gyros[i]),
                                            NamedImu(bags, "accel_topic", accels[i])});
    }
    return imus;
  }
  if (!request.imu_topic.empty()) {
    for (const std::string& name : SplitNames(request.imu_topic)) {
      if (std::any_of(imus.begin(), imus.end(), [&](const ImuTopics& imu) {
            return imu.gyro.name == name;
          }))
        throw InputError("imu_topic '" + name + "' is given twice");
      const bool is_missing = IsMissing(bags, request, name);
      const BagTopic topic = is_missing ? BagTopic() : NamedImu(bags, "imu_topic", name);
      imus.push_back({topic, topic});
    }
    return imus;
  }
  for (const BagTopic& topic : bags.topics())
    if (topic.IsImu() && topic.count > 0 && topic.name == request.usual_imu_topic)
      return {{topic, topic}};
  return {FindImu(bags)};
}

/// A topic without the data that are to come from it is a mistake in the topics, not bad data.
void CheckContent(const Bags& bags, const ImuTopics& imu) {
  const auto fail = [](const BagTopic& topic, const char* what) {
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
  if (bags.Select([](const BagTopic& t) { return t.IsTf(); }).empty()) return "";
  TfChain links("", "", 0.0);
  bags.ForEachTf([&](const rosbag::MessageInstance& instance, bool fixed) {
    links.Add(*Instantiate<tf2_msgs::TFMessage>(instance), fixed);
  });
  return "; for poses from tf give tf_parent and tf_child, its frames are: " + links.Links();
}

BagTopic ChoosePose(const Bags& bags, const std::string& name) {
  if (!name.empty()) {
    const BagTopic& topic = bags.Find("pose_topic", name);
    if (topic.IsTf())
      throw InputError("pose_topic '" + name + "' is " + topic.type + "; leave it empty" +
                       TfHint(bags));
    if (!topic.IsPose())
      throw InputError("pose_topic '" + name + "' is " + topic.type + ", must be " +
                       PoseTypeList());
    return topic;
  }
  const std::vector<BagTopic> candidates =
      bags.Select([](const BagTopic& t) { return t.count > 0 && t.IsPose(); });
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

void ReadImu(const Bags& bags,
             const ImuTopics& imu,
             bool record_time,
             ImuInfo* info,
             ImuData* data) {
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
  const auto read = [&](const BagTopic& topic, bool gyro, bool accel) {
    bags.ForEach(topic, [&](const rosbag::MessageInstance& instance) {
      const ImuContent content = ReadImuMessage(instance);
      if (gyro && content.gyro) add(*content.gyro, instance, &data->gyro, &gyro_delays);
      if (accel && content.accel) add(*content.accel, instance, &data->accel, &accel_delays);
      if (gyro) frame = content.frame;
      return true;
    });
  };
  const bool is_split = imu.gyro.name != imu.accel.name;
  read(imu.gyro, true, !is_split);
  if (is_split) read(imu.accel, false, true);
  CheckStamps(imu.gyro.name, data->gyro);
  CheckStamps(imu.accel.name, data->accel);
  if (is_split) {
    info->gyro_topic = imu.gyro.name;
    info->accel_topic = imu.accel.name;
  } else {
    info->imu_topic = imu.gyro.name;
  }
  info->imu_frame = FrameName(frame, "imu");
  info->gyro_latency = std::move(gyro_delays).Summarise();
  info->accel_latency = std::move(accel_delays).Summarise();
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

void ReadPoses(const Bags& bags, const BagTopic& topic, bool record_time, Recording* recording) {
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
  const Bags bags(request.paths, request.start_s, request.duration_s);
  const bool tf = WantsTf(request);
  const std::vector<ImuTopics> imus = ChooseImus(bags, request);
  const BagTopic pose = tf ? BagTopic() : ChoosePose(bags, request.pose_topic);
  for (const ImuTopics& imu : imus) CheckContent(bags, imu);

  Recording recording;
  for (const std::string& path : request.paths)
    recording.info.bag += (recording.info.bag.empty() ? "" : " ") + path;
  recording.info.imus.resize(imus.size());
  recording.data.imus.resize(imus.size());
  for (size_t i = 0; i < imus.size(); ++i)
    if (!imus[i].gyro.name.empty())
      ReadImu(bags, imus[i], request.record_time, &recording.info.imus[i], &recording.data.imus[i]);
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
  throw InputError(Printable("bag '" + FileNames(request.paths) + "' is damaged (" + reason +
                             "); run: rosbag reindex" + reindex));
}

/// What `read` returns, or an InputError that says what is wrong with the bags.
template <typename Read>
auto OrFail(const BagRequest& request, const Read& read) {
  try {
    return read();
  } catch (const InputError& error) {  // with names of topics, types and frames as in the bag
    throw InputError(Printable(error.what()));
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

/// Far above what any bag of this size needs, the time also when it comes over a slow network.
ChildLimits Limits(uint64_t bytes) {
  return {10 + bytes / 1'000'000, 120 + bytes / 100'000, 4'000'000'000 + 8 * bytes};
}

}  // namespace

namespace {

/// Runs `read`, which returns bytes, in a child process.
std::string ReadApart(const BagRequest& request, const std::function<std::string()>& read) {
  const Silence silence;
  uint64_t bytes = 0;
  for (const std::string& path : request.paths) {
    std::error_code ignored;
    const auto size = std::filesystem::file_size(path, ignored);
    if (!ignored) bytes += size;
  }
  auto answer = RunApart([&] { return OrFail(request, read); }, Limits(bytes));
  if (!answer) FailDamaged(request, "rosbag cannot cope with it");
  return *std::move(answer);
}

/// When a bag was recorded and what it holds of poses and IMUs.
struct BagSpan {
  std::string path;
  double begin_s, end_s;
  std::vector<std::string> topics;

  explicit BagSpan(const std::string& bag_path) : path(bag_path) {
    const Bags bag({path}, 0.0, 0.0);
    begin_s = bag.begin_s();
    end_s = begin_s + bag.duration_s();
    for (const BagTopic& topic : bag.topics())
      if (topic.IsImu() || topic.IsVector() || topic.IsPose()) topics.push_back(topic.name);
  }

  /// Whether both are of one recording: one goes on where the other ends, or they hold other topics
  /// of the same time.
  bool Continues(const BagSpan& other) const {
    const double pause = std::max(begin_s, other.begin_s) - std::min(end_s, other.end_s);
    if (pause > kMaxPause) return false;
    const auto is_shared = [&](const std::string& topic) {
      return std::find(other.topics.begin(), other.topics.end(), topic) != other.topics.end();
    };
    return pause > -kMaxOverlap || std::none_of(topics.begin(), topics.end(), is_shared);
  }
};

}  // namespace

Recording ReadBag(const BagRequest& request) {
  return FromBytes(ReadApart(request, [&] { return ToBytes(Read(request)); }));
}

std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths) {
  if (paths.size() < 2) return {paths};
  std::set<std::filesystem::path> known;
  for (const std::string& path : paths)
    if (std::filesystem::exists(path) && !known.insert(std::filesystem::canonical(path)).second)
      throw InputError("bag '" + path + "' is given twice");
  BagRequest request;
  request.paths = paths;
  // A line for each bag: the number of its recording.
  const std::string numbers = ReadApart(request, [&paths] {
    std::vector<BagSpan> spans;
    std::vector<size_t> group;
    std::string text;
    for (const std::string& path : paths) {
      const BagSpan span(path);
      size_t own = spans.size();
      for (size_t k = 0; k < spans.size(); ++k)
        if (span.Continues(spans[k])) own = std::min(own, group[k]);
      spans.push_back(span);
      group.push_back(own);
      text += std::to_string(own) + "\n";
    }
    return text;
  });
  std::istringstream lines(numbers);
  std::map<size_t, std::vector<std::string>> groups;
  size_t number = 0;
  for (const std::string& path : paths)
    if (lines >> number) groups[number].push_back(path);
  std::vector<std::vector<std::string>> recordings;
  for (const auto& [first, bags] : groups) recordings.push_back(bags);
  return recordings;
}

}  // namespace imu_pose_calib
