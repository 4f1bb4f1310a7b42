#pragma once

#include <ros/message_traits.h>

#include <functional>
#include <memory>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/cdr.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {

/// A message of a bag of ROS 1 or ROS 2 as it was recorded, as long as the bag hands it out.
struct BagMessage {
  const std::string& topic;
  const std::string& type;              ///< as ROS 1 names it: "sensor_msgs/Imu"
  ros::Time time;                       ///< of recording
  std::string_view data;                ///< of ROS 2: CDR, perhaps compressed by zstd
  const std::string* md5sum = nullptr;  ///< of the type's definition; null: of ROS 2

  /// The message. Throws InputError when its type is defined differently here.
  template <typename Msg>
  std::unique_ptr<Msg> instantiate() const {  // NOLINT(readability-identifier-naming)
    if (md5sum ? *md5sum != ros::message_traits::MD5Sum<Msg>::value()
               : type != ros::message_traits::DataType<Msg>::value())
      Reject("topic '", topic, "' has another definition of ", type, " than this computer");
    auto msg = std::make_unique<Msg>();
    Read([&msg](MessageInput* input) { input->next(*msg); });
    return msg;
  }

  /// Runs `read` on all of the message, with errors that name it.
  void Read(const std::function<void(MessageInput*)>& read) const;
};

/// A topic of a recording and the messages of it within the span used.
struct BagTopic {
  std::string name, type;
  uint32_t count = 0;

  bool IsImu() const { return type == kImuType; }
  bool IsVector() const { return type == kVectorType; }
  bool IsPose() const;
  bool IsBodies() const;  ///< poses of several bodies in each message
  bool IsTf() const { return type == "tf2_msgs/TFMessage" || type == "tf/tfMessage"; }
};

/// The poses in a message of ROS 2 that holds those of several bodies, by name
/// (mocap4r2_msgs/RigidBodies, motion_capture_tracking_interfaces/NamedPoseArray), each with the
/// name of the body as its marker frame.
std::vector<FramedPose> ReadBodies(const BagMessage& message);

/// "NAME (TYPE, COUNT), ..." for error messages.
std::string Describe(const std::vector<BagTopic>& topics);

/// Open bags of ROS 1, or of ROS 2, as one recording, limited to a span of record time.
class Bags {
 public:
  /// The span starts `start_s` after the first record time; `duration_s` 0: to the end. Throws
  /// InputError with the reason and the remedy when a bag cannot be opened or the span is none.
  Bags(const std::vector<std::string>& paths, double start_s, double duration_s);

  const std::vector<BagTopic>& topics() const { return topics_; }
  /// What is to be said of the bags, as that one is cut off.
  const std::vector<std::string>& notes() const { return notes_; }
  double begin_s() const { return Seconds(begin_ns_); }  ///< first record time
  double duration_s() const { return Seconds(end_ns_ - begin_ns_); }

  /// Calls `use(message)` for the messages of these topics in the order of recording while it is
  /// true; `all`: also for those outside of the span.
  void ForEach(const std::set<std::string>& topics,
               const std::function<bool(const BagMessage&)>& use, bool all = false) const;

  /// The topic that `field` of a request names; InputError when the bags do not have it, or when it
  /// is of none of these types, if any are given.
  const BagTopic& Find(const std::string& field, const std::string& name,
                       const std::vector<std::string>& types = {}) const;

  /// Those that have messages within the span and are wanted.
  std::vector<BagTopic> Select(const std::function<bool(const BagTopic&)>& is_wanted) const;

  /// "NAMES; it has: TOPICS" for error messages.
  std::string Contents() const;

 private:
  struct Place {
    BagFile::Entry entry;
    BagFile* file;
  };

  void SetSpan(double start_s, double duration_s);
  bool IsUsed(const Place& place) const {
    return place.entry.t_ns >= start_ns_ && place.entry.t_ns <= end_ns_;
  }

  std::vector<std::string> paths_;
  std::vector<std::unique_ptr<BagFile>> files_;
  std::vector<Place> index_;  ///< in the order of recording
  /// Record time of the first message, and of the span to use.
  int64_t begin_ns_ = 0, start_ns_ = 0, end_ns_ = 0;
  std::vector<BagTopic> topics_;
  std::vector<std::string> notes_;
};

}  // namespace imu_pose_calib
