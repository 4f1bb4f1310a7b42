#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <vector>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/conversions.h"

namespace imu_pose_calib {
namespace {

void CheckVersion(const std::string& path) {
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw InputError("bag '" + path + "' cannot be read: " + std::strerror(errno));

  const std::string magic = "#ROSBAG V";
  std::string header(magic.size() + 3, '\0');
  file.read(header.data(), static_cast<std::streamsize>(header.size()));
  if (header.compare(0, magic.size(), magic) != 0)
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
  const std::string version = header.substr(magic.size());
  if (version != "1.2" && version != "2.0")
    throw InputError("bag '" + path + "' is of version " + version + ", must be 1.2 or 2.0");
}

class Ros1File : public BagFile {
 public:
  explicit Ros1File(std::unique_ptr<rosbag::Bag> bag) : bag_(std::move(bag)) {
    for (const rosbag::ConnectionInfo* connection : rosbag::View(*bag_).getConnections()) {
      const auto topic = static_cast<uint32_t>(topics_.size());
      topics_.push_back({connection->topic, connection->datatype, connection->md5sum});
      const auto is_its = [&](const rosbag::ConnectionInfo* other) { return other == connection; };
      rosbag::View view(*bag_, is_its);
      for (const rosbag::MessageInstance& message : view) {
        entries_.push_back({ToNanoseconds(message.getTime()), topic, 0, messages_.size(), 0});
        messages_.push_back(message);
      }
    }
  }

  std::string_view Read(const Entry& entry) override {
    const rosbag::MessageInstance& message = messages_[entry.at];
    data_.resize(message.size());
    ros::serialization::OStream stream(data_.data(), static_cast<uint32_t>(data_.size()));
    message.write(stream);
    return {reinterpret_cast<const char*>(data_.data()), data_.size()};
  }

 private:
  std::unique_ptr<rosbag::Bag> bag_;
  std::vector<rosbag::MessageInstance> messages_;
  std::vector<uint8_t> data_;
};

}  // namespace

std::unique_ptr<BagFile> OpenRos1(const std::string& path) {
  CheckVersion(path);
  auto bag = std::make_unique<rosbag::Bag>();
  try {
    bag->open(path);
  } catch (const rosbag::BagUnindexedException&) {
    return ScanRos1(path, "bag '" + path + "' has no index, its recording was cut off; " +
                              "run: rosbag reindex " + path);
  } catch (const rosbag::BagException& error) {
    return ScanRos1(path, "bag '" + path + "' is damaged or cut off (" + error.what() +
                              "); run: rosbag reindex " + path);
  }
  return std::make_unique<Ros1File>(std::move(bag));
}

}  // namespace imu_pose_calib
