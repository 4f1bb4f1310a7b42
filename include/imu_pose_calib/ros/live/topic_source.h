#pragma once

#include <ros/ros.h>
#include <topic_tools/shape_shifter.h>

#include <string>
#include <vector>

namespace imu_pose_calib {

/// A topic that may be of several types and need not exist yet. When it is not named, it is the one
/// topic of these types. No message is dropped on this side.
class TopicSource {
 public:
  using Message = ros::MessageEvent<const topic_tools::ShapeShifter>;
  using Callback = boost::function<void(const Message&)>;

  /// `parameter` is what names the topic; `callback` gets the messages of the types given.
  TopicSource(const ros::NodeHandle& node,
              const std::string& parameter,
              const std::string& topic,
              const std::vector<std::string>& types,
              const Callback& callback);

  /// Empty until it is named or found.
  const std::string& topic() const { return topic_; }
  bool HasData() const { return count_ > 0; }

  /// Looks at what is published: subscribes when the one topic is there, and says why nothing has
  /// come in so far.
  std::string Look();

 private:
  void Subscribe(const std::string& topic);
  void OnMessage(const Message& message);
  bool Accepts(const std::string& type) const;

  ros::NodeHandle node_;
  const std::string parameter_;
  const bool is_named_;
  std::string topic_;
  const std::vector<std::string> types_;
  const Callback callback_;
  ros::Subscriber subscriber_;
  size_t count_ = 0;
  std::string problem_;  ///< of the last message
  const ros::SteadyTime start_ = ros::SteadyTime::now();
};

}  // namespace imu_pose_calib
