#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

const std::string kNoise =
    "accelerometer_noise_density: 0.02\n"
    "accelerometer_random_walk: 0.003\n"
    "gyroscope_noise_density: 0.0004\n"
    "gyroscope_random_walk: 5.0e-05\n";

class ImuYamlTest : public TempDirTest {
 protected:
  void ExpectRefusal(const std::string& text, const std::vector<std::string>& parts) const {
    const std::string path = Write("imu.yaml", text);
    ExpectError<InputError>([&] { LoadImuYaml(path); }, {"imu_yaml '" + path + "'"});
    ExpectError<InputError>([&] { LoadImuYaml(path); }, parts);
  }
};

TEST_F(ImuYamlTest, ReadsNoiseAndTopic) {
  CalibrationOptions options;
  const std::string path =
      Write("imu.yaml", "# data sheet\n" + kNoise + "rostopic: /imu0\nupdate_rate: 200.0\n");
  EXPECT_EQ(LoadImuYaml(path, &options), "/imu0");
  EXPECT_EQ(options.accel_noise_density, 0.02);
  EXPECT_EQ(options.accel_bias_walk, 0.003);
  EXPECT_EQ(options.gyro_noise_density, 0.0004);
  EXPECT_EQ(options.gyro_bias_walk, 5e-5);
}

TEST_F(ImuYamlTest, TopicAndRateMayBeMissing) {
  EXPECT_EQ(LoadImuYaml(Write("imu.yaml", kNoise)), "");
}

TEST_F(ImuYamlTest, ReadsTheResultOfKalibr) {
  CalibrationOptions options;
  const std::string path = Write("imu.yaml",
                                 "imu0:\n"
                                 "  T_i_b:\n"
                                 "  - [1.0, 0.0, 0.0, 0.0]\n"
                                 "  - [0.0, 1.0, 0.0, 0.0]\n"
                                 "  - [0.0, 0.0, 1.0, 0.0]\n"
                                 "  - [0.0, 0.0, 0.0, 1.0]\n"
                                 "  accelerometer_noise_density: 0.02\n"
                                 "  accelerometer_random_walk: 0.003\n"
                                 "  gyroscope_noise_density: 0.0004\n"
                                 "  gyroscope_random_walk: 5.0e-05\n"
                                 "  model: calibrated\n"
                                 "  rostopic: /imu0\n"
                                 "  time_offset: 0.0\n"
                                 "  update_rate: 200.0\n");
  EXPECT_EQ(LoadImuYaml(path, &options), "/imu0");
  EXPECT_EQ(options.gyro_noise_density, 0.0004);
}

TEST_F(ImuYamlTest, NoiseBecomesOptions) {
  CalibrationOptions options;
  LoadImuYaml(Write("imu.yaml", kNoise), &options);
  EXPECT_EQ(options.gyro_noise_density, 0.0004);
  EXPECT_EQ(options.gyro_bias_walk, 5e-5);
  EXPECT_EQ(options.accel_noise_density, 0.02);
  EXPECT_EQ(options.accel_bias_walk, 0.003);
  options.Validate();
}

TEST_F(ImuYamlTest, RefusesKeysThatAreMissingOrUnknown) {
  ExpectRefusal("gyroscope_noise_density: 1.0e-3\n", {"gyroscope_random_walk is missing"});
  ExpectRefusal(kNoise + "update_rat: 200\n", {"'update_rat'", "did you mean 'update_rate'?"});
  ExpectRefusal("", {"must be a map"});
  ExpectRefusal("- 1\n- 2\n", {"must be a map"});
  ExpectRefusal("imu0: 3\n", {"imu0 must be a map"});
  ExpectRefusal("imu0:\n  rostopic: /a\nimu1:\n  rostopic: /b\n", {"more than imu0"});
  ExpectRefusal("cam0:\n  rostopic: /a\n", {"no key 'cam0'"});
}

TEST_F(ImuYamlTest, RefusesWrongTypesAndValues) {
  const auto with_walk = [](const std::string& value) {
    return "gyroscope_noise_density: 1.0e-3\ngyroscope_random_walk: " + value + "\n";
  };
  ExpectRefusal(with_walk("low"), {"gyroscope_random_walk must be a number, not low"});
  ExpectRefusal(with_walk("[1, 2]"), {"gyroscope_random_walk must be a number, not [1, 2]"});
  ExpectRefusal(with_walk(""), {"gyroscope_random_walk must be a number, not nothing"});
  ExpectRefusal(with_walk("-1.0e-5"),
                {"gyroscope_random_walk = -1.0e-05 is out of range: must be within [1.0e-12"});
  ExpectRefusal(with_walk(".nan"), {"gyroscope_random_walk = .nan is out of range"});
  ExpectRefusal(kNoise + "update_rate: 0\n",
                {"update_rate = 0.0 is out of range: must be within [0.001"});
  ExpectRefusal(kNoise + "rostopic: [/a]\n", {"rostopic must be a string"});
  ExpectRefusal("a: {b\n", {"line "});
}

TEST_F(ImuYamlTest, RefusesWhatIsNoFile) {
  ExpectError<InputError>([&] { LoadImuYaml(Path("no.yaml")); }, {"no.yaml", "cannot be read"});
  ExpectError<InputError>([&] { LoadImuYaml(dir_.string()); }, {"is a directory"});
}

}  // namespace
}  // namespace imu_pose_calib
