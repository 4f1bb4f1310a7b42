#include "imu_pose_calib/ros/io/bags.h"

#include <algorithm>
#include <boost/algorithm/string/predicate.hpp>
#include <filesystem>
#include <map>
#include <set>
#include <sstream>
#include <tuple>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {
namespace {

constexpr char kRigidBodies[] = "mocap4r2_msgs/RigidBodies";
constexpr char kNamedPoses[] = "motion_capture_tracking_interfaces/NamedPoseArray";

/// Reads over the markers of a body.
void SkipMarkers(CdrInput* input) {
  const uint32_t markers = input->Count();
  for (uint32_t k = 0; k < markers; ++k) {
    input->Number<int8_t>();   // kind of the number
    input->Number<int32_t>();  // number
    input->String();
    geometry_msgs::Point position;
    input->next(position);
  }
}

std::string Seconds(double value) {
  std::ostringstream text;
  text << value << " s";
  return text.str();
}

}  // namespace

bool BagTopic::IsImu() const { return type == kImuType; }

bool BagTopic::IsVector() const { return type == kVectorType; }

bool BagTopic::IsPose() const { return IsBodies() || FindPoseType<BagMessage>(type) != nullptr; }

bool BagTopic::IsBodies() const { return type == kRigidBodies || type == kNamedPoses; }

bool BagTopic::IsTf() const { return type == "tf2_msgs/TFMessage" || type == "tf/tfMessage"; }

bool BagTopic::IsFixedTf() const { return IsTf() && boost::ends_with(name, "tf_static"); }

std::vector<FramedPose> ReadBodies(const BagMessage& message) {
  const bool has_markers = message.type == kRigidBodies;
  std::vector<FramedPose> bodies;
  message.Decode([&](std::string_view data) {
    CdrInput input(data);
    std_msgs::Header header;
    input.next(header);
    if (has_markers) input.Number<uint32_t>();  // frame
    const uint32_t count = input.Count();
    for (uint32_t k = 0; k < count; ++k) {
      const std::string name = input.String();
      if (has_markers) SkipMarkers(&input);
      geometry_msgs::Pose pose;
      input.next(pose);
      bodies.push_back({ToPoseSample(header.stamp, pose), header.frame_id, name});
    }
    input.Finish();
  });
  return bodies;
}

std::string Describe(const std::vector<BagTopic>& topics) {
  std::string text;
  for (const BagTopic& topic : topics)
    text += (text.empty() ? "" : ", ") + topic.name + " (" + topic.type + ", " +
            std::to_string(topic.count) + ")";
  return text;
}

std::string FileNames(const std::vector<std::string>& paths) {
  std::string names;
  for (const std::filesystem::path path : paths)  // a folder may end with a slash
    names += (names.empty() ? "" : ", ") +
             (path.has_filename() ? path : path.parent_path()).filename().string();
  return names;
}

Bags::Bags(const std::vector<std::string>& paths, double start_s, double duration_s)
    : paths_(paths) {
  std::set<std::filesystem::path> known;
  for (const std::string& path : paths_) {
    if (!std::filesystem::exists(path)) throw InputError("bag '" + path + "' does not exist");
    if (!known.insert(std::filesystem::canonical(path)).second)
      throw InputError("bag '" + path + "' is given twice");
  }
  const auto ros2 = std::count_if(paths_.begin(), paths_.end(), IsRos2Bag);
  if (ros2 != 0 && ros2 != static_cast<int64_t>(paths_.size()))
    throw InputError("bags of ROS 1 and of ROS 2 cannot be one recording: " + FileNames(paths_));
  source_ = ros2 == 0 ? OpenRos1(paths_) : OpenRos2(paths_);
  SetSpan(start_s, duration_s);
  ListTopics();
}

const BagTopic& Bags::Find(const std::string& field, const std::string& name) const {
  for (const BagTopic& topic : topics_) {
    if (topic.name != name) continue;
    if (topic.count == 0)
      throw InputError(field + " '" + name + "' has no messages within the span used (" +
                       Seconds((start_ - begin_).toSec()) + " to " + Seconds(duration_s()) +
                       " after the start)");
    return topic;
  }
  throw InputError(field + " '" + name + "' is not in " + Contents());
}

std::string Bags::Contents() const { return FileNames(paths_) + "; it has: " + Describe(topics_); }

void Bags::SetSpan(double start_s, double duration_s) {
  CheckSpan(start_s, duration_s);
  const auto span = source_->Span();
  if (!span) throw InputError("bag '" + FileNames(paths_) + "' holds no messages");
  std::tie(begin_, bag_end_) = *span;
  const double length_s = (bag_end_ - begin_).toSec();
  if (start_s > length_s)
    throw InputError("start = " + Seconds(start_s) + " is beyond the end of the bag, which lasts " +
                     Seconds(length_s));
  start_ = begin_ + ros::Duration(start_s);
  end_ = bag_end_;
  if (duration_s > 0.0 && start_s + duration_s < length_s)
    end_ = start_ + ros::Duration(duration_s);
}

void Bags::ListTopics() {
  std::map<std::string, uint32_t> counts = source_->Counts(start_, end_);
  for (const auto& [name, types] : source_->Types()) {
    BagTopic topic{name, *types.begin()};
    if (types.size() > 1) topic.type += " and " + *types.rbegin();  // fits no role
    topic.count = counts[name];
    topics_.push_back(topic);
  }
}

}  // namespace imu_pose_calib
