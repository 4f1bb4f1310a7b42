#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <future>
#include <map>
#include <thread>
#include <utility>

#include "imu_pose_calib/ros/io/message_source.h"

namespace imu_pose_calib {
namespace {

/// Of what a thread reads at a time [s]: chunks at the ends are unfolded twice, all in it is held.
constexpr double kShortestPart = 10.0, kLongestPart = 60.0;
constexpr unsigned kMostCores = 8;
constexpr size_t kBeginning = 100, kSmall = 4096;  // messages, and [bytes] of one of these

/// The bag has no index that could be read.
class CutOff : public InputError {
 public:
  using InputError::InputError;
};

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
    throw CutOff("bag '" + path + "' has no index, its recording was cut off; run: rosbag " +
                 "reindex " + path);
  } catch (const rosbag::BagException& error) {
    throw CutOff("bag '" + path + "' is damaged or cut off (" + error.what() +
                 "); run: rosbag reindex " + path);
  }
}

/// Messages of a part of a recording, taken out of it.
class Part {
 public:
  void Add(const rosbag::MessageInstance& message) {
    const size_t begin = data_.size();
    data_.resize(begin + message.size());
    ros::serialization::OStream stream(data_.data() + begin, message.size());
    message.write(stream);
    messages_.push_back({message, begin, message.size()});
  }
  void Clear() {
    messages_.clear();
    data_.clear();
  }
  /// Whether `use` was true for all.
  bool ForEach(const std::function<bool(const BagMessage&)>& use) const {
    return std::all_of(messages_.begin(), messages_.end(), [&](const Message& m) {
      return use({m.of.getTopic(),
                  m.of.getDataType(),
                  m.of.getTime(),
                  {reinterpret_cast<const char*>(data_.data()) + m.begin, m.size},
                  &m.of.getMD5Sum()});
    });
  }

 private:
  struct Message {
    rosbag::MessageInstance of;  ///< for all but its data
    size_t begin, size;
  };
  std::vector<Message> messages_;
  std::vector<uint8_t> data_;
};

class Ros1Source : public MessageSource {
 public:
  explicit Ros1Source(const std::vector<std::string>& paths) : paths_(paths) {
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

  /// The bags are unfolded by all cores: parts that follow the one in hand by others that have
  /// opened them, too, once that one has shown that more than its beginning is wanted, and that
  /// messages are small enough to be held.
  void ForEach(const std::vector<std::string>& topics, const ros::Time& start, const ros::Time& end,
               const std::function<bool(const BagMessage&)>& use) const override {
    const unsigned cores = std::clamp(std::thread::hardware_concurrency(), 1u, kMostCores);
    helpers_.resize(cores - 1);
    const double share_s = 1e-9 * static_cast<double>(end.toNSec() - start.toNSec()) / cores;
    const auto length =
        static_cast<uint64_t>(1e9 * std::clamp(share_s, kShortestPart, kLongestPart));
    for (uint64_t begin = start.toNSec(); begin <= end.toNSec(); begin += cores * length) {
      const auto rest = View(topics, ros::Time().fromNSec(begin), end);
      if (rest->begin() == rest->end()) return;
      begin = rest->getBeginTime().toNSec();  // after a gap of any length
      const auto view = [&](unsigned k, const Ros1Source& source) {
        const uint64_t first = begin + k * length;
        const uint64_t last = std::min(first + length - 1, end.toNSec());
        return source.View(topics, ros::Time().fromNSec(first), ros::Time().fromNSec(last));
      };
      std::map<unsigned, std::future<Part>> others;
      Part one;
      size_t count = 0, largest = 0;
      for (unsigned k = 0; k < cores && begin + k * length <= end.toNSec(); ++k) {
        if (others.count(k) > 0) {
          if (!others[k].get().ForEach(use)) return;
          continue;
        }
        const auto own = view(k, *this);
        for (const rosbag::MessageInstance& message : *own) {
          one.Clear();
          one.Add(message);
          if (!one.ForEach(use)) return;
          largest = std::max<size_t>(largest, message.size());
          if (++count != kBeginning || largest > kSmall) continue;
          for (unsigned j = k + 1; j < cores && begin + j * length <= end.toNSec(); ++j)
            others[j] = std::async(std::launch::async, [this, &view, j] {
              std::unique_ptr<Ros1Source>& helper = helpers_[j - 1];
              if (!helper) helper = std::make_unique<Ros1Source>(paths_);
              Part part;
              const auto its = view(j, *helper);
              for (const rosbag::MessageInstance& ahead : *its) part.Add(ahead);
              return part;
            });
        }
      }
    }
  }

 private:
  std::unique_ptr<rosbag::View> View(const std::vector<std::string>& topics, const ros::Time& start,
                                     const ros::Time& end) const {
    auto view = std::make_unique<rosbag::View>();
    if (topics.empty()) return view;
    for (const auto& bag : bags_) view->addQuery(*bag, rosbag::TopicQuery(topics), start, end);
    return view;
  }

  const std::vector<std::string> paths_;
  std::vector<std::unique_ptr<rosbag::Bag>> bags_;
  mutable std::vector<std::unique_ptr<Ros1Source>> helpers_;  ///< one for each further core
};

}  // namespace

std::unique_ptr<MessageSource> OpenRos1(const std::vector<std::string>& paths) {
  try {
    return std::make_unique<Ros1Source>(paths);
  } catch (const CutOff&) {
    std::unique_ptr<MessageSource> source = ScanRos1(paths);
    if (!source) throw;
    return source;
  }
}

}  // namespace imu_pose_calib
