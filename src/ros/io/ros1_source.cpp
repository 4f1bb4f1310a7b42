#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>

#include "imu_pose_calib/ros/io/message_source.h"

namespace imu_pose_calib {
namespace {

/// Opens a bag or throws InputError with the reason and the remedy.
void Open(const std::string& path, rosbag::Bag* bag) {
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw InputError("bag '" + path + "' cannot be read: " + std::strerror(errno));

  const std::string magic = "#ROSBAG V";
  std::string header(magic.size() + 3, '\0');
  file.read(header.data(), static_cast<std::streamsize>(header.size()));
  if (header.compare(0, magic.size(), magic) != 0)
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
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

class Ros1Source : public MessageSource {
 public:
  explicit Ros1Source(const std::vector<std::string>& paths) {
    for (const std::string& path : paths) {
      bags_.push_back(std::make_unique<rosbag::Bag>());
      Open(path, bags_.back().get());
    }
  }

  std::map<std::string, std::set<std::string>> Types() const override {
    std::map<std::string, std::set<std::string>> types;
    for (const auto& bag : bags_) {
      rosbag::View view(*bag);
      for (const rosbag::ConnectionInfo* connection : view.getConnections())
        types[connection->topic].insert(connection->datatype);
    }
    return types;
  }

  std::optional<std::pair<ros::Time, ros::Time>> Span() const override {
    rosbag::View all;
    for (const auto& bag : bags_) all.addQuery(*bag);
    if (all.size() == 0) return std::nullopt;
    return std::make_pair(all.getBeginTime(), all.getEndTime());
  }

  std::map<std::string, uint32_t> Counts(const ros::Time& start,
                                         const ros::Time& end) const override {
    std::map<std::string, uint32_t> counts;
    for (const auto& [topic, types] : Types()) counts[topic] = View({topic}, start, end)->size();
    return counts;
  }

  void ForEach(const std::vector<std::string>& topics,
               const ros::Time& start,
               const ros::Time& end,
               const std::function<bool(const BagMessage&)>& use) const override {
    const auto view = View(topics, start, end);
    for (const rosbag::MessageInstance& message : *view)
      if (!use(BagMessage(message))) return;
  }

 private:
  std::unique_ptr<rosbag::View> View(const std::vector<std::string>& topics,
                                     const ros::Time& start,
                                     const ros::Time& end) const {
    auto view = std::make_unique<rosbag::View>();
    if (topics.empty()) return view;
    for (const auto& bag : bags_) view->addQuery(*bag, rosbag::TopicQuery(topics), start, end);
    return view;
  }

  std::vector<std::unique_ptr<rosbag::Bag>> bags_;
};

}  // namespace

std::unique_ptr<MessageSource> OpenRos1(const std::vector<std::string>& paths) {
  return std::make_unique<Ros1Source>(paths);
}

}  // namespace imu_pose_calib
