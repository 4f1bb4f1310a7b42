#pragma once

#include <ros/ros.h>
#include <topic_tools/shape_shifter.h>

#include <atomic>
#include <mutex>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// A topic that may be of several types and need not exist yet. When it is not named, it is the one
/// topic of these types. No message is dropped on this side.
///
/// Look() may run on another thread than the callbacks. A mutex of its own guards what they share;
/// it is held neither while the master is asked nor during `callback`.
class TopicSource {
 public:
  using Message = ros::MessageEvent<const topic_tools::ShapeShifter>;
  using Callback = boost::function<void(const Message&)>;

  /// `parameter` is what names the topic; `callback` gets the messages of the types given.
  TopicSource(const ros::NodeHandle& node, const std::string& parameter, const std::string& topic,
              const std::vector<std::string>& types, const Callback& callback);

  /// Empty until it is named or found.
  std::string topic() const;
  bool HasData() const { return count_ > 0; }
  /// Why nothing has come in so far, as Look() found; empty before.
  std::string State() const;

  /// Looks at what is published, and subscribes when the one topic is there, for which it waits
  /// until the master answers.
  void Look(const ros::master::V_TopicInfo& published);

 private:
  void Subscribe(const std::string& topic);
  void OnMessage(const Message& message);
  bool Accepts(const std::string& type) const;
  /// The one topic of these types, or else an empty name and why in `state`.
  std::string Find(const ros::master::V_TopicInfo& published, std::string* state) const;
  std::string Inspect(const ros::master::V_TopicInfo& published) const;

  ros::NodeHandle node_;
  const std::string parameter_;
  const bool is_named_;
  const std::vector<std::string> types_;
  const Callback callback_;
  const ros::SteadyTime start_ = ros::SteadyTime::now();
  std::atomic<size_t> count_{0};
  ros::Subscriber subscriber_;  ///< of the thread that looks

  mutable std::mutex mutex_;  ///< of all below
  std::string topic_;
  std::string problem_;  ///< of the last message
  std::string state_;
};

}  // namespace imu_pose_calib
