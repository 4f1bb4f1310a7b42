#pragma once

#include <lz4frame.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_msgs/TFMessage.h>
#include <zstd.h>

#include <boost/algorithm/string.hpp>
#include <boost/crc.hpp>
#include <fstream>
#include <map>
#include <string>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/cdr.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "test_util.h"

namespace imu_pose_calib {

/// A way to store a bag of ROS 2.
struct Ros2Way {
  std::string ending;  ///< of the file
  /// Of the chunks of an mcap file: "", "lz4" or "zstd"; "none": there are no chunks.
  std::string chunk_compression;
  bool compress_messages = false;  ///< each by zstd

  bool IsMcap() const { return boost::ends_with(ending, "mcap"); }
};

inline std::vector<Ros2Way> Ros2Ways() {
  return {{"mcap", ""},
          {"none.mcap", "none"},
          {"lz4.mcap", "lz4"},
          {"zstd.mcap", "zstd"},
          {"message.mcap", "", true},
          {"db3", ""},
          {"message.db3", "", true}};
}

/// One frame.
inline std::string CompressZstd(const std::string& bytes) {
  std::string frame(ZSTD_compressBound(bytes.size()), '\0');
  frame.resize(ZSTD_compress(frame.data(), frame.size(), bytes.data(), bytes.size(), 1));
  return frame;
}
inline std::string CompressLz4(const std::string& bytes) {
  std::string frame(LZ4F_compressFrameBound(bytes.size(), nullptr), '\0');
  frame.resize(LZ4F_compressFrame(frame.data(), frame.size(), bytes.data(), bytes.size(), nullptr));
  return frame;
}

/// An mcap file with its records in chunks of 16 KiB, or in none. The indexes at its end, which are
/// not read, stay as they are.
inline std::string Rechunk(const std::string& mcap, const std::string& compression) {
  const auto number = [](uint64_t value, size_t size) {
    return std::string(reinterpret_cast<const char*>(&value), size);
  };
  const auto length = [&](size_t at) {
    uint64_t value = 0;
    std::memcpy(&value, mcap.data() + at, sizeof(value));
    return value;
  };
  std::string out = mcap.substr(0, 8), records;
  const auto put_chunk = [&] {
    boost::crc_32_type crc;
    crc.process_bytes(records.data(), records.size());
    const std::string stored = compression == "lz4"    ? CompressLz4(records)
                               : compression == "zstd" ? CompressZstd(records)
                                                       : records;
    const std::string chunk = std::string(16, '\0') + number(records.size(), 8) +
                              number(crc.checksum(), 4) + number(compression.size(), 4) +
                              compression + number(stored.size(), 8) + stored;
    if (!records.empty())
      out += compression == "none" ? records : '\6' + number(chunk.size(), 8) + chunk;
    records.clear();
  };
  size_t at = 8;
  while (mcap[at] != '\x0f') {  // the end of the data
    const char kind = mcap[at];
    if (kind == '\6') {
      at += 9 + 40;  // its own fields, when it is not compressed
      continue;
    }
    const size_t size = 9 + length(at + 1);
    const std::string record = mcap.substr(at, size);
    if (kind == '\3' || kind == '\4' || kind == '\5') records += record;
    if (kind == '\1') out += record;
    if (records.size() >= 16 * 1024) put_chunk();
    at += size;
  }
  put_chunk();
  return out + mcap.substr(at);
}

/// Writes the messages of a bag of ROS 1 as one of ROS 2, from the message `first` on and every
/// `step`.
inline void ToRos2(const std::string& from, const std::string& to, const Ros2Way& way,
                   int first = 0, int step = 1) {
  const rosbag::Bag in(from);
  const auto out = way.IsMcap() ? CreateMcap(to) : CreateSqlite(to);
  std::map<std::string, uint32_t> topics;
  const auto write_as = [&](const rosbag::MessageInstance& message, auto type) {
    const auto msg = message.instantiate<decltype(type)>();
    if (!msg) return false;
    const auto [topic, is_new] =
        topics.emplace(message.getTopic(), static_cast<uint32_t>(topics.size()));
    if (is_new)
      out->AddTopic(topic->first, boost::replace_first_copy(message.getDataType(), "/", "/msg/"),
                    "");
    const std::string data = ToCdr(*msg);
    out->Write(topic->second, ToNanoseconds(message.getTime()),
               way.compress_messages ? CompressZstd(data) : data);
    return true;
  };
  int k = 0;
  for (const rosbag::MessageInstance& message : rosbag::View(in)) {
    if (k++ % step != first) continue;
    const bool is_known =
        write_as(message, sensor_msgs::Imu()) || write_as(message, tf2_msgs::TFMessage()) ||
        write_as(message, geometry_msgs::PoseStamped()) ||
        write_as(message, geometry_msgs::TransformStamped()) ||
        write_as(message, geometry_msgs::PoseWithCovarianceStamped()) ||
        write_as(message, geometry_msgs::Vector3Stamped()) ||
        write_as(message, nav_msgs::Odometry()) || write_as(message, sensor_msgs::PointCloud2());
    if (!is_known) throw InputError("no such message is known: " + message.getDataType());
  }
  out->Close();
  if (!way.IsMcap()) return;
  const std::string mcap = ReadText(to);
  std::ofstream(to, std::ios::binary) << Rechunk(mcap, way.chunk_compression);
}

}  // namespace imu_pose_calib
