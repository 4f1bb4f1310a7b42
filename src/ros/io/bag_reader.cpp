#include "imu_pose_calib/ros/io/bag_reader.h"

#include <console_bridge/console.h>

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cmath>
#include <filesystem>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/io/tf_chain.h"

namespace imu_pose_calib {
namespace {

std::string PoseTypeList() { return boost::join(PoseTypeNames(), " or "); }

// --- Which topics ---

/// Whether the messages of a topic carry gyroscope and accelerometer samples that are not always
/// exactly zero.
struct ImuSensors {
  bool gyro = false, accel = false;
};

ImuSensors FindSensors(const Bags& bags, const BagTopic& topic) {
  ImuSensors sensors;
  bags.ForEach(topic, [&](const BagMessage& message) {
    const ImuContent content = ReadImuContent(message.type, message);
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
  if (IsPair({"imu_topic", request.imu_topic}, {"gyro_topic", request.gyro_topic},
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
      if (std::any_of(imus.begin(), imus.end(),
                      [&](const ImuTopics& imu) { return imu.gyro.name == name; }))
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

/// The frames of tf, without a chain.
std::unique_ptr<TfChain> TfLinks(const Bags& bags) {
  auto links = std::make_unique<TfChain>("", "", 0.0);
  bags.ForEachTf([&](const BagMessage& message, bool fixed) {
    links->Add(*message.instantiate<tf2_msgs::TFMessage>(), fixed);
  });
  return links;
}

/// What poses could come from when there is no pose topic.
std::string TfHint(const Bags& bags) {
  if (bags.Select([](const BagTopic& t) { return t.IsTf(); }).empty()) return "";
  return "; for poses from tf give tf_parent and tf_child, its frames are: " +
         TfLinks(bags)->Links();
}

/// A single pair of frames that tf has poses between is taken by itself when there are no others.
BagRequest FindTf(const Bags& bags, BagRequest request) {
  const bool is_open = request.poses && request.pose_topic.empty() && request.tf_parent.empty() &&
                       request.tf_child.empty() && request.body.empty();
  if (!is_open || bags.Select([](const BagTopic& t) { return t.IsTf(); }).empty() ||
      !bags.Select([](const BagTopic& t) { return t.count > 0 && t.IsPose(); }).empty())
    return request;
  const auto pair = TfLinks(bags)->SinglePair();
  if (pair) std::tie(request.tf_parent, request.tf_child) = *pair;
  return request;
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

// --- Samples ---

/// Record time minus header stamp [s] of the messages of one stream.
class Delays {
 public:
  void Add(const BagMessage& message, int64_t stamp_ns) {
    delays_s_.push_back(1e-9 * static_cast<double>(ToNanoseconds(message.time) - stamp_ns));
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

/// The samples of one stream.
template <typename Sample>
struct Stream {
  std::vector<Sample> samples;
  Delays delays;

  void Add(const BagMessage& message, Sample sample, bool record_time) {
    delays.Add(message, sample.t_ns);
    if (record_time) sample.t_ns = ToNanoseconds(message.time);
    samples.push_back(sample);
  }

  /// Hands over samples that have stamps.
  void Finish(const std::string& topic, std::optional<Latency>* latency,
              std::vector<Sample>* finished) && {
    const bool has_stamps =
        std::any_of(samples.begin(), samples.end(), [](const Sample& s) { return s.t_ns != 0; });
    if (!samples.empty() && !has_stamps)
      throw InputError("'" + topic +
                       "' has no header stamps (all are 0); record_time takes the times of "
                       "recording instead, which are less exact");
    *latency = std::move(delays).Summarise();
    *finished = std::move(samples);
  }
};

/// Takes the samples of one IMU out of messages.
class ImuReader {
 public:
  ImuReader(ImuTopics topics, bool record_time)
      : topics_(std::move(topics)), record_time_(record_time) {}

  std::set<std::string> Topics() const { return {topics_.gyro.name, topics_.accel.name}; }

  void Add(const BagMessage& message) {
    const bool gyro = message.topic == topics_.gyro.name;
    const bool accel = message.topic == topics_.accel.name;
    if (!gyro && !accel) return;
    const ImuContent content = ReadImuContent(message.type, message);
    if (gyro) frame_ = content.frame;
    if (gyro && content.gyro) gyro_.Add(message, *content.gyro, record_time_);
    if (accel && content.accel) accel_.Add(message, *content.accel, record_time_);
  }

  void Finish(ImuInfo* info, ImuData* data) && {
    std::move(gyro_).Finish(topics_.gyro.name, &info->gyro_latency, &data->gyro);
    std::move(accel_).Finish(topics_.accel.name, &info->accel_latency, &data->accel);
    if (topics_.gyro.name != topics_.accel.name) {
      info->gyro_topic = topics_.gyro.name;
      info->accel_topic = topics_.accel.name;
    } else {
      info->imu_topic = topics_.gyro.name;
    }
    info->imu_frame = FrameName(frame_, "imu");
  }

 private:
  ImuTopics topics_;
  bool record_time_;
  std::string frame_;
  Stream<ImuSample> gyro_, accel_;
};

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

/// The body of a topic of several that a request names, or the only one.
std::string ChooseBody(const Bags& bags, const BagTopic& topic, const std::string& name) {
  std::set<std::string> names;
  bags.ForEach(topic, [&](const BagMessage& message) {
    for (const FramedPose& body : ReadBodies(message)) names.insert(body.marker_frame);
    return true;
  });
  const std::string list =
      "pose_topic '" + topic.name + "' has the bodies: " + boost::join(names, ", ");
  if (names.empty()) throw InputError("pose_topic '" + topic.name + "' has no bodies");
  if (name.empty() && names.size() > 1) throw InputError(list + "; choose with body");
  if (!name.empty() && names.count(name) == 0)
    throw InputError("body '" + name + "' is missing: " + list);
  return name.empty() ? *names.begin() : name;
}

/// Takes the poses of one body out of messages of a topic.
class PoseReader {
 public:
  PoseReader(const Bags& bags, BagTopic topic, const BagRequest& request)
      : topic_(std::move(topic)), record_time_(request.record_time) {
    if (topic_.IsBodies())
      body_ = ChooseBody(bags, topic_, request.body);
    else if (!request.body.empty())
      throw InputError("body '" + request.body + "' is given, but pose_topic '" + topic_.name +
                       "' is " + topic_.type + ", which holds one body");
  }

  const std::string& Topic() const { return topic_.name; }

  void Add(const BagMessage& message) {
    if (message.topic != topic_.name) return;
    if (!topic_.IsBodies())
      return Add(message, FindPoseType<BagMessage>(topic_.type)->read(message));
    for (const FramedPose& framed : ReadBodies(message))
      if (framed.marker_frame == body_) Add(message, framed);
  }

  void Finish(Recording* recording) && {
    std::move(poses_).Finish(topic_.name, &recording->info.pose_latency, &recording->data.poses);
    recording->info.pose_topic = topic_.name;
    recording->info.world_frame = FrameName(first_.world_frame, "world");
    recording->info.marker_frame = FrameName(first_.marker_frame, "marker");
    recording->info.stated_pose_std = MedianStd(recording->data.poses);
  }

 private:
  void Add(const BagMessage& message, const FramedPose& framed) {
    if (poses_.samples.empty()) first_ = framed;
    if (framed.world_frame != first_.world_frame || framed.marker_frame != first_.marker_frame)
      throw InputError("pose_topic '" + topic_.name + "' mixes poses of several frames: '" +
                       first_.world_frame + "' -> '" + first_.marker_frame + "' and '" +
                       framed.world_frame + "' -> '" + framed.marker_frame + "'");
    poses_.Add(message, framed.pose, record_time_);
  }

  BagTopic topic_;
  bool record_time_;
  std::string body_;  ///< of a topic of several
  FramedPose first_;
  Stream<PoseSample> poses_;
};

void ReadTf(const Bags& bags, const BagRequest& request, Recording* recording) {
  std::vector<PoseSample>& poses = recording->data.poses;
  Delays delays;
  TfChain chain(request.tf_parent, request.tf_child, bags.duration_s());
  bags.ForEachTf([&](const BagMessage& message, bool fixed) {
    const auto msg = message.instantiate<tf2_msgs::TFMessage>();
    if (request.record_time)
      for (auto& transform : msg->transforms) transform.header.stamp = message.time;
    chain.Add(*msg, fixed);
    for (const PoseSample& pose : chain.TakePoses()) {
      if (!request.record_time) delays.Add(message, pose.t_ns);
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

Recording Read(const BagRequest& given) {
  const Bags bags(given.paths, given.start_s, given.duration_s);
  const BagRequest request = FindTf(bags, given);
  const bool tf = IsPair({"pose_topic", request.pose_topic}, {"tf_parent", request.tf_parent},
                         {"tf_child", request.tf_child});
  if (tf && !request.body.empty())
    throw InputError("body '" + request.body + "' does not go with poses from tf");
  std::vector<ImuTopics> imus;
  if (request.imus) imus = ChooseImus(bags, request);
  std::optional<PoseReader> pose_reader;
  if (request.poses && !tf)
    pose_reader.emplace(bags, ChoosePose(bags, request.pose_topic), request);
  for (const ImuTopics& imu : imus) CheckContent(bags, imu);

  Recording recording;
  recording.info.bag = boost::join(request.paths, " ");
  recording.info.notes = bags.Notes();
  recording.info.imus.resize(imus.size());
  recording.data.imus.resize(imus.size());
  // All in one pass: what is compressed is unfolded once.
  std::set<std::string> topics;
  std::vector<ImuReader> imu_readers;
  for (const ImuTopics& imu : imus)
    topics.merge(imu_readers.emplace_back(imu, request.record_time).Topics());
  if (pose_reader) topics.insert(pose_reader->Topic());
  topics.erase("");  // of an IMU that is missing
  bags.ForEach(topics, [&](const BagMessage& message) {
    for (ImuReader& reader : imu_readers) reader.Add(message);
    if (pose_reader) pose_reader->Add(message);
  });
  for (size_t i = 0; i < imus.size(); ++i)
    if (!imus[i].gyro.name.empty())
      std::move(imu_readers[i]).Finish(&recording.info.imus[i], &recording.data.imus[i]);
  if (pose_reader) std::move(*pose_reader).Finish(&recording);
  if (tf) ReadTf(bags, request, &recording);
  return recording;
}

/// "'A.bag', 'B.bag' ..." and what to run, for damage that the reader does not pin down.
[[noreturn]] void FailDamaged(const BagRequest& request, const std::string& reason) {
  std::string reindex;
  for (const std::string& path : request.paths)
    if (!IsRos2Bag(path)) reindex += " " + path;
  throw InputError(Printable("bag '" + FileNames(request.paths) + "' is damaged (" + reason + ")" +
                             (reindex.empty() ? "" : "; run: rosbag reindex" + reindex)));
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

uint64_t SizeOf(const std::string& path) {
  std::error_code error;
  const auto size = std::filesystem::file_size(path, error);
  return error ? 0 : size;
}

}  // namespace

std::string ReadApart(const BagRequest& request, const std::function<std::string()>& read) {
  const Silence silence;
  uint64_t bytes = 0;
  for (const std::string& path : request.paths)
    for (const std::string& file : FilesOfBag(path)) bytes += SizeOf(file);
  const auto run = [&] {
    setenv("ROS_CACHE_TIMEOUT", "-1", 0);  // no search of all packages for plugins of rosbag
    return OrFail(request, read);
  };
  // Far above what any bag of this size needs, the time also when it comes over a slow network.
  auto answer =
      RunApart(run, {10 + bytes / 1'000'000, 120 + bytes / 100'000, 4'000'000'000 + 8 * bytes});
  if (!answer) FailDamaged(request, "it cannot be read within bounds of time and memory");
  return *std::move(answer);
}

Recording ReadBag(const BagRequest& request) {
  return FromBytes(ReadApart(request, [&] { return ToBytes(Read(request)); }));
}

}  // namespace imu_pose_calib
