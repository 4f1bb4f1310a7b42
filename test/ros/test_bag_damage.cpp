// Bags with random damage are read or refused with one line; nothing crashes or hangs.

#include <random>

#include "imu_pose_calib/ros/io/bag_reader.h"
#include "imu_pose_calib/ros/io/bag_writer.h"
#include "recompress.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

/// Damages a few bits, bytes, or a run of bytes; or cuts the text off or a part out.
std::string Damage(std::string text, std::mt19937* random) {
  const auto below = [&](size_t size) {
    return std::uniform_int_distribution<size_t>(0, size - 1)(*random);
  };
  // A third of the damage goes to the headers at the start, a third to the index at the end.
  const size_t part = std::min<size_t>(text.size(), 6000);
  const auto position = [&] {
    switch (below(3)) {
      case 0:
        return below(part);
      case 1:
        return text.size() - 1 - below(part);
      default:
        return below(text.size());
    }
  };
  const auto flip = [&](size_t at) {
    text[at] = static_cast<char>(static_cast<unsigned char>(text[at]) ^ (1u << below(8)));
  };
  switch (below(5)) {
    case 0:
      flip(position());
      break;
    case 1:
      for (int k = 0; k < 20; ++k) flip(position());
      break;
    case 2:
      text.resize(position());
      break;
    case 3:
      text.erase(position(), 1 + below(100));
      break;
    default: {
      const size_t begin = position();
      for (size_t k = begin; k < std::min(text.size(), begin + 64); ++k)
        text[k] = static_cast<char>(below(256));
    }
  }
  return text;
}

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
    BagRequest request;
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

/// Copies of each kind; the environment may ask for more.
int Copies() {
  const char* text = std::getenv("IMU_POSE_CALIB_DAMAGED_BAGS");
  return text ? std::atoi(text) : 40;
}

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

}  // namespace
}  // namespace imu_pose_calib
