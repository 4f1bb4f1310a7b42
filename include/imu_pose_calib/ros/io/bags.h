#pragma once

#include <memory>
#include <set>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/message_source.h"

namespace imu_pose_calib {

/// A topic of a recording and the messages of it within the span used.
struct BagTopic {
  std::string name, type;
  uint32_t count = 0;

  bool IsImu() const;
  bool IsVector() const;
  bool IsPose() const;
  bool IsBodies() const;  ///< poses of several bodies in each message
  bool IsTf() const;
  bool IsFixedTf() const;
};

/// The poses in a message of ROS 2 that holds those of several bodies, by name
/// (mocap4r2_msgs/RigidBodies, motion_capture_tracking_interfaces/NamedPoseArray), each with the
/// name of the body as its marker frame.
std::vector<FramedPose> ReadBodies(const BagMessage& message);

/// "NAME (TYPE, COUNT), ..." for error messages.
std::string Describe(const std::vector<BagTopic>& topics);

/// "A.bag, B.bag" for error messages.
std::string FileNames(const std::vector<std::string>& paths);

/// Open bags of ROS 1, or of ROS 2, as one recording, limited to a span of record time.
class Bags {
 public:
  /// The span starts `start_s` after the first record time; `duration_s` 0: to the end. Throws
  /// InputError with the reason and the remedy when a bag cannot be opened or the span is none.
  Bags(const std::vector<std::string>& paths, double start_s, double duration_s);

  const std::vector<BagTopic>& topics() const { return topics_; }
  double begin_s() const { return begin_.toSec(); }  ///< first record time
  double duration_s() const { return (end_ - begin_).toSec(); }

  /// Calls `use(message)` for the messages of a topic in the order of recording while it is true.
  template <typename Use>
  void ForEach(const BagTopic& topic, Use use) const {
    source_->ForEach({topic.name}, start_, end_, use);
  }

  /// Calls `use(message)` for the messages of these topics in the order of recording.
  template <typename Use>
  void ForEach(const std::set<std::string>& topics, Use use) const {
    source_->ForEach({topics.begin(), topics.end()}, start_, end_, [&](const BagMessage& message) {
      use(message);
      return true;
    });
  }

  /// Calls `use(message, fixed)` for the tf messages: first all fixed ones of the whole bags, which
  /// are sent once, then the others in the order of recording.
  template <typename Use>
  void ForEachTf(Use use) const {
    const auto visit = [&](bool fixed, const ros::Time& start, const ros::Time& end) {
      std::vector<std::string> names;
      for (const BagTopic& topic : topics_)
        if (topic.IsTf() && topic.IsFixedTf() == fixed) names.push_back(topic.name);
      source_->ForEach(names, start, end, [&](const BagMessage& message) {
        use(message, fixed);
        return true;
      });
    };
    visit(true, begin_, bag_end_);
    visit(false, start_, end_);
  }

  /// The topic that `field` of a request names; InputError when the bags do not have it.
  const BagTopic& Find(const std::string& field, const std::string& name) const;

  template <typename Wanted>
  std::vector<BagTopic> Select(Wanted wanted) const {
    std::vector<BagTopic> selected;
    for (const BagTopic& topic : topics_)
      if (wanted(topic)) selected.push_back(topic);
    return selected;
  }

  /// "NAMES; it has: TOPICS" for error messages.
  std::string Contents() const;

  /// What is to be said of the bags, as that one is cut off.
  std::vector<std::string> Notes() const { return source_->Notes(); }

 private:
  void SetSpan(double start_s, double duration_s);
  void ListTopics();

  std::vector<std::string> paths_;
  std::unique_ptr<MessageSource> source_;
  ros::Time begin_, bag_end_;  ///< record time of the first and last message
  ros::Time start_, end_;      ///< record time, the span to use
  std::vector<BagTopic> topics_;
};

}  // namespace imu_pose_calib
