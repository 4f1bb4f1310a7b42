// aggregate_clouds on simulated recordings of a room.

#include <rosbag/bag.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "cloud_util.h"
#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/simulated/lidar.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"
#include "to_ros2.h"

namespace imu_pose_calib {
namespace {

class AggregateTest : public ExecutableTest {
 protected:
  static SimulatorOptions Options() {
    SimulatorOptions options;
    options.duration_s = 20.0;
    options.seed = 5;
    return options;
  }

  /// Writes sim.bag with clouds; `change` may alter the samples before.
  template <typename Change>
  void Simulate(const SimulatorOptions& options, Change change) const {
    SessionData data = imu_pose_calib::Simulate(options);
    change(&data);
    WriteBag(Path("sim.bag"), data, {});
    AppendLidar(Path("sim.bag"), options);
    Write("lidar.yaml", LidarYaml());
  }
  void Simulate(const SimulatorOptions& options) const {
    Simulate(options, [](SessionData*) {});
  }

  Outcome Aggregate(const std::string& arguments) const {
    return Run("aggregate_clouds", arguments);
  }

  /// Map entropy and thickness of planes [mm] in the line of the table that begins with `name`.
  static std::pair<double, double> Row(const std::string& out, const std::string& name) {
    const size_t at = out.find("  " + name + " ");
    if (at == std::string::npos) {
      ADD_FAILURE() << "no '" << name << "' in " << out;
      return {0.0, 0.0};
    }
    std::istringstream words(out.substr(at + 2 + name.size()));
    std::pair<double, double> row{};
    EXPECT_TRUE(words >> row.first >> row.second) << out;
    return row;
  }

  /// How far a point is from the nearest wall or side of a box [m]: the planes of the scene, each
  /// as far as it reaches.
  static double ToSurface(const std::vector<float>& p) {
    const double boxes[][6] = {{-3.0, -2.5, -1.6, 3.4, 2.9, 1.5},
                               {1.6, -2.5, -1.6, 2.6, -1.5, 1.5},
                               {-3.0, 1.4, -1.6, -1.2, 2.9, -0.6},
                               {2.2, 1.0, -0.5, 3.4, 2.0, 0.3},
                               {-2.4, -2.2, 0.6, -1.6, -1.2, 1.5}};
    double nearest = std::numeric_limits<double>::infinity();
    for (const auto& box : boxes)
      for (int side = 0; side < 6; ++side) {
        double squares = 0.0;
        for (int i = 0; i < 3; ++i) {
          const auto x = static_cast<double>(p[static_cast<size_t>(i)]);
          const double d = i == side % 3 ? x - box[side] : x - std::clamp(x, box[i], box[i + 3]);
          squares += d * d;
        }
        nearest = std::min(nearest, std::sqrt(squares));
      }
    return nearest;
  }

  /// Expects a map whose points are on the surfaces but for the noise of the ranges, 10 mm.
  void ExpectSharpMap(const std::string& name) const {
    const PcdFile pcd(ReadText(Path(name)));
    EXPECT_EQ(pcd.header.at("FIELDS").back(), "intensity");
    EXPECT_GT(pcd.points.size(), 30'000u);
    double squares = 0.0, farthest = 0.0;
    for (const std::vector<float>& point : pcd.points) {
      const double distance = ToSurface(point);
      squares += distance * distance;
      farthest = std::max(farthest, distance);
    }
    EXPECT_LT(std::sqrt(squares / static_cast<double>(pcd.points.size())), 0.012);
    EXPECT_LT(farthest, 0.07);
  }

  void ExpectRefusal(const std::string& arguments, int status,
                     const std::vector<std::string>& parts) const {
    const Outcome outcome = Aggregate(arguments);
    EXPECT_EQ(outcome.status, status) << outcome.err;
    EXPECT_EQ(outcome.err.compare(0, 25, "aggregate_clouds: error: "), 0) << outcome.err;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.err, part)) << "'" << part << "' is missing in " << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_FALSE(std::filesystem::exists(Path("sim.map.pcd")));
    EXPECT_FALSE(std::filesystem::exists(Path("sim.map.calibration.yaml")));
  }
};

TEST_F(AggregateTest, TheMapIsSharperThanWithoutTheCalibration) {
  const Outcome made = Run("simulate_bag", "sim.bag --lidar --duration 20 --seed 5");
  ASSERT_EQ(made.status, 0) << made.err;
  const Outcome outcome =
      Aggregate("sim.bag --imu-sensor sim.lidar.yaml --uncalibrated without.pcd");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  const auto without = Row(outcome.out, "without calibration");
  const auto with = Row(outcome.out, "calibrated");
  EXPECT_LT(with.second, without.second / 3.0);
  EXPECT_NEAR(with.second, 9.0, 1.5);
  EXPECT_LT(with.first, without.first - 1.0);
  for (const char* name : {"all but T_marker_imu", "all but the time shift"}) {
    EXPECT_GT(Row(outcome.out, name).second, 1.5 * with.second);
    EXPECT_GT(Row(outcome.out, name).first, with.first + 0.3);
  }
  EXPECT_GT(Row(outcome.out, "all but the trajectory").first, with.first);
  EXPECT_TRUE(Contains(outcome.out, "200 of /points, 1152000 points")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "field 't', in ns: 0.0 to 99.7 ms")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "sim.map.pcd")) << outcome.out;
  ExpectSharpMap("sim.map.pcd");
  double squares = 0.0;
  const PcdFile blurred(ReadText(Path("without.pcd")));
  for (const std::vector<float>& point : blurred.points) squares += std::pow(ToSurface(point), 2);
  EXPECT_GT(std::sqrt(squares / static_cast<double>(blurred.points.size())), 0.04);
  EXPECT_EQ(YAML::LoadFile(Path("sim.map.calibration.yaml"))["imu_pose_calib"]["status"]
                .as<std::string>(),
            "ok");
}

TEST_F(AggregateTest, TheMapIsAsSharpAsThroughTheTruePoses) {
  const SimulatorOptions options = Options();
  Simulate(options);
  OfflineRequest request;
  request.paths = {Path("sim.bag")};
  request.keep_data = true;
  const OfflineResult offline = CalibrateOffline(request);
  std::vector<SensorPoses> all = PosesWithAndWithout({SimulatedLidar::T_IL(), {}, {}}, offline);
  ASSERT_EQ(all.size(), 5u);
  const SimulatedLidar lidar(options);
  all.push_back({"truth", [&](int64_t stamp_ns) { return lidar.PoseAt(stamp_ns); }});
  std::vector<std::vector<Eigen::Vector3f>> maps(all.size());
  double largest = 0.0;  // between the points of the last two
  for (size_t k = 5; k < 195; ++k) {
    const sensor_msgs::PointCloud2 cloud = lidar.Cloud(k);
    const std::vector<CloudPoint> points = ReadCloud(cloud, FindPointTime({cloud}, "auto"));
    const int64_t begin = lidar.Stamp(k);
    std::vector<CloudMotion> motions;
    for (const SensorPoses& poses : all) motions.emplace_back(poses.pose);
    for (size_t i = 0; i < points.size(); i += 5) {
      for (size_t v = 0; v < all.size(); ++v)
        maps[v].push_back(
            motions[v].Place(begin + points[i].time_after_ns, points[i].p_S).value().cast<float>());
      largest = std::max(largest, static_cast<double>((maps[4].back() - maps[5].back()).norm()));
    }
  }
  const std::vector<Sharpness> sharpness = CompareSharpness(maps, 0.3);
  EXPECT_NEAR(sharpness[4].entropy, sharpness[5].entropy, 0.01);
  EXPECT_NEAR(sharpness[4].thickness, sharpness[5].thickness, 1e-4);
  EXPECT_GT(sharpness[0].entropy, sharpness[5].entropy + 1.0);
  EXPECT_LT(largest, 0.01);
}

TEST_F(AggregateTest, CloudsInGapsAreLeftOut) {
  SimulatorOptions options = Options();
  Simulate(options, [&](SessionData* data) {
    auto& poses = data->poses;
    poses.erase(std::remove_if(poses.begin(), poses.end(),
                               [&](const PoseSample& pose) {
                                 const double t =
                                     1e-9 * static_cast<double>(pose.t_ns - options.start_ns);
                                 return t > 8.0 && t < 10.0;
                               }),
                poses.end());
  });
  const Outcome outcome = Aggregate("sim.bag --imu-sensor lidar.yaml");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  // 2 s of the poses are 19 to 20 turns of the lidar, the first and last of which may be in part.
  const size_t at = outcome.out.find("left out   ");
  ASSERT_NE(at, std::string::npos);
  const int clouds = std::stoi(outcome.out.substr(at + 11));
  EXPECT_GE(clouds, 18);
  EXPECT_LE(clouds, 20);
  ExpectSharpMap("sim.map.pcd");
}

TEST_F(AggregateTest, SensorOnTheMarkerAndClockOfThePoses) {
  SimulatorOptions options = Options();
  Simulate(options);
  const Rigid3 T_ML = options.T_MI * SimulatedLidar::T_IL();
  std::ostringstream text;
  text.precision(12);
  text << T_ML.p.transpose() << " " << T_ML.q.coeffs().transpose();
  const Outcome marker =
      Aggregate("sim.bag --marker-sensor '" + text.str() + "' --cloud-topic /points");
  ASSERT_EQ(marker.status, 0) << marker.err;
  EXPECT_FALSE(Contains(marker.out, "all but T_marker_imu")) << marker.out;
  ExpectSharpMap("sim.map.pcd");

  options.time_shift_s = 0.0;
  Simulate(options);
  const Outcome poses =
      Aggregate("sim.bag --imu-sensor lidar.yaml --cloud-clock poses --output poses.pcd");
  ASSERT_EQ(poses.status, 0) << poses.err;
  EXPECT_FALSE(Contains(poses.out, "all but the time shift")) << poses.out;
  EXPECT_TRUE(std::filesystem::exists(Path("poses.calibration.yaml")));
  ExpectSharpMap("poses.pcd");
}

TEST_F(AggregateTest, ClocksDaysApartAndKnownCalibration) {
  SimulatorOptions options = Options();
  options.time_shift_s = -900'000.0;
  Simulate(options);
  ASSERT_EQ(Calibrate("sim.bag --quiet").status, 0);
  const YAML::Node first = YAML::LoadFile(Path("sim.calibration.yaml"));
  options.seed = 6;
  options.time_shift_s = 0.1;
  Simulate(options);
  const Outcome outcome = Aggregate(
      "sim.bag --imu-sensor lidar.yaml --calibration sim.calibration.yaml --output b.pcd");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  ExpectSharpMap("b.pcd");
  const YAML::Node second = YAML::LoadFile(Path("b.calibration.yaml"));
  for (size_t i = 0; i < 3; ++i)
    EXPECT_NEAR(second["transform"]["translation"][i].as<double>(),
                first["transform"]["translation"][i].as<double>(), 1e-9);
  EXPECT_NEAR(second["time_shift"].as<double>(), 0.1, 1e-3);
  ASSERT_TRUE(std::filesystem::exists(Path("sim.calibration.yaml")));
}

TEST_F(AggregateTest, Refusals) {
  SimulatorOptions options = Options();
  options.duration_s = 10.0;
  Simulate(options);
  EXPECT_EQ(Aggregate("--help").status, 0);
  ExpectRefusal("", 1, {"no bag"});
  ExpectRefusal("sim.bag", 1, {"imu_sensor", "marker_sensor"});
  ExpectRefusal("sim.bag --imu-sensor lidar.yaml --marker-sensor lidar.yaml", 1, {"either"});
  ExpectRefusal("sim.bag --imu-sensor '1 2 3'", 1, {"imu_sensor '1 2 3'", "7 numbers"});
  ExpectRefusal("sim.bag --imu-sensor none.yaml", 1, {"none.yaml"});
  const std::string mounted = "sim.bag --imu-sensor lidar.yaml ";
  ExpectRefusal(mounted + "--cloud-topic /cloud", 1, {"cloud_topic '/cloud'", "/points"});
  ExpectRefusal(mounted + "--cloud-topic /imu", 1, {"sensor_msgs/Imu", "PointCloud2"});
  ExpectRefusal(mounted + "--cloud-clock gps", 1, {"cloud_clock 'gps'", "imu or poses"});
  ExpectRefusal(mounted + "--point-time h", 1, {"point_time 'h'", "ns"});
  ExpectRefusal(mounted + "--point-time s", 1, {"'t'", "/points", "s of the stamp"});
  ExpectRefusal(mounted + "--output map.ply", 1, {"output 'map.ply'", ".pcd"});
  ExpectRefusal(mounted + "--output none/map.pcd", 1, {"'none/map.pcd'", "folder 'none'"});
  ExpectRefusal(mounted + "--uncalibrated sim.map.pcd", 1, {"uncalibrated and output"});
  ExpectRefusal(mounted + "--voxel 0", 1, {"voxel = 0", "0.001"});
  ExpectRefusal(mounted + "--voxel nan", 1, {"voxel"});
  ExpectRefusal(mounted + "--max-range 0.1", 1, {"max_range = 0.1", "0.3"});
  ExpectRefusal("sim.bag --marker-sensor lidar.yaml --guess lidar.yaml", 1, {"guess"});
  ExpectRefusal(mounted + "--calibration lidar.yaml", 1, {"lidar.yaml"});
  ExpectRefusal(mounted + "--cloud-clock poses --max-range 0.5", 2, {"no point", "/points"});
  WriteBag(Path("none.bag"), imu_pose_calib::Simulate(options), {});
  ExpectRefusal("none.bag --imu-sensor lidar.yaml", 1, {"PointCloud2", "/mocap/pose"});
}

TEST_F(AggregateTest, DataThatCannotBeCalibrated) {
  SimulatorOptions options = Options();
  options.motion = Motion::kStatic;
  Simulate(options);
  ExpectRefusal("sim.bag --imu-sensor lidar.yaml", 2, {"does not turn"});
}

TEST_F(AggregateTest, BagsOfRos2GiveTheSameMap) {
  SimulatorOptions options = Options();
  options.duration_s = 8.0;
  Simulate(options);
  ASSERT_EQ(Aggregate("sim.bag --imu-sensor lidar.yaml --output a.pcd").status, 0);
  ToRos2(Path("sim.bag"), Path("sim.mcap"), {"mcap", "zstd"});
  const Outcome outcome = Aggregate("sim.mcap --imu-sensor lidar.yaml --output b.pcd");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_GT(ReadText(Path("a.pcd")).size(), 100'000u);
  EXPECT_TRUE(ReadText(Path("a.pcd")) == ReadText(Path("b.pcd")));
}

TEST_F(AggregateTest, CloudsOfAnotherTime) {
  SimulatorOptions options = Options();
  options.duration_s = 10.0;
  const SessionData data = imu_pose_calib::Simulate(options);
  WriteBag(Path("sim.bag"), data, {});
  options.start_ns += 500'000'000'000;
  AppendLidar(Path("sim.bag"), options);
  Write("lidar.yaml", LidarYaml());
  ExpectRefusal("sim.bag --imu-sensor lidar.yaml", 2, {"100 clouds", "cloud_clock", "1600000"});
}

TEST_F(AggregateTest, DamagedClouds) {
  SimulatorOptions options = Options();
  options.duration_s = 10.0;
  const SimulatedLidar lidar(options);
  const auto refused = [&](size_t place, const auto& damage,
                           const std::vector<std::string>& parts) {
    WriteBag(Path("sim.bag"), imu_pose_calib::Simulate(options), {});
    {
      rosbag::Bag bag(Path("sim.bag"), rosbag::bagmode::Append);
      for (size_t k = 0; k < lidar.Count(); ++k) {
        sensor_msgs::PointCloud2 cloud = lidar.Cloud(k);
        if (k == place) damage(&cloud);
        bag.write("/points", FromNanoseconds(lidar.Stamp(k)), cloud);
      }
    }
    ExpectRefusal("sim.bag --imu-sensor lidar.yaml", 1, parts);
  };
  Write("lidar.yaml", LidarYaml());
  refused(0, [](auto* c) { c->data.resize(1000); },
          {"/points", "1599999999.98", "size of data = 1000"});
  refused(30, [](auto* c) { c->width = 0xffffffffu; }, {"'/points'", "size of data", "width"});
  refused(30, [](auto* c) { c->fields.clear(); }, {"'/points'", "'x'"});
  refused(30, [](auto* c) { c->header.stamp = ros::Time(); }, {"'/points'", "stamp"});
}

}  // namespace
}  // namespace imu_pose_calib
