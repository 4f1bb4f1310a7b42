#include <yaml-cpp/yaml.h>

#include "imu_pose_calib/ros/io/ros_options.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

const char kDefaults[] = IMU_POSE_CALIB_SOURCE_DIR "/config/default.yaml";

class OptionsFile : public TempDirTest {
 protected:
  CalibrationOptions Load(const std::string& yaml) const {
    return LoadOptions(Write("options.yaml", yaml));
  }
  void ExpectRefusal(const std::string& yaml, const std::vector<std::string>& parts) const {
    ExpectError<InputError>([&] { Load(yaml); }, parts);
  }
};

std::vector<std::string> FieldNames() {
  std::vector<std::string> names;
  VisitFields(CalibrationOptions(), [&](const char* name, const auto& /*field*/, const Bound&) {
    names.push_back(name);
  });
  return names;
}

TEST(DefaultYaml, HoldsEveryFieldInOrderWithItsDefault) {
  std::vector<std::string> keys;
  for (const auto& entry : YAML::LoadFile(kDefaults)) keys.push_back(entry.first.as<std::string>());
  EXPECT_EQ(keys, FieldNames());
  EXPECT_EQ(ToYaml(LoadOptions(kDefaults)), ToYaml(CalibrationOptions()));
}

/// VisitFields() lists the fields by hand; the sizes tell when one was forgotten there.
TEST(DefaultYaml, VisitsEveryFieldOfTheStruct) {
  size_t visited = 0;
  const CalibrationOptions options;
  const char* end = reinterpret_cast<const char*>(&options);
  VisitFields(options, [&](const char* name, const auto& field, const Bound&) {
    const char* begin = reinterpret_cast<const char*>(&field);
    EXPECT_GE(begin, end) << name << " is out of order";
    // Only padding may lie between two fields.
    EXPECT_LT(begin - end, static_cast<std::ptrdiff_t>(alignof(decltype(field))))
        << "a field before " << name << " is not visited";
    end = begin + sizeof(field);
    ++visited;
  });
  const char* struct_end = reinterpret_cast<const char*>(&options + 1);
  EXPECT_LT(struct_end - end, static_cast<std::ptrdiff_t>(alignof(CalibrationOptions)));
  EXPECT_GT(visited, 0u);
}

TEST_F(OptionsFile, SetsWhatItNamesOnly) {
  const CalibrationOptions options = Load(
      "method: gp\n"
      "solver: ceres\n"
      "gyro_noise_density: 1e-3\n"
      "estimate_accel_delay: false\n"
      "recover_stamps: always\n"
      "max_iterations: 7\n"
      "initial_time_shift: -12.5\n"
      "initial_rotation: [0, 0, 0.6, 0.8]\n"
      "initial_translation: [1, 2.5, -3]\n");
  EXPECT_EQ(options.gyro_noise_density, 1e-3);
  EXPECT_EQ(options.solver, SolverKind::kCeres);
  EXPECT_FALSE(options.estimate_accel_delay);
  EXPECT_EQ(options.recover_stamps, StampRecovery::kAlways);
  EXPECT_EQ(options.max_iterations, 7);
  EXPECT_EQ(options.initial_time_shift, -12.5);
  EXPECT_EQ(options.initial_rotation->coeffs(), Eigen::Vector4d(0, 0, 0.6, 0.8));
  EXPECT_EQ(*options.initial_translation, Eigen::Vector3d(1, 2.5, -3));
  EXPECT_EQ(options.accel_noise_density, CalibrationOptions().accel_noise_density);
}

TEST_F(OptionsFile, ReadsBackWhatWasWritten) {
  CalibrationOptions options;
  options.gravity_magnitude = 9.8 + 1e-15;
  options.initial_time_shift = -1034771.50664123456;
  options.initial_rotation = Eigen::Quaterniond(0.5, -0.5, 0.5, 0.5);
  options.initial_translation = Eigen::Vector3d(1.0, 1e-7, -1.0 / 3.0);
  const CalibrationOptions read = Load(ToYaml(options));
  EXPECT_EQ(read.initial_time_shift, options.initial_time_shift);
  EXPECT_EQ(*read.initial_translation, *options.initial_translation);
  EXPECT_EQ(ToYaml(read), ToYaml(options));
}

TEST_F(OptionsFile, MayBeEmptyOrLeaveOptionalFieldsOpen) {
  EXPECT_EQ(ToYaml(Load("")), ToYaml(CalibrationOptions()));
  EXPECT_FALSE(Load("initial_rotation: ~\n").initial_rotation.has_value());
  EXPECT_FALSE(Load("initial_time_shift:\n").initial_time_shift.has_value());
}

TEST_F(OptionsFile, RefusesUnknownKeysNamingTheNearest) {
  ExpectRefusal("gyro_noise: 1e-3\n", {"options.yaml", "gyro_noise'", "gyro_noise_density"});
  ExpectRefusal("max_iteration: 5\n", {"max_iteration'", "max_iterations"});
}

TEST_F(OptionsFile, RefusesWrongTypes) {
  ExpectRefusal("max_gap_s: wide\n", {"options.yaml", "max_gap_s", "a number", "wide"});
  ExpectRefusal("max_gap_s:\n", {"max_gap_s", "a number", "nothing"});
  ExpectRefusal("max_gap_s: [1]\n", {"max_gap_s", "a number"});
  ExpectRefusal("max_iterations: 1.5\n", {"max_iterations", "an integer", "1.5"});
  ExpectRefusal("estimate_accel_delay: 2\n", {"estimate_accel_delay", "true or false", "2"});
  ExpectRefusal("initial_rotation: [0, 0, 1]\n", {"initial_rotation", "[x, y, z, w]"});
  ExpectRefusal("initial_translation: [0, 0, up]\n", {"initial_translation", "[x, y, z]", "up"});
  ExpectRefusal("method: joint2\n", {"joint2", "available: joint, gp"});
  ExpectRefusal("method: [gp]\n", {"method", "a string"});
  ExpectRefusal("solver: eigen\n", {"eigen", "available: windows, ceres"});
  ExpectRefusal("recover_stamps: yes\n", {"recover_stamps", "auto, always or never", "yes"});
}

TEST_F(OptionsFile, RefusesValuesOutOfRange) {
  ExpectRefusal("gravity_magnitude: -9.8\n", {"options.yaml", "gravity_magnitude", "-9.8", "0.1"});
  ExpectRefusal("gravity_magnitude: .nan\n", {"gravity_magnitude"});
  ExpectRefusal("initial_rotation: [0, 0, 0, 2]\n", {"initial_rotation", "2"});
}

TEST_F(OptionsFile, RefusesFilesThatAreNoMapOfOptions) {
  ExpectRefusal("- 1\n", {"options.yaml", "map"});
  ExpectRefusal("max_gap_s: 1\nmax_gap_s: 2\n", {"max_gap_s", "twice"});
  ExpectRefusal("max_gap_s: 1\n  method: [\n", {"options.yaml", "line 2"});
  ExpectError<InputError>([&] { LoadOptions(Path("missing.yaml")); }, {"missing.yaml", "read"});
  ExpectError<InputError>([&] { LoadOptions(dir_.string()); }, {dir_.string(), "is a directory"});
}

TEST_F(OptionsFile, RefusesFilesThatAParserCouldChokeOn) {
  ExpectRefusal("max_gap_s: 1\nmethod: " + std::string(5000, '['), {"line 2: nested deeper"});
  std::string nested = "- ";
  for (int k = 0; k < 100; ++k) nested += "- ";
  ExpectRefusal(nested + "1\n", {"line 1: nested deeper than 20 levels"});
  ExpectRefusal("#" + std::string(10'000'000, ' '), {"larger than 10 MB"});
  ExpectRefusal(std::string("\0\1\2 : \xFF", 7), {"options.yaml"});
}

}  // namespace
}  // namespace imu_pose_calib
