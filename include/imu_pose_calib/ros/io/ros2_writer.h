#pragma once

#include <ros/message_traits.h>

#include <cstdint>
#include <map>
#include <memory>
#include <string>

#include "imu_pose_calib/ros/io/cdr.h"

namespace imu_pose_calib {

/// How a bag of ROS 2 is stored.
struct Ros2Format {
  bool is_mcap = true;  ///< false: a database of SQLite, .db3
  /// Of the chunks of an mcap file: "", "lz4" or "zstd"; "none": there are no chunks.
  std::string chunk_compression;
  bool compress_messages = false;  ///< each message by zstd
  size_t chunk_size = 786'432;     ///< [bytes] that end a chunk
};

/// Where encoded messages go.
class Ros2Storage {
 public:
  virtual ~Ros2Storage() = default;
  /// Announces a topic, which gets the next number from 0 on.
  virtual void AddTopic(const std::string& name,
                        const std::string& type,
                        const std::string& definition) = 0;
  virtual void Write(uint32_t topic, int64_t t_ns, const std::string& data) = 0;
  virtual void Close() = 0;
};

/// Both throw InputError with `path` when it cannot be written; so do their members.
std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path, const Ros2Format& format);
std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path);

/// Writes one file of a bag of ROS 2.
class Ros2Writer {
 public:
  /// Throws InputError when the file cannot be written; so do the others.
  Ros2Writer(const std::string& path, const Ros2Format& format);

  template <typename Msg>
  void Write(const std::string& topic, int64_t t_ns, const Msg& msg) {
    Add(topic,
        ros::message_traits::DataType<Msg>::value(),
        ros::message_traits::Definition<Msg>::value(),
        t_ns,
        ToCdr(msg));
  }

  /// Completes the file.
  void Close() { storage_->Close(); }

 private:
  void Add(const std::string& topic,
           const std::string& ros1_type,
           const std::string& ros1_definition,
           int64_t t_ns,
           const std::string& data);

  Ros2Format format_;
  std::unique_ptr<Ros2Storage> storage_;
  std::map<std::string, uint32_t> topics_;
};

/// A definition of a message as ROS 2 has it, without comments.
std::string Ros2Definition(const std::string& ros1_definition);

}  // namespace imu_pose_calib
