#include "imu_pose_calib/ros/io/tf_chain.h"

#include <tf2/buffer_core.h>
#include <tf2/exceptions.h>

#include <algorithm>
#include <boost/range/algorithm_ext/erase.hpp>
#include <cmath>
#include <limits>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

/// tf2 takes no other transforms.
bool IsUsable(const geometry_msgs::Transform& transform) {
  const PoseSample pose = ToPoseSample(ros::Time(), transform);
  return pose.p_WM.allFinite() && std::abs(pose.q_WM.squaredNorm() - 1.0) < 1e-2;
}

}  // namespace

TfChain::TfChain(const std::string& parent, const std::string& child, double cache_s)
    : parent_(FrameName(parent, "")),
      child_(FrameName(child, "")),
      cache_ns_(static_cast<int64_t>(1e9 * cache_s)),
      buffer_(std::make_shared<tf2::BufferCore>(ros::Duration(cache_s))) {}

void TfChain::Add(const tf2_msgs::TFMessage& message, bool fixed) {
  for (geometry_msgs::TransformStamped transform : message.transforms) {
    transform.header.frame_id = FrameName(transform.header.frame_id, "");
    transform.child_frame_id = FrameName(transform.child_frame_id, "");
    if (transform.header.frame_id.empty() || transform.child_frame_id.empty() ||
        transform.header.frame_id == transform.child_frame_id)
      continue;  // no link
    if (!fixed) {
      AddMoving(transform);
    } else if (IsUsable(transform.transform)) {
      Link& link = links_[transform.child_frame_id];
      link.parent = transform.header.frame_id;
      link.fixed = true;
      buffer_->setTransform(transform, "", true);
    }
  }
}

void TfChain::AddMoving(const geometry_msgs::TransformStamped& transform) {
  Link& link = links_[transform.child_frame_id];
  if (link.fixed) return;  // as in tf2, where the static transform stays
  link.parent = transform.header.frame_id;

  const int64_t stamp = ToNanoseconds(transform.header.stamp);
  if (stamp == 0) return;  // tf2 would take it for the latest
  // tf2 adds the time that it keeps.
  const bool usable =
      IsUsable(transform.transform) && stamp <= ToNanoseconds(ros::TIME_MAX) - cache_ns_;
  if (link.last == 0) {
    if (!usable) return;  // no pose before the first usable one
    link.first = stamp;
    link.first_transform = transform.transform;
  }
  auto& updates = link.updates;
  if (usable && !link.moves && transform.transform != link.first_transform) {
    link.moves = true;
    if (link.first > last_taken_) updates.emplace(link.first, false);
  }
  if (link.moves || !usable) updates[stamp] |= !usable;
  if (usable) {
    if (stamp != link.last) buffer_->setTransform(transform, "");  // else it warns of each
    link.first = std::min(link.first, stamp);
    link.last = std::max(link.last, stamp);
  }
  // Nothing is known of updates further from the last usable one than the cache.
  updates.erase(updates.begin(), updates.lower_bound(link.last - cache_ns_));
  updates.erase(updates.upper_bound(link.last + cache_ns_), updates.end());
}

std::vector<PoseSample> TfChain::TakePoses() {
  const auto chain = Chain();
  if (!chain || chain->empty()) return {};
  int64_t begin = 0, end = std::numeric_limits<int64_t>::max();  // of what all have in common
  for (const std::string& frame : *chain) {
    begin = std::max(begin, links_[frame].first);
    end = std::min(end, links_[frame].last);
  }

  std::map<int64_t, bool> due;  // stamp; whether one of its updates is unusable
  for (const std::string& frame : *chain) {
    auto& updates = links_[frame].updates;
    const auto waiting = updates.upper_bound(end);
    for (auto update = updates.begin(); update != waiting; ++update)
      due[update->first] |= update->second;
    updates.erase(updates.begin(), waiting);
  }

  std::vector<PoseSample> poses;
  for (const auto& [stamp, is_lost] : due) {
    if (stamp < begin) continue;
    last_taken_ = std::max(last_taken_, stamp);
    PoseSample& pose = poses.emplace_back();
    pose.t_ns = stamp;
    pose.p_WM.setConstant(std::numeric_limits<double>::quiet_NaN());
    if (is_lost) continue;
    try {
      const ros::Time time = FromNanoseconds(stamp);
      pose = ToPoseSample(time, buffer_->lookupTransform(parent_, child_, time).transform);
    } catch (const tf2::TransformException&) {
      // a frame has changed its parent meanwhile
    }
  }
  return poses;
}

size_t TfChain::Pending() const {
  size_t count = 0;
  for (const auto& [child, link] : links_) count += link.updates.size();
  return count;
}

std::vector<std::string> TfChain::Ancestry(std::string frame) const {
  std::vector<std::string> frames = {frame};
  for (auto link = links_.find(frame); link != links_.end(); link = links_.find(frame)) {
    frame = link->second.parent;
    if (std::find(frames.begin(), frames.end(), frame) != frames.end()) break;  // a loop
    frames.push_back(frame);
  }
  return frames;
}

std::optional<std::vector<std::string>> TfChain::Chain() const {
  std::vector<std::string> up = Ancestry(parent_), down = Ancestry(child_);
  if (up.back() != down.back()) return std::nullopt;
  // what both have in common does not count
  const auto [above, below] = std::mismatch(up.rbegin(), up.rend(), down.rbegin(), down.rend());
  up.erase(above.base(), up.end());
  up.insert(up.end(), down.begin(), below.base());
  boost::remove_erase_if(up, [&](const std::string& frame) { return links_.at(frame).fixed; });
  return up;
}

std::string TfChain::Problem() const {
  const auto is_known = [&](const std::string& frame) {
    return std::any_of(links_.begin(), links_.end(), [&](const auto& link) {
      return link.first == frame || link.second.parent == frame;
    });
  };
  if (!is_known(parent_)) return "tf_parent '" + parent_ + "' is not in tf, which has: " + Links();
  if (!is_known(child_)) return "tf_child '" + child_ + "' is not in tf, which has: " + Links();
  const std::string pair = "tf_parent '" + parent_ + "' and tf_child '" + child_ + "'";
  const auto chain = Chain();
  if (!chain) return pair + " are not connected in tf, which has: " + Links();
  if (chain->empty())
    return pair + " are fixed to each other: every link between them is static; choose " +
           "frames that move, tf has: " + Links();
  for (const std::string& frame : *chain)
    if (links_.at(frame).last == 0)
      return "'" + Printable(frame) + "', which is between " + pair +
             ", has no usable transform: stamp 0, not finite, or a quaternion that is not of unit "
             "length";
  const bool moves = std::any_of(chain->begin(), chain->end(),
                                 [&](const std::string& frame) { return links_.at(frame).moves; });
  return moves ? "" : pair + " do not move against each other";
}

std::optional<std::pair<std::string, std::string>> TfChain::SinglePair() const {
  if (links_.size() != 1) return std::nullopt;
  return std::make_pair(links_.begin()->second.parent, links_.begin()->first);
}

std::string TfChain::Links() const {
  std::string text;
  for (const auto& [child, link] : links_)
    text += (text.empty() ? "" : ", ") + Printable(link.parent) + " -> " + Printable(child) +
            (link.fixed ? " (fixed)" : "");
  return text.empty() ? "nothing" : text;
}

}  // namespace imu_pose_calib
