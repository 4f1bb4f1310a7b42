// Any cloud is points or an InputError.

#include <cstring>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/point_cloud.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace imu_pose_calib;
  const auto take = [&](auto value) {
    if (size < sizeof(value)) return decltype(value){};
    std::memcpy(&value, data, sizeof(value));
    data += sizeof(value);
    size -= sizeof(value);
    return value;
  };
  sensor_msgs::PointCloud2 cloud;
  cloud.header.stamp.sec = take(uint32_t{});
  cloud.height = take(uint32_t{});
  cloud.width = take(uint32_t{});
  cloud.point_step = take(uint32_t{});
  cloud.row_step = take(uint32_t{});
  cloud.is_bigendian = take(uint8_t{});
  for (const char* name : {"x", "y", "z", "intensity", "t"}) {
    sensor_msgs::PointField field;
    field.name = name;
    field.offset = take(uint32_t{});
    field.datatype = take(uint8_t{});
    cloud.fields.push_back(field);
  }
  cloud.data.assign(data, data + size);
  for (const char* choice : {"auto", "none", "ns"}) {
    try {
      ReadCloud(cloud, FindPointTime({cloud}, choice));
    } catch (const InputError&) {
    }
  }
  return 0;
}
