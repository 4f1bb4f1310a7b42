// Bags with random damage are read or refused with one line; nothing crashes or hangs.

#include <filesystem>

#include "damage.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "recompress.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

class BagDamageTest : public TempDirTest {
 protected:
  void SetUp() override {
    TempDirTest::SetUp();
    SimulatorOptions options;
    options.duration_s = 1.0;
    WriteBag(Path("poses.bag"), Simulate(options), {});
    WriteBag(Path("tf.bag"), Simulate(options), {false, "tf"});
  }

  /// Reads `count` damaged copies; returns how many of them were refused.
  int ReadDamaged(const std::string& name, rosbag::CompressionType compression, int count) const {
    Recompress(Path(name), Path("whole.bag"), compression);
    const std::string whole = ReadText(Path("whole.bag"));
    std::mt19937 random(7);
    RecordingRequest request;
    request.paths = {Path("damaged.bag")};
    if (name == "tf.bag") {
      request.tf_parent = "world";
      request.tf_child = "marker";
    }
    int refused = 0;
    for (int k = 0; k < count; ++k) {
      Write("damaged.bag", Damage(whole, &random));
      try {
        ReadBag(request);
      } catch (const InputError& error) {
        const std::string text = error.what();
        EXPECT_FALSE(text.empty());
        EXPECT_LT(text.size(), 100000u);
        ++refused;
      }
    }
    return refused;
  }
};

TEST_F(BagDamageTest, UncompressedBags) {
  EXPECT_GT(ReadDamaged("poses.bag", rosbag::compression::Uncompressed, Copies()), Copies() / 3);
}

TEST_F(BagDamageTest, UncompressedBagsOfTf) {
  EXPECT_GT(ReadDamaged("tf.bag", rosbag::compression::Uncompressed, Copies()), Copies() / 3);
}

TEST_F(BagDamageTest, Bz2Bags) {
  EXPECT_GT(ReadDamaged("poses.bag", rosbag::compression::BZ2, Copies()), Copies() / 3);
}

TEST_F(BagDamageTest, Lz4Bags) {
  EXPECT_GT(ReadDamaged("poses.bag", rosbag::compression::LZ4, Copies()), Copies() / 3);
}

TEST_F(BagDamageTest, Lz4BagsOfTf) {
  EXPECT_GT(ReadDamaged("tf.bag", rosbag::compression::LZ4, Copies()), Copies() / 3);
}

TEST_F(BagDamageTest, BecomesShorterWhileItIsRead) {
  const Bags bags({Path("poses.bag")}, 0.0, 0.0);
  std::filesystem::resize_file(Path("poses.bag"), 10'000);
  ExpectError<InputError>([&] { bags.ForEach({"/imu"}, [](const BagMessage&) { return true; }); },
                          {"poses.bag", "is damaged", "it has become shorter"});
}

}  // namespace
}  // namespace imu_pose_calib
