#include "imu_pose_calib/ros/io/bag_file.h"

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/compression.h"

namespace imu_pose_calib {

std::unique_ptr<BagFile> OpenRos2(const std::string& path) {
  auto input = std::make_unique<InputFile>(path);
  if (IsMcap(input->bytes())) {
    input->RemoveTemporary();
    return OpenMcap(std::move(input), path);
  }
  if (IsSqlite(input->bytes())) return OpenSqlite(input->path(), path);
  throw InputError("'" + path + "' is neither an mcap file nor a database of SQLite" +
                   (input->bytes().empty() ? ": it is empty" : ""));
}

std::string Ros1Type(std::string type, const std::string& encoding) {
  const size_t at = type.find("/msg/");
  if (at != std::string::npos) type.erase(at, 4);
  return encoding == "cdr" ? type : type + " in " + encoding;
}

}  // namespace imu_pose_calib
