// Bags of ROS 2 with random damage are read or refused; nothing crashes or hangs. In this process,
// where sanitizers see it.

#include <sensor_msgs/Imu.h>

#include "damage.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "test_util.h"
#include "to_ros2.h"

namespace imu_pose_calib {
namespace {

/// Reads all messages of a bag.
void ReadAll(const std::string& path) {
  const Bags bags({path}, 0.0, 0.0);
  for (const BagTopic& topic : bags.topics()) {
    bags.ForEach({topic.name}, [&](const BagMessage& message) {
      if (topic.IsImu()) ReadImuContent(topic.type, message);
      if (IsPoseType(topic.type)) ReadPose(topic.type, message);
      if (topic.IsTf()) message.instantiate<tf2_msgs::TFMessage>();
      return true;
    });
  }
}

class Ros2DamageTest : public TempDirTest, public ::testing::WithParamInterface<size_t> {};

INSTANTIATE_TEST_SUITE_P(Ways, Ros2DamageTest, ::testing::Range<size_t>(0, Ros2Ways().size()));

TEST_P(Ros2DamageTest, IsReadOrRefused) {
  const Ros2Way way = Ros2Ways()[GetParam()];
  SimulatorOptions options;
  options.duration_s = 1.0;
  int refused = 0, read = 0;
  for (const char* pose_type : {"PoseStamped", "tf"}) {
    WriteBag(Path("x.bag"), Simulate(options), {false, pose_type});
    ToRos2(Path("x.bag"), Path("whole"), way);
    const std::string whole = ReadText(Path("whole"));
    ReadAll(Path("whole"));
    std::mt19937 random(7);
    for (int k = 0; k < 4 * Copies(); ++k) {
      std::ofstream(Path("damaged"), std::ios::binary) << Damage(whole, &random);
      try {
        ReadAll(Path("damaged"));
        ++read;
      } catch (const InputError& error) {
        EXPECT_LT(std::string(error.what()).size(), 100000u);
        ++refused;
      }
    }
  }
  EXPECT_GT(refused, Copies());
  EXPECT_GT(read, Copies());  // that are cut off, or damaged where nothing is read
}

}  // namespace
}  // namespace imu_pose_calib
