#pragma once

#include <gtest/gtest.h>
#include <sensor_msgs/PointCloud2.h>

#include <Eigen/Core>
#include <cstring>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// A field of a cloud to write: the values of its points.
struct TestField {
  std::string name;
  uint8_t type;
  std::vector<double> values;
};

/// A cloud stamped `stamp_s` of one row, fields one behind the other.
inline sensor_msgs::PointCloud2 MakeCloud(double stamp_s, const std::vector<TestField>& fields) {
  using sensor_msgs::PointField;
  const auto append = [](const auto value, std::vector<uint8_t>* data) {
    const auto* bytes = reinterpret_cast<const uint8_t*>(&value);
    data->insert(data->end(), bytes, bytes + sizeof(value));
  };
  sensor_msgs::PointCloud2 cloud;
  cloud.header.stamp.fromSec(stamp_s);
  cloud.height = 1;
  cloud.width = static_cast<uint32_t>(fields[0].values.size());
  for (size_t k = 0; k < cloud.width; ++k)
    for (const TestField& field : fields) {
      if (k == 0) {
        cloud.fields.emplace_back();
        cloud.fields.back().name = field.name;
        cloud.fields.back().datatype = field.type;
        cloud.fields.back().count = 1;
        cloud.fields.back().offset = static_cast<uint32_t>(cloud.data.size());
      }
      const double value = field.values[k];
      if (field.type == PointField::FLOAT32) append(static_cast<float>(value), &cloud.data);
      if (field.type == PointField::FLOAT64) append(value, &cloud.data);
      if (field.type == PointField::UINT32) append(static_cast<uint32_t>(value), &cloud.data);
      if (field.type == PointField::UINT16) append(static_cast<uint16_t>(value), &cloud.data);
      if (field.type == PointField::UINT8) append(static_cast<uint8_t>(value), &cloud.data);
      if (k == 0) cloud.point_step = static_cast<uint32_t>(cloud.data.size());
    }
  cloud.row_step = cloud.point_step * cloud.width;
  return cloud;
}

/// A file as the description of the format has it (pointclouds.org, "The PCD file format"): each
/// line of the header a key and its values, then, for "DATA binary", one point behind the other.
struct PcdFile {
  std::map<std::string, std::vector<std::string>> header;
  std::vector<std::vector<float>> points;  ///< values in the order of FIELDS

  explicit PcdFile(const std::string& bytes) {
    size_t at = 0;
    while (header.count("DATA") == 0) {
      const size_t end = bytes.find('\n', at);
      if (end == std::string::npos) {
        ADD_FAILURE() << "the header has no end";
        return;
      }
      std::istringstream words(bytes.substr(at, end - at));
      at = end + 1;
      std::string key;
      words >> key;
      if (key[0] == '#') continue;
      for (std::string word; words >> word;) header[key].push_back(word);
    }
    EXPECT_EQ(header["VERSION"], std::vector<std::string>{"0.7"});
    EXPECT_EQ(header["DATA"], std::vector<std::string>{"binary"});
    EXPECT_EQ(header["VIEWPOINT"].size(), 7u);
    const size_t fields = header["FIELDS"].size(), count = std::stoul(header["POINTS"][0]);
    EXPECT_EQ(header["SIZE"], std::vector<std::string>(fields, "4"));
    EXPECT_EQ(header["TYPE"], std::vector<std::string>(fields, "F"));
    EXPECT_EQ(header["COUNT"], std::vector<std::string>(fields, "1"));
    EXPECT_EQ(std::stoul(header["WIDTH"][0]) * std::stoul(header["HEIGHT"][0]), count);
    EXPECT_EQ(bytes.size() - at, 4 * fields * count);
    points.assign(count, std::vector<float>(fields));
    for (std::vector<float>& point : points) {
      std::memcpy(point.data(), bytes.data() + at, 4 * fields);
      at += 4 * fields;
    }
  }
};

}  // namespace imu_pose_calib
