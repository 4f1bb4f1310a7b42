#include "imu_pose_calib/ros/io/bags.h"

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <sstream>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/pose_messages.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {
namespace {

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

std::string Seconds(double value) {
  std::ostringstream text;
  text << value << " s";
  return text.str();
}

}  // namespace

bool BagTopic::IsImu() const { return type == kImuType; }

bool BagTopic::IsVector() const { return type == kVectorType; }

bool BagTopic::IsPose() const { return FindPoseType<BagMessage>(type) != nullptr; }

bool BagTopic::IsTf() const { return type == "tf2_msgs/TFMessage" || type == "tf/tfMessage"; }

bool BagTopic::IsFixedTf() const {
  const std::string ending = "tf_static";
  return IsTf() && name.size() >= ending.size() &&
         name.compare(name.size() - ending.size(), ending.size(), ending) == 0;
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
  for (const std::string& path : paths)
    names += (names.empty() ? "" : ", ") + std::filesystem::path(path).filename().string();
  return names;
}

Bags::Bags(const std::vector<std::string>& paths, double start_s, double duration_s)
    : paths_(paths) {
  std::set<std::filesystem::path> known;
  for (const std::string& path : paths_) {
    bags_.push_back(std::make_unique<rosbag::Bag>());
    Open(path, bags_.back().get());
    if (!known.insert(std::filesystem::canonical(path)).second)
      throw InputError("bag '" + path + "' is given twice");
  }
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

std::unique_ptr<rosbag::View> Bags::View(const std::vector<BagTopic>& topics,
                                         const ros::Time& start,
                                         const ros::Time& end) const {
  std::vector<std::string> names;
  for (const BagTopic& topic : topics) names.push_back(topic.name);
  auto view = std::make_unique<rosbag::View>();
  if (names.empty()) return view;
  for (const auto& bag : bags_) view->addQuery(*bag, rosbag::TopicQuery(names), start, end);
  return view;
}

void Bags::SetSpan(double start_s, double duration_s) {
  CheckSpan(start_s, duration_s);
  rosbag::View all;
  for (const auto& bag : bags_) all.addQuery(*bag);
  if (all.size() == 0) throw InputError("bag '" + FileNames(paths_) + "' holds no messages");
  begin_ = all.getBeginTime();
  bag_end_ = all.getEndTime();
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
  std::map<std::string, std::set<std::string>> types;
  for (const auto& bag : bags_) {
    rosbag::View view(*bag);
    for (const rosbag::ConnectionInfo* connection : view.getConnections())
      types[connection->topic].insert(connection->datatype);
  }
  for (const auto& [name, names] : types) {
    BagTopic topic{name, *names.begin()};
    if (names.size() > 1) topic.type += " and " + *names.rbegin();  // fits no role
    topic.count = View({topic}, start_, end_)->size();
    topics_.push_back(topic);
  }
}

}  // namespace imu_pose_calib
