#include <algorithm>
#include <map>
#include <sstream>

#include "imu_pose_calib/ros/io/bag_reader.h"
#include "imu_pose_calib/ros/io/bags.h"

namespace imu_pose_calib {
namespace {

/// Bags of one recording follow each other by no more than this, or overlap by as little [s].
constexpr double kMaxPause = 2.0, kMaxOverlap = 0.5;

/// When a bag was recorded and what it holds of poses and IMUs.
struct BagSpan {
  double begin_s, end_s;
  std::vector<std::string> topics;

  explicit BagSpan(const std::string& path) {
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
      return std::count(other.topics.begin(), other.topics.end(), topic) > 0;
    };
    return pause > -kMaxOverlap || std::none_of(topics.begin(), topics.end(), is_shared);
  }
};

}  // namespace

std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths) {
  if (paths.size() < 2) return {paths};
  CheckBagsExist(paths);
  BagRequest request;
  request.paths = paths;
  // Of each bag the number of its recording.
  std::istringstream numbers(ReadApart(request, [&paths] {
    std::vector<BagSpan> spans;
    std::vector<size_t> group;
    std::ostringstream text;
    for (const std::string& path : paths) {
      const BagSpan span(path);
      size_t own = spans.size();
      for (size_t k = 0; k < spans.size(); ++k)
        if (span.Continues(spans[k])) own = std::min(own, group[k]);
      spans.push_back(span);
      group.push_back(own);
      text << own << " ";
    }
    return text.str();
  }));
  std::map<size_t, std::vector<std::string>> groups;
  size_t number = 0;
  for (const std::string& path : paths)
    if (numbers >> number) groups[number].push_back(path);
  std::vector<std::vector<std::string>> recordings;
  for (const auto& [first, bags] : groups) recordings.push_back(bags);
  return recordings;
}

}  // namespace imu_pose_calib
