#pragma once

#include <ros/message_traits.h>
#include <ros/serialization.h>

#include <boost/make_shared.hpp>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/cdr.h"

namespace imu_pose_calib {

/// A message of a bag of ROS 1 or ROS 2 as it was recorded, as long as the bag hands it out.
struct BagMessage {
  const std::string& topic;
  const std::string& type;              ///< as ROS 1 names it: "sensor_msgs/Imu"
  ros::Time time;                       ///< of recording
  std::string_view data;                ///< of ROS 2: CDR
  const std::string* md5sum = nullptr;  ///< of the type's definition; null: of ROS 2

  /// The message. Throws InputError when its type is defined differently here.
  template <typename Msg>
  boost::shared_ptr<Msg> instantiate() const {  // NOLINT(readability-identifier-naming)
    boost::shared_ptr<Msg> msg;
    if (md5sum && *md5sum == ros::message_traits::MD5Sum<Msg>::value()) {
      msg = boost::make_shared<Msg>();
      auto* bytes = reinterpret_cast<uint8_t*>(const_cast<char*>(data.data()));
      ros::serialization::IStream stream(bytes, static_cast<uint32_t>(data.size()));
      ros::serialization::deserialize(stream, *msg);
    }
    if (!md5sum && type == ros::message_traits::DataType<Msg>::value())
      Decode([&](std::string_view cdr) { msg = boost::make_shared<Msg>(FromCdr<Msg>(cdr)); });
    if (!msg)
      throw InputError("topic '" + topic + "' has another definition of " + type +
                       " than this computer");
    return msg;
  }

  /// Runs `decode` on the CDR of a message of ROS 2, with errors that name it; nothing for ROS 1.
  void Decode(const std::function<void(std::string_view)>& decode) const;
};

/// The messages of some bags that are one recording.
class MessageSource {
 public:
  virtual ~MessageSource() = default;
  /// What each topic holds; more than one type fits no role.
  virtual std::map<std::string, std::set<std::string>> Types() const = 0;
  /// Record time of the first and the last message; none: there are no messages.
  virtual std::optional<std::pair<ros::Time, ros::Time>> Span() const = 0;
  /// Number of messages of each topic; none may be missing.
  virtual std::map<std::string, uint32_t> Counts(const ros::Time& start,
                                                 const ros::Time& end) const = 0;
  /// Calls `use(message)` for the messages of these topics in the order of recording while it is
  /// true.
  virtual void ForEach(const std::vector<std::string>& topics, const ros::Time& start,
                       const ros::Time& end,
                       const std::function<bool(const BagMessage&)>& use) const = 0;
  /// What is to be said of the bags, as that one is cut off.
  virtual std::vector<std::string> Notes() const { return {}; }
};

/// Both throw InputError with the reason and the remedy when a bag cannot be opened.
std::unique_ptr<MessageSource> OpenRos1(const std::vector<std::string>& paths);
std::unique_ptr<MessageSource> OpenRos2(const std::vector<std::string>& paths);

/// Bags of ROS 1 that are cut off, as far as they are whole, without their index; null when they
/// hold no messages or are damaged otherwise.
std::unique_ptr<MessageSource> ScanRos1(const std::vector<std::string>& paths);

/// Whether there is a bag of ROS 2 at `path`: an .mcap or .db3 file, whole or compressed by zstd,
/// or a folder that holds one or a metadata.yaml.
bool IsRos2Bag(const std::string& path);

/// The files that are read for a bag, the metadata.yaml of a folder among them. Throws InputError
/// when that names what is not there.
std::vector<std::string> FilesOfBag(const std::string& path);

/// The bag's path without the ending that files of its kind have.
std::string WithoutBagEnding(const std::string& path);

}  // namespace imu_pose_calib
