#pragma once

#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <string>

namespace imu_pose_calib {

/// Writes the messages of a bag anew with a compression and small chunks.
inline void Recompress(const std::string& from, const std::string& to,
                       rosbag::CompressionType compression) {
  rosbag::Bag in(from), out(to, rosbag::bagmode::Write);
  out.setCompression(compression);
  out.setChunkThreshold(16 * 1024);
  for (const rosbag::MessageInstance& message : rosbag::View(in))
    out.write(message.getTopic(), message.getTime(), message);
}

}  // namespace imu_pose_calib
