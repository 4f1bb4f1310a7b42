#include <cmath>
#include <random>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/simulated/lidar.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kBegin = 1'600'000'000'000'000'000;

/// A sensor that moves at a constant velocity and turns about z.
std::optional<Rigid3> Moving(int64_t stamp_ns) {
  const double t = 1e-9 * static_cast<double>(stamp_ns - kBegin);
  return Rigid3{Eigen::Quaterniond(Eigen::AngleAxisd(2.0 * t, Eigen::Vector3d::UnitZ())),
                {3.0 * t, -1.0, 0.5}};
}

TEST(CloudMotion, PlacesEachPointAtItsOwnTime) {
  CloudMotion motion(Moving);
  for (const int64_t after : {int64_t{0}, int64_t{1'000'000}, int64_t{33'333'333},
                              int64_t{99'400'000}, int64_t{99'700'000}}) {
    const double t = 1e-9 * static_cast<double>(after), angle = 2.0 * t;
    const auto p = motion.Place(kBegin + after, {4.0f, 0.0f, 1.0f});
    ASSERT_TRUE(p);
    // A chord of 2 mrad misses 0.5 um per metre.
    EXPECT_NEAR(p->x(), 3.0 * t + 4.0 * std::cos(angle), 3e-6);
    EXPECT_NEAR(p->y(), -1.0 + 4.0 * std::sin(angle), 3e-6);
    EXPECT_NEAR(p->z(), 1.5, 1e-9);
  }
}

TEST(CloudMotion, LeavesOutWhatHasNoPose) {
  const auto pose = [](int64_t stamp_ns) -> std::optional<Rigid3> {
    const int64_t after = stamp_ns - kBegin;
    if (after > 20'000'000 && after < 50'000'000) return std::nullopt;
    return Moving(stamp_ns);
  };
  CloudMotion motion(pose);
  const auto is_placed = [&](int64_t after) {
    return motion.Place(kBegin + after, {1.0f, 0.0f, 0.0f}).has_value();
  };
  EXPECT_TRUE(is_placed(20'000'000));
  EXPECT_FALSE(is_placed(20'000'001));
  EXPECT_FALSE(is_placed(35'000'000));
  EXPECT_FALSE(is_placed(49'999'999));
  EXPECT_TRUE(is_placed(50'000'000));
}

TEST(CloudMotion, OfOneInstant) {
  const auto pose = [](int64_t stamp_ns) {
    return stamp_ns == kBegin ? Moving(stamp_ns) : std::nullopt;
  };
  CloudMotion motion(pose);
  EXPECT_TRUE(motion.Place(kBegin, {1.0f, 2.0f, 3.0f})->isApprox(Eigen::Vector3d(1.0, 1.0, 3.5)));
}

TEST(VoxelMap, HoldsTheMeanOfEachCube) {
  VoxelMap map(0.1);
  map.Add({0.01, 0.02, 0.03}, 10.0f);
  map.Add({0.05, 0.04, 0.09}, 20.0f);
  map.Add({-0.01, 0.02, 0.03}, 5.0f);
  std::vector<MapPoint> points = map.Points();
  ASSERT_EQ(points.size(), 2u);
  if (points[0][0] < 0.0f) std::swap(points[0], points[1]);
  EXPECT_FLOAT_EQ(points[0][0], 0.03f);
  EXPECT_FLOAT_EQ(points[0][1], 0.03f);
  EXPECT_FLOAT_EQ(points[0][2], 0.06f);
  EXPECT_FLOAT_EQ(points[0][3], 15.0f);
  EXPECT_FLOAT_EQ(points[1][0], -0.01f);
}

TEST(VoxelMap, IsBounded) {
  VoxelMap map(0.1, 3);
  for (int k = 0; k < 3; ++k) map.Add({static_cast<double>(k), 0.0, 0.0}, 0.0f);
  map.Add({0.0, 0.0, 0.0}, 0.0f);
  ExpectError<InputError>([&] { map.Add({3.0, 0.0, 0.0}, 0.0f); }, {"more than 3", "voxel"});
  VoxelMap far(0.1);
  ExpectError<InputError>([&] { far.Add({1e300, 0.0, 0.0}, 0.0f); }, {"1000000 m"});
  ExpectError<InputError>([&] { far.Add({0.0, std::nan(""), 0.0}, 0.0f); }, {"1000000 m"});
}

TEST(Sharpness, OfAPlaneIsThatOfItsNoise) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> place(-1.0, 1.0);
  std::normal_distribution<double> noise(0.0, 1.0);
  std::vector<std::vector<Eigen::Vector3f>> maps(2);
  for (int k = 0; k < 100'000; ++k) {
    const double x = place(random), y = place(random), z = noise(random);
    maps[0].push_back(Eigen::Vector3d(x, y, 0.02 * z).cast<float>());
    maps[1].push_back(Eigen::Vector3d(x, y, 0.005 * z).cast<float>());
  }
  maps[0][7].x() = std::nanf("");
  const std::vector<Sharpness> sharpness = CompareSharpness(maps, 0.2);
  EXPECT_NEAR(sharpness[0].thickness, 0.02, 1e-3);
  EXPECT_NEAR(sharpness[1].thickness, 0.005, 1e-4);
  EXPECT_GT(sharpness[0].places, 300u);
  EXPECT_EQ(sharpness[0].places, sharpness[1].places);
  // Points of a disc of radius r: variance r^2 / 4 along it. Less at the edges of the plane.
  const double disc = 0.5 * (3.0 * std::log(2.0 * M_PI * M_E) + 2.0 * std::log(0.2 * 0.2 / 4.0) +
                             2.0 * std::log(0.005));
  EXPECT_NEAR(sharpness[1].entropy, disc, 0.15);
  EXPECT_LT(sharpness[1].entropy, disc);
  EXPECT_NEAR(sharpness[0].entropy - sharpness[1].entropy, std::log(4.0), 0.05);
}

TEST(Sharpness, OfTooFewPointsIsOfNoPlaces) {
  const std::vector<std::vector<Eigen::Vector3f>> maps(2, {{0.0f, 0.0f, 0.0f}});
  EXPECT_EQ(CompareSharpness(maps, 0.2)[1].places, 0u);
}

TEST(SensorPoses, RightAngles) {
  const Eigen::Quaterniond q(0.5, -0.5, 0.5, 0.5);
  EXPECT_LT(ToRightAngles(q).angularDistance(q), 1e-9);
  EXPECT_LT(ToRightAngles(q * Exp(Eigen::Vector3d(0.2, -0.3, 0.25))).angularDistance(q), 1e-9);
  EXPECT_LT(ToRightAngles({0.9, 0.1, 0.0, 0.1}).angularDistance(Eigen::Quaterniond::Identity()),
            1e-9);
}

// --- The simulated lidar ---

TEST(CastRay, RangesByHand) {
  const Eigen::Vector3d center(0.0, 0.0, 0.0);
  const auto hit = [](const Eigen::Vector3d& from, const Eigen::Vector3d& along) {
    return CastRay(from, along.normalized());
  };
  // Walls at x = -3 and 3.4, y = -2.5 and 2.9, z = -1.6 and 1.5.
  EXPECT_DOUBLE_EQ(hit(center, -Eigen::Vector3d::UnitX()).range, 3.0);
  EXPECT_DOUBLE_EQ(hit(center, Eigen::Vector3d::UnitX()).range, 3.4);
  EXPECT_DOUBLE_EQ(hit(center, Eigen::Vector3d::UnitY()).range, 2.9);
  EXPECT_DOUBLE_EQ(hit({0.1, 0.2, 0.3}, -Eigen::Vector3d::UnitZ()).range, 1.9);
  EXPECT_DOUBLE_EQ(hit(center, {0.0, 1.0, 0.5}).range, 2.9 * std::sqrt(1.25));
  EXPECT_EQ(hit(center, Eigen::Vector3d::UnitY()).surface, 0);
  // The box from x = 2.2, y = 1 to 2, z = -0.5 to 0.3; beside and above it the wall.
  EXPECT_DOUBLE_EQ(hit({0.0, 1.5, 0.0}, Eigen::Vector3d::UnitX()).range, 2.2);
  EXPECT_EQ(hit({0.0, 1.5, 0.0}, Eigen::Vector3d::UnitX()).surface, 3);
  EXPECT_DOUBLE_EQ(hit({0.0, 2.01, 0.0}, Eigen::Vector3d::UnitX()).range, 3.4);
  EXPECT_DOUBLE_EQ(hit({0.0, 1.5, 0.31}, Eigen::Vector3d::UnitX()).range, 3.4);
  // The box behind is not seen.
  EXPECT_DOUBLE_EQ(hit({0.0, 1.5, 0.0}, -Eigen::Vector3d::UnitX()).range, 3.0);
}

TEST(SimulatedLidar, PointsAreOnTheRoomThroughTheTruePoses) {
  SimulatorOptions options;
  options.duration_s = 2.0;
  options.time_shift_s = -0.35;
  const SimulatedLidar lidar(options);
  EXPECT_EQ(lidar.Count(), 20u);
  const sensor_msgs::PointCloud2 cloud = lidar.Cloud(7);
  const PointTime time = FindPointTime({cloud, lidar.Cloud(8)}, "auto");
  EXPECT_EQ(time.field, "t");
  EXPECT_EQ(time.unit, "ns");
  const TrueTrajectory trajectory(options);
  double squares = 0.0;
  const std::vector<CloudPoint> points = ReadCloud(cloud, time);
  ASSERT_EQ(points.size(), 16u * 360u);
  for (const CloudPoint& point : points) {
    const int64_t stamp = lidar.Stamp(7) + point.time_after_ns;
    // t_pose = t_imu + time_shift, by the definition of the two stamps.
    const double t = 1e-9 * static_cast<double>(stamp - options.start_ns) + options.time_shift_s;
    const TrueState body = trajectory.At(t);
    const Rigid3 T_WL =
        Rigid3{Eigen::Quaterniond(body.R_WM), body.p_WM} * options.T_MI * SimulatedLidar::T_IL();
    const Eigen::Vector3d p_L = point.p_S.cast<double>();
    const double error = CastRay(T_WL.p, T_WL.q * p_L.normalized()).range - p_L.norm();
    squares += error * error;
  }
  EXPECT_NEAR(std::sqrt(squares / static_cast<double>(points.size())), 0.01, 5e-4);
}

}  // namespace
}  // namespace imu_pose_calib
