#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/tf_chain.h"

namespace imu_pose_calib {
namespace {

// --- Which topics ---

bool HasTopic(const Bags& bags, const std::string& name) {
  return !bags.Select([&](const BagTopic& topic) { return topic.name == name; }).empty();
}

/// What carries no data of a sensor has it zero throughout.
bool IsData(const ImuSample& sample) { return !sample.value.isZero(0.0); }

/// An IMU by the topics of its gyroscope and accelerometer, which may be one.
ImuInfo NamedImu(const std::string& gyro, const std::string& accel) {
  ImuInfo imu;
  (gyro == accel ? imu.imu_topic : imu.gyro_topic) = gyro;
  if (gyro != accel) imu.accel_topic = accel;
  return imu;
}

/// The IMU when none is named; none when there is none and poses of sensors do without.
std::vector<ImuInfo> FindImu(const Bags& bags, const RecordingRequest& request) {
  const std::vector<BagTopic> candidates = bags.Select(&BagTopic::IsImu);
  if (candidates.empty() && !request.pose_sensors.empty()) return {};
  if (candidates.empty())
    Reject("no topic of type ", kImuType, " in ", bags.Contents(),
           (bags.Select(&BagTopic::IsVector).empty()
                ? ""
                : std::string("; say which ") + kVectorType +
                      " is which with gyro_topic and accel_topic"));
  for (const auto& [name, type, count] : candidates)
    if (candidates.size() == 1 || name == request.usual_imu_topic) return {NamedImu(name, name)};

  std::set<std::string> topics, gyros, accels;
  for (const BagTopic& topic : candidates) topics.insert(topic.name);
  bags.ForEach(topics, [&](const BagMessage& message) {
    const ImuContent content = ReadImuContent(message.type, message);
    if (content.gyro && IsData(*content.gyro)) gyros.insert(message.topic);
    if (content.accel && IsData(*content.accel)) accels.insert(message.topic);
    return gyros.size() < 2 && accels.size() < 2;
  });
  if (gyros.size() != 1 || accels.size() != 1)
    Reject("several IMU topics: ", Describe(candidates),
           "; choose with imu_topic, or with gyro_topic and accel_topic; several IMUs of one body "
           "have white space between their topics");
  return {NamedImu(*gyros.begin(), *accels.begin())};
}

/// The topics of each IMU; nameless for one that is missing.
std::vector<ImuInfo> ChooseImus(const Bags& bags, const RecordingRequest& request) {
  const bool is_split = IsPair({"imu_topic", request.imu_topic}, {"gyro_topic", request.gyro_topic},
                               {"accel_topic", request.accel_topic});
  if (!is_split && request.imu_topic.empty()) return FindImu(bags, request);
  const auto gyros = SplitNames(is_split ? request.gyro_topic : request.imu_topic);
  const auto accels = is_split ? SplitNames(request.accel_topic) : gyros;
  if (gyros.size() != accels.size())
    Reject("gyro_topic names ", gyros.size(), " topics and accel_topic ", accels.size(),
           "; give as many of both, in the same order");
  std::vector<std::string> types = {kImuType};
  if (is_split) types.emplace_back(kVectorType);
  std::vector<ImuInfo> imus(gyros.size());
  std::set<std::string> known;
  for (size_t i = 0; i < gyros.size(); ++i) {
    if (!known.insert(gyros[i]).second && !is_split)
      Reject("imu_topic '", gyros[i], "' is given twice");
    if (request.may_lack_sensors && !HasTopic(bags, gyros[i]) && !HasTopic(bags, accels[i]))
      continue;  // another session of the rig has it
    imus[i] = NamedImu(bags.Find(is_split ? "gyro_topic" : "imu_topic", gyros[i], types).name,
                       bags.Find(is_split ? "accel_topic" : "imu_topic", accels[i], types).name);
  }
  return imus;
}

/// Adds all of tf to a chain: first the fixed transforms of the whole bags, which are sent once,
/// then the others in the order of recording. Calls `use(message, pose)` for each pose that this
/// gives.
void AddTf(const Bags& bags, bool record_time, TfChain* chain,
           const std::function<void(const BagMessage&, const PoseSample&)>& use) {
  for (const bool fixed : {true, false}) {
    std::set<std::string> names;
    for (const BagTopic& topic : bags.topics())
      if (topic.IsTf() && boost::ends_with(topic.name, "tf_static") == fixed)
        names.insert(topic.name);
    const auto add = [&](const BagMessage& message) {
      const auto msg = message.instantiate<tf2_msgs::TFMessage>();
      if (record_time)
        for (auto& transform : msg->transforms) transform.header.stamp = message.time;
      chain->Add(*msg, fixed);
      for (const PoseSample& pose : chain->TakePoses()) use(message, pose);
      return true;
    };
    bags.ForEach(names, add, fixed);
  }
}

/// All links of tf, for no chain.
TfChain ReadLinks(const Bags& bags) {
  TfChain links("", "", 0.0);
  AddTf(bags, false, &links, {});
  return links;
}

/// What poses could come from when there is no pose topic.
std::string TfHint(const Bags& bags) {
  if (bags.Select(&BagTopic::IsTf).empty()) return "";
  return "; for poses from tf give tf_parent and tf_child, its frames are: " +
         ReadLinks(bags).Links();
}

/// Whether a topic may have the poses of the marker: that of a pose sensor has, where it holds
/// those of several bodies.
bool MayBeMarker(const RecordingRequest& request, const BagTopic& topic) {
  const std::vector<std::string> sensors = SplitPaths(request.pose_sensors);
  const auto is_it = [&](const std::string& name) { return SplitBody(name).first == topic.name; };
  return topic.IsPose() &&
         (topic.IsBodies() || std::none_of(sensors.begin(), sensors.end(), is_it));
}

BagTopic NamedPose(const Bags& bags, const std::string& field, const std::string& name) {
  const BagTopic& topic = bags.Find(field, name);
  if (topic.IsTf() && field == "pose_topic")
    Reject(field, " '", name, "' is ", topic.type, "; leave it empty", TfHint(bags));
  if (!topic.IsPose())
    Reject(field, " '", name, "' is ", topic.type, ", must be ", boost::join(kPoseTypes, " or "),
           (topic.IsTf() ? ", or named tf:PARENT:CHILD" : ""));
  return topic;
}

// --- Samples ---

/// The samples of one stream, and by how much each is recorded after its stamp.
template <typename Sample>
struct Stream {
  std::vector<Sample> samples;
  std::vector<double> delays_s;

  void Add(const BagMessage& message, Sample sample, bool record_time) {
    const int64_t recorded_ns = ToNanoseconds(message.time);
    delays_s.push_back(Seconds(recorded_ns - sample.t_ns));
    if (record_time) sample.t_ns = recorded_ns;
    samples.push_back(sample);
  }

  /// Hands over samples that have stamps, if there are any; returns how late they are recorded.
  std::optional<Latency> Finish(const std::string& topic, std::vector<Sample>* finished) {
    if (samples.empty()) return std::nullopt;
    if (std::all_of(samples.begin(), samples.end(), [](const Sample& s) { return s.t_ns == 0; }))
      Reject("'", topic,
             "' has no header stamps (all are 0); record_time takes the times of recording "
             "instead, which are less exact");
    const double median_s = Median(delays_s);
    for (double& delay : delays_s) delay -= median_s;
    *finished = std::move(samples);
    return Latency{median_s, RobustSigma(std::move(delays_s))};
  }
};

/// Takes the samples of one IMU out of messages.
struct ImuReader {
  ImuInfo* info;  ///< which topics; the rest of it becomes known
  Stream<ImuSample> gyros, accels;

  void Add(const BagMessage& message, bool record_time) {
    const bool gyro = message.topic == info->GyroSource();
    const bool accel = message.topic == info->AccelSource();
    if (!gyro && !accel) return;
    const ImuContent content = ReadImuContent(message.type, message);
    if (gyro) info->imu_frame = FrameName(content.frame, "imu");
    if (gyro && content.gyro) gyros.Add(message, *content.gyro, record_time);
    if (accel && content.accel) accels.Add(message, *content.accel, record_time);
  }

  void Finish(ImuData* data) {
    if (info->GyroSource().empty()) return;
    Check(info->GyroSource(), gyros.samples, "angular velocity");
    Check(info->AccelSource(), accels.samples, "linear acceleration");
    info->gyro_latency = gyros.Finish(info->GyroSource(), &data->gyro);
    info->accel_latency = accels.Finish(info->AccelSource(), &data->accel);
  }

 private:
  /// A topic without the data that are to come from it is a mistake in the topics, not bad data.
  static void Check(const std::string& topic, const std::vector<ImuSample>& samples,
                    const char* what) {
    if (std::none_of(samples.begin(), samples.end(), IsData))
      Reject("'", topic, "' carries no ", what,
             " (all zero, or covariance -1); choose with imu_topic, or with gyro_topic ",
             "and accel_topic");
  }
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

/// The body of a topic of several that a request names, or the only one; of a topic of one nothing.
/// `role`: the field that names the topic; `how`: what names the body.
std::string ChooseBody(const Bags& bags, const std::string& role, const BagTopic& topic,
                       const std::string& name, const std::string& how) {
  const std::string field = role + " '" + topic.name + "'";
  if (!topic.IsBodies() && !name.empty())
    Reject("body '", name, "' is given, but ", field, " is ", topic.type, ", which holds one body");
  if (!topic.IsBodies()) return "";
  std::set<std::string> names;
  bags.ForEach({topic.name}, [&](const BagMessage& message) {
    for (const FramedPose& body : ReadBodies(message)) names.insert(body.marker_frame);
    return true;
  });
  const std::string list = field + " has the bodies: " + boost::join(names, ", ");
  if (names.empty()) Reject(field, " has no bodies");
  if (name.empty() && names.size() > 1) Reject(list, "; choose with ", how);
  if (!name.empty() && names.count(name) == 0) Reject("body '", name, "' is missing: ", list);
  return name.empty() ? *names.begin() : name;
}

/// Takes the poses of one body out of messages of a topic, or from tf; neither: they are elsewhere.
struct PoseReader {
  std::string field;  ///< that names it
  BagTopic topic;
  std::string body;  ///< of a topic of several
  std::optional<TfFrames> tf;
  FramedPose first;
  Stream<PoseSample> poses;

  std::string Name() const { return tf ? JoinTf(*tf) : JoinBody(topic.name, body); }

  void Add(const BagMessage& message, bool record_time) {
    if (message.topic != topic.name) return;
    if (!topic.IsBodies()) return Add(message, ReadPose(topic.type, message), record_time);
    for (const FramedPose& framed : ReadBodies(message))
      if (framed.marker_frame == body) Add(message, framed, record_time);
  }

  void Add(const BagMessage& message, const FramedPose& framed, bool record_time) {
    if (poses.samples.empty()) first = framed;
    if (FrameName(framed.world_frame, "") != FrameName(first.world_frame, "") ||
        FrameName(framed.marker_frame, "") != FrameName(first.marker_frame, ""))
      Reject(field, " '", topic.name, "' mixes poses of several frames: '", first.world_frame,
             "' -> '", first.marker_frame, "' and '", framed.world_frame, "' -> '",
             framed.marker_frame, "'");
    poses.Add(message, framed.pose, record_time);
  }

  /// As the marker.
  void Finish(bool record_time, RecordingInfo* info, std::vector<PoseSample>* finished) {
    if (Name().empty()) return;
    info->pose_topic = tf ? "/tf" : topic.name;
    info->pose_latency = poses.Finish(info->pose_topic, finished);
    if (tf && record_time) info->pose_latency.reset();  // of no meaning
    info->world_frame = FrameName(first.world_frame, "world");
    info->marker_frame = FrameName(first.marker_frame, "marker");
    info->stated_pose_std = MedianStd(*finished);
  }

  /// As a pose sensor.
  void Finish(PoseSensorInfo* info, std::vector<PoseSample>* finished) {
    if (Name().empty()) return;
    poses.Finish(Name(), finished);
    *info = NamePoseSensor(Name(), first.world_frame, first.marker_frame);
  }
};

/// The poses of a reader that has frames of tf. A sensor that lacks them, as it may, has no frames
/// afterwards.
void ReadTf(const Bags& bags, const RecordingRequest& request, PoseReader* reader) {
  const std::string parent = reader->tf->first, child = reader->tf->second;
  TfChain chain(parent, child, bags.duration_s());
  AddTf(bags, request.record_time, &chain, [&](const BagMessage& message, const PoseSample& pose) {
    reader->Add(message, {pose, parent, child}, false);
  });
  if (!reader->poses.samples.empty()) return;
  const bool is_marker = reader->field == "pose_topic";
  if (request.may_lack_sensors && !is_marker) return reader->tf.reset();
  std::string problem = chain.Problem();
  if (problem.empty())
    problem = "at no stamp are all links between tf_parent '" + parent + "' and tf_child '" +
              child + "' known";
  Reject((is_marker ? "" : reader->field + " '" + reader->Name() + "': "), problem);
}

/// The marker's: of the topic or the frames of tf that are named, of the only topic that may be it
/// or, where there is none, of the only two frames of tf. In a file it is nameless.
PoseReader ChooseMarker(const Bags& bags, const RecordingRequest& request) {
  PoseReader marker;
  marker.field = "pose_topic";
  if (IsPair({"pose_topic", request.pose_topic}, {"tf_parent", request.tf_parent},
             {"tf_child", request.tf_child})) {
    if (!request.body.empty()) Reject("body '", request.body, "' does not go with poses from tf");
    marker.tf = TfFrames(FrameName(request.tf_parent, ""), FrameName(request.tf_child, ""));
    return marker;
  }
  if (request.NamesPoseFile()) return marker;
  if (!request.pose_topic.empty()) {
    marker.topic = NamedPose(bags, marker.field, request.pose_topic);
  } else {
    const std::vector<BagTopic> candidates =
        bags.Select([&](const BagTopic& t) { return MayBeMarker(request, t); });
    if (candidates.size() > 1)
      Reject("several pose topics: ", Describe(candidates), "; choose with pose_topic");
    if (candidates.empty()) {
      if (request.body.empty()) marker.tf = ReadLinks(bags).SinglePair();
      for (const std::string& name : SplitPaths(request.pose_sensors))
        if (SplitTf(name) == marker.tf) marker.tf.reset();
      if (marker.tf) return marker;
      Reject("no topic of type ", boost::join(kPoseTypes, " or "), " in ", bags.Contents(),
             TfHint(bags));
    }
    marker.topic = candidates[0];
  }
  marker.body = ChooseBody(bags, marker.field, marker.topic, request.body, "body");
  return marker;
}

/// A pose sensor that is in a file is nameless, and so is one that may be missing and is.
PoseReader ChoosePoseSensor(const Bags& bags, const RecordingRequest& request,
                            const std::string& name) {
  PoseReader sensor;
  sensor.field = "pose_sensor";
  if (IsPoseFile(name)) return sensor;
  sensor.tf = SplitTf(name);
  if (sensor.tf) return sensor;
  const auto [topic, body] = SplitBody(name);
  if (request.may_lack_sensors && !HasTopic(bags, topic)) return sensor;
  sensor.topic = NamedPose(bags, sensor.field, topic);
  sensor.body = ChooseBody(bags, sensor.field, sensor.topic, body, "'" + topic + ":BODY'");
  return sensor;
}

Recording Read(const RecordingRequest& request) {
  // Bags and text files have no span of record time in common.
  const bool is_whole = request.NamesPoseFile() || request.NamesImuFile();
  const Bags bags(request.paths, is_whole ? 0.0 : request.start_s,
                  is_whole ? 0.0 : request.duration_s);
  Recording recording;
  RecordingInfo& info = recording.info;
  SessionData& data = recording.data;
  info.bag = boost::join(request.paths, " ");
  info.notes = bags.notes();
  // Nameless topics are not read: of an IMU that is missing, of poses from elsewhere.
  info.imus = request.NamesImuFile() ? std::vector<ImuInfo>() : ChooseImus(bags, request);
  data.imus.resize(info.imus.size());
  std::vector<ImuReader> imus;
  for (ImuInfo& imu : info.imus) imus.push_back({&imu, {}, {}});
  std::vector<PoseReader> poses;  // the marker first, chosen among what is no pose sensor
  for (const std::string& name : SplitPaths(request.pose_sensors))
    poses.push_back(ChoosePoseSensor(bags, request, name));
  poses.insert(poses.begin(), ChooseMarker(bags, request));
  std::set<std::string> topics;
  std::vector<std::string> names;
  for (const PoseReader& reader : poses) {
    topics.insert(reader.topic.name);
    names.push_back(reader.Name());
  }
  CheckPoseSensors(names.front(), {names.begin() + 1, names.end()});
  for (const ImuInfo& imu : info.imus) topics.insert({imu.GyroSource(), imu.AccelSource()});
  topics.erase("");
  // All in one pass: what is compressed is unfolded once.
  bags.ForEach(topics, [&](const BagMessage& message) {
    for (ImuReader& imu : imus) imu.Add(message, request.record_time);
    for (PoseReader& reader : poses) reader.Add(message, request.record_time);
    return true;
  });

  for (size_t i = 0; i < imus.size(); ++i) imus[i].Finish(&data.imus[i]);
  for (PoseReader& reader : poses)
    if (reader.tf) ReadTf(bags, request, &reader);
  poses[0].Finish(request.record_time, &info, &data.poses);
  for (size_t k = 1; k < poses.size(); ++k)
    poses[k].Finish(&info.pose_sensors.emplace_back(), &data.pose_sensors.emplace_back());
  return recording;
}

// --- Which bags are one recording ---

/// Bags of one recording follow each other by no more than this, or overlap by as little [s].
constexpr double kMaxPause = 2.0, kMaxOverlap = 0.5;

/// When a bag was recorded and what it holds of poses and IMUs.
struct BagSpan {
  double begin_s, end_s;
  std::set<std::string> topics;
  size_t recording;  ///< the first bag of that which it is of

  BagSpan(const std::string& path, size_t number) : recording(number) {
    const Bags bag({path}, 0.0, 0.0);
    begin_s = bag.begin_s();
    end_s = begin_s + bag.duration_s();
    for (const BagTopic& topic : bag.topics())
      if (topic.IsImu() || topic.IsVector() || topic.IsPose()) topics.insert(topic.name);
  }

  /// Whether both are of one recording: one goes on where the other ends, or they hold other topics
  /// of the same time.
  bool Continues(const BagSpan& other) const {
    const double pause = std::max(begin_s, other.begin_s) - std::min(end_s, other.end_s);
    if (pause > kMaxPause) return false;
    return pause > -kMaxOverlap ||
           std::none_of(topics.begin(), topics.end(),
                        [&](const std::string& topic) { return other.topics.count(topic) > 0; });
  }
};

/// What `read` returns, with printable errors.
template <typename Read>
auto Printably(const std::vector<std::string>& paths, Read read) {
  try {
    return read();
  } catch (const InputError& error) {  // with names of topics, types and frames as in the bag
    Reject(Printable(error.what()));
  } catch (const std::runtime_error& error) {  // times out of range, in tf2
    Reject(Printable("bag '" + FileNames(paths) + "' is damaged (" + error.what() + ")"));
  }
}

}  // namespace

Recording ReadBag(const RecordingRequest& request) {
  Recording recording = Printably(request.paths, [&] { return Read(request); });
  ReadFiles(request, &recording);
  return recording;
}

std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths) {
  if (paths.size() < 2) return {paths};
  CheckBagsExist(paths);
  return Printably(paths, [&] {
    std::vector<BagSpan> spans;
    for (const std::string& path : paths) {
      const BagSpan& own = spans.emplace_back(path, spans.size());
      for (const BagSpan& other : spans) {
        if (!own.Continues(other)) continue;
        const size_t one = std::min(own.recording, other.recording);
        const size_t joined = std::max(own.recording, other.recording);
        for (BagSpan& span : spans)
          if (span.recording == joined) span.recording = one;
      }
    }
    std::map<size_t, std::vector<std::string>> by_first;
    for (size_t i = 0; i < paths.size(); ++i) by_first[spans[i].recording].push_back(paths[i]);
    std::vector<std::vector<std::string>> recordings;
    for (auto& [first, bags] : by_first) recordings.push_back(std::move(bags));
    return recordings;
  });
}

}  // namespace imu_pose_calib
