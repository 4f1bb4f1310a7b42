#include "imu_pose_calib/ros/io/bags.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/predicate.hpp>
#include <cmath>
#include <map>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {
namespace {

constexpr char kRigidBodies[] = "mocap4r2_msgs/RigidBodies";
constexpr char kNamedPoses[] = "motion_capture_tracking_interfaces/NamedPoseArray";

template <typename T>
T Next(MessageInput* input) {
  T value;
  input->next(value);
  return value;
}

}  // namespace

void BagMessage::Read(const std::function<void(MessageInput*)>& read) const {
  try {
    const bool is_cdr = md5sum == nullptr;
    std::string unfolded;
    const bool is_compressed = is_cdr && boost::starts_with(data, kZstdMagic);  // CDR begins with 0
    if (is_compressed) unfolded = DecompressZstd(data, kMaxBlockSize);
    MessageInput input(is_compressed ? unfolded : data, is_cdr);
    read(&input);
    input.Finish();
  } catch (const InputError& error) {
    Reject("topic '", topic, "', message recorded at ", ToNanoseconds(time), " ns is no ", type,
           ": ", error.what());
  }
}

bool BagTopic::IsPose() const { return IsBodies() || IsPoseType(type); }

bool BagTopic::IsBodies() const { return type == kRigidBodies || type == kNamedPoses; }

std::vector<FramedPose> ReadBodies(const BagMessage& message) {
  const bool has_markers = message.type == kRigidBodies;
  std::vector<FramedPose> bodies;
  message.Read([&](MessageInput* input) {
    const auto header = Next<std_msgs::Header>(input);
    if (has_markers) Next<uint32_t>(input);  // frame
    const uint32_t count = input->Count();
    for (uint32_t k = 0; k < count; ++k) {
      const auto name = Next<std::string>(input);
      for (uint32_t markers = has_markers ? input->Count() : 0; markers > 0; --markers) {
        Next<int8_t>(input);   // kind of its number
        Next<int32_t>(input);  // number
        Next<std::string>(input);
        Next<geometry_msgs::Point>(input);
      }
      const auto pose = Next<geometry_msgs::Pose>(input);
      bodies.push_back({ToPoseSample(header.stamp, pose), header.frame_id, name});
    }
  });
  return bodies;
}

std::string Describe(const std::vector<BagTopic>& topics) {
  std::vector<std::string> texts;
  for (const BagTopic& t : topics)
    texts.push_back(t.name + " (" + t.type + ", " + std::to_string(t.count) + ")");
  return boost::join(texts, ", ");
}

Bags::Bags(const std::vector<std::string>& paths, double start_s, double duration_s)
    : paths_(paths) {
  CheckBagsExist(paths_);
  for (const std::string& path : paths_) {
    const std::vector<std::string> files = MessageFiles(path);
    if (files.empty()) Reject("bag '", path, "' is not a file, and no file of a bag is in it");
    for (const std::string& file : files) files_.push_back(OpenBagFile(file));
  }
  for (const auto& file : files_) {
    for (const BagFile::Entry& entry : file->entries()) index_.push_back({entry, file.get()});
    if (!file->note().empty()) notes_.push_back(file->note());
  }
  std::stable_sort(index_.begin(), index_.end(),
                   [](const Place& a, const Place& b) { return a.entry.t_ns < b.entry.t_ns; });
  SetSpan(start_s, duration_s);
  std::map<std::string, std::set<std::string>> types;
  std::set<bool> kinds;  // of ROS: 1 has a sum of each definition
  for (const auto& file : files_)
    for (const BagFile::Topic& topic : file->topics()) {
      types[topic.name].insert(topic.type);
      kinds.insert(topic.md5sum.has_value());
    }
  if (kinds.size() > 1)
    Reject("bags of ROS 1 and of ROS 2 cannot be one recording: ", FileNames(paths_));
  std::map<std::string, uint32_t> counts;
  for (const Place& place : index_)
    if (IsUsed(place)) ++counts[place.file->topics()[place.entry.topic].name];
  for (const auto& [name, its] : types)  // more than one type fits no role
    topics_.push_back({name, boost::join(its, " and "), counts[name]});
}

const BagTopic& Bags::Find(const std::string& field, const std::string& name,
                           const std::vector<std::string>& types) const {
  const auto topic = std::find_if(topics_.begin(), topics_.end(),
                                  [&](const BagTopic& t) { return t.name == name; });
  if (topic == topics_.end()) Reject(field, " '", name, "' is not in ", Contents());
  if (topic->count == 0)
    Reject(field, " '", name, "' has no messages within the span used (",
           Seconds(start_ns_ - begin_ns_), " s to ", duration_s(), " s after the start)");
  if (!types.empty() && std::count(types.begin(), types.end(), topic->type) == 0)
    Reject(field, " '", name, "' is ", topic->type, ", must be ", boost::join(types, " or "));
  return *topic;
}

std::vector<BagTopic> Bags::Select(const std::function<bool(const BagTopic&)>& is_wanted) const {
  std::vector<BagTopic> selected;
  for (const BagTopic& topic : topics_)
    if (topic.count > 0 && is_wanted(topic)) selected.push_back(topic);
  return selected;
}

std::string Bags::Contents() const { return FileNames(paths_) + "; it has: " + Describe(topics_); }

void Bags::ForEach(const std::set<std::string>& topics,
                   const std::function<bool(const BagMessage&)>& use, bool all) const {
  for (const auto& place : index_) {
    const auto& [entry, file] = place;
    const auto& [name, type, md5sum] = file->topics()[entry.topic];
    if (!(all || IsUsed(place)) || topics.count(name) == 0) continue;
    if (!use({name, type, FromNanoseconds(entry.t_ns), file->Read(entry),
              md5sum ? &*md5sum : nullptr}))
      return;
  }
}

void Bags::SetSpan(double start_s, double duration_s) {
  CheckSpan(start_s, duration_s);
  if (index_.empty()) {
    for (const auto& file : files_)
      if (!file->problem().empty()) Reject(file->problem());
    Reject("bag '", FileNames(paths_), "' holds no messages");
  }
  begin_ns_ = index_.front().entry.t_ns;
  const int64_t last_ns = index_.back().entry.t_ns;
  for (const int64_t t_ns : {begin_ns_, last_ns}) FromNanoseconds(t_ns);  // throws
  const double length_s = Seconds(last_ns - begin_ns_);
  if (start_s > length_s)
    Reject("start = ", start_s, " s is beyond the end of the bag, which lasts ", length_s, " s");
  start_ns_ = begin_ns_ + std::llround(1e9 * start_s);
  end_ns_ = last_ns;
  if (duration_s > 0.0 && start_s + duration_s < length_s)
    end_ns_ = start_ns_ + std::llround(1e9 * duration_s);
}

}  // namespace imu_pose_calib
