#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/types.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kNoBound = kInfinity;

/// A number as the messages print it.
std::string Print(double value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

std::string Refusal(const CalibrationOptions& options) {
  return ErrorText<InputError>([&] { options.Validate(); });
}

struct Field {
  const char* name;
  double CalibrationOptions::*value;
  double low, high;          ///< bounds
  bool may_be_zero = false;  ///< below the lower bound
};

const Field kFields[] = {
    {"max_gap_s", &CalibrationOptions::max_gap_s, 0.0, 1e3},
    {"min_segment_s", &CalibrationOptions::min_segment_s, 0.0, 1e3},
    {"min_overlap_s", &CalibrationOptions::min_overlap_s, 1.0, 1e6},
    {"max_bad_fraction", &CalibrationOptions::max_bad_fraction, 0.0, 1.0},
    {"gyro_noise_density", &CalibrationOptions::gyro_noise_density, 1e-9, 1e3},
    {"accel_noise_density", &CalibrationOptions::accel_noise_density, 1e-9, 1e3},
    {"gyro_bias_walk", &CalibrationOptions::gyro_bias_walk, 1e-12, 1e3},
    {"accel_bias_walk", &CalibrationOptions::accel_bias_walk, 1e-12, 1e3},
    {"bias_knot_interval_s", &CalibrationOptions::bias_knot_interval_s, 1e-2, 1e9, true},
    {"position_lengthscale_s", &CalibrationOptions::position_lengthscale_s, 1e-3, 1e3, true},
    {"position_signal_std", &CalibrationOptions::position_signal_std, 0.0, 1e9},
    {"position_noise_std", &CalibrationOptions::position_noise_std, 0.0, 1e3},
    {"rotation_lengthscale_s", &CalibrationOptions::rotation_lengthscale_s, 1e-3, 1e3, true},
    {"rotation_signal_std", &CalibrationOptions::rotation_signal_std, 0.0, 1e3},
    {"rotation_noise_std", &CalibrationOptions::rotation_noise_std, 0.0, 1e3},
    {"outlier_threshold", &CalibrationOptions::outlier_threshold, 3.0, kNoBound},
    {"knot_spacing_s", &CalibrationOptions::knot_spacing_s, 1e-3, 10.0, true},
    {"accel_delay", &CalibrationOptions::accel_delay, -0.5, 0.5},
    {"gravity_magnitude", &CalibrationOptions::gravity_magnitude, 0.1, 100.0},
    {"gravity_magnitude_std", &CalibrationOptions::gravity_magnitude_std, 1e-9, 10.0},
    {"robust_loss_scale", &CalibrationOptions::robust_loss_scale, 1.0, 1e6},
    {"covariance_block_s", &CalibrationOptions::covariance_block_s, 0.1, 1e6, true},
    {"weak_rotation_std", &CalibrationOptions::weak_rotation_std, 1e-9, 1.0},
    {"weak_translation_std", &CalibrationOptions::weak_translation_std, 1e-9, 10.0},
    {"weak_time_shift_std", &CalibrationOptions::weak_time_shift_std, 1e-9, 1.0},
};

TEST(Options, DefaultsAreValid) { EXPECT_NO_THROW(CalibrationOptions().Validate()); }

TEST(Options, EveryFieldOutOfRangeIsRefusedWithItsNameValueAndBound) {
  for (const Field& field : kFields) {
    SCOPED_TRACE(field.name);
    const std::string bounds = field.high == kNoBound
                                   ? "at least " + Print(field.low)
                                   : std::string(field.may_be_zero ? "0 or " : "") + "within [" +
                                         Print(field.low) + ", " + Print(field.high) + "]";
    std::vector<double> bad = {field.low - 0.123, -kInfinity, kNaN};
    if (field.may_be_zero) bad.push_back(1e-9);
    if (field.high != kNoBound) bad.insert(bad.end(), {1.25 * field.high, kInfinity});
    for (const double value : bad) {
      CalibrationOptions options;
      options.*field.value = value;
      const std::string text = Refusal(options);
      EXPECT_TRUE(Contains(text, std::string(field.name) + " = " + Print(value)));
      EXPECT_TRUE(Contains(text, bounds));
    }
  }
}

TEST(Options, TheBoundsThemselvesAreAllowed) {
  for (const Field& field : kFields) {
    SCOPED_TRACE(field.name);
    CalibrationOptions options;
    options.*field.value = field.low;
    EXPECT_NO_THROW(options.Validate());
    if (field.may_be_zero) {
      options.*field.value = 0.0;
      EXPECT_NO_THROW(options.Validate());
    }
    if (field.high == kNoBound) continue;
    options.*field.value = field.high;
    EXPECT_NO_THROW(options.Validate());
  }
}

TEST(Options, CountsOutOfRangeAreRefused) {
  CalibrationOptions options;
  options.max_iterations = 0;
  EXPECT_TRUE(Contains(Refusal(options), "max_iterations = 0"));
  EXPECT_TRUE(Contains(Refusal(options), "[1, 10000]"));
  options.max_iterations = 10001;
  EXPECT_TRUE(Contains(Refusal(options), "max_iterations = 10001"));
  options = CalibrationOptions();
  options.num_threads = -1;
  EXPECT_TRUE(Contains(Refusal(options), "num_threads = -1"));
  EXPECT_TRUE(Contains(Refusal(options), "[0, 1024]"));
}

TEST(Options, InitialValuesAreCheckedWhenGiven) {
  CalibrationOptions options;
  options.initial_time_shift = -1e9;
  options.initial_rotation = Eigen::Quaterniond(0.5, 0.5, -0.5, 0.5);
  options.initial_translation = Eigen::Vector3d(0.1, 0.2, 0.3);
  EXPECT_NO_THROW(options.Validate());

  for (const double bad : {2e10, -2e10, kNaN}) {
    CalibrationOptions o;
    o.initial_time_shift = bad;
    EXPECT_TRUE(Contains(Refusal(o), "initial_time_shift = " + Print(bad)));
    EXPECT_TRUE(Contains(Refusal(o), "1e+10"));
  }
  for (const double bad : {0.0, 0.9, 2.0, kNaN}) {
    CalibrationOptions o;
    o.initial_rotation = Eigen::Quaterniond(bad, 0.0, 0.0, 0.0);
    EXPECT_TRUE(Contains(Refusal(o), "initial_rotation = " + Print(bad)));
    EXPECT_TRUE(Contains(Refusal(o), "[0.99, 1.01]"));
  }
  for (const double bad : {2000.0, kNaN}) {
    CalibrationOptions o;
    o.initial_translation = Eigen::Vector3d(0.0, bad, 0.0);
    EXPECT_TRUE(Contains(Refusal(o), "initial_translation = " + Print(bad)));
    EXPECT_TRUE(Contains(Refusal(o), "1000"));
  }
}

TEST(Options, LatitudeTellsGravity) {
  CalibrationOptions options;
  EXPECT_EQ(options.GravityMagnitude(), options.gravity_magnitude);
  EXPECT_EQ(options.GravityStd(), options.gravity_magnitude_std);
  for (const double bad : {90.5, -91.0, kNaN}) {
    options.latitude = bad;
    EXPECT_TRUE(Contains(Refusal(options), "latitude = " + Print(bad)));
    EXPECT_TRUE(Contains(Refusal(options), "[-90, 90]"));
  }
  for (const auto& [latitude, g] :
       {std::pair{0.0, 9.7803253}, {45.0, 9.8061977}, {-90.0, 9.8321849}}) {
    options.latitude = latitude;  // normal gravity of WGS 84 at sea level
    EXPECT_NO_THROW(options.Validate());
    EXPECT_NEAR(options.GravityMagnitude(), g, 1e-7);
  }
  EXPECT_EQ(options.GravityStd(), 3e-3);
  options.initial_gravity = Eigen::Vector3d(0.0, 0.0, -9.7);
  EXPECT_EQ(options.GravityMagnitude(), 9.7);
}

TEST(Options, WhatIsNotEstimatedMustBeGiven) {
  using Flag = bool CalibrationOptions::*;
  const std::pair<Flag, const char*> flags[] = {
      {&CalibrationOptions::estimate_time_shift, "initial_time_shift"},
      {&CalibrationOptions::estimate_rotation, "initial_rotation"},
      {&CalibrationOptions::estimate_translation, "initial_translation"},
      {&CalibrationOptions::estimate_gravity, "initial_gravity"}};
  for (const auto& [flag, initial] : flags) {
    CalibrationOptions options;
    options.*flag = false;
    EXPECT_TRUE(Contains(Refusal(options), initial));
    options.initial_time_shift = 0.0;
    options.initial_rotation = Eigen::Quaterniond::Identity();
    options.initial_translation = Eigen::Vector3d::Zero();
    options.initial_gravity = Eigen::Vector3d(0.0, 0.0, -9.8);
    EXPECT_NO_THROW(options.Validate());
  }
}

TEST(Options, SomethingMustBeEstimated) {
  CalibrationOptions options;
  options.initial_time_shift = 0.0;
  options.initial_rotation = Eigen::Quaterniond::Identity();
  options.initial_translation = Eigen::Vector3d::Zero();
  options.estimate_time_shift = options.estimate_rotation = options.estimate_translation =
      options.estimate_accel_delay = false;
  EXPECT_TRUE(Contains(Refusal(options), "nothing to estimate"));
}

TEST(Options, DriftAndIntrinsicsAreEstimatedByDefault) {
  const CalibrationOptions options;
  EXPECT_TRUE(options.estimate_clock_drift);
  EXPECT_EQ(options.imu_model, ImuModel::kScaleMisalignment);
}

}  // namespace
}  // namespace imu_pose_calib
