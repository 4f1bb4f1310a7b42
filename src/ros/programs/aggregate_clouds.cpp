// Puts the point clouds of a recording together through the calibrated trajectory.

#include <ros/ros.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <iostream>

#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

constexpr char kCloudType[] = "sensor_msgs/PointCloud2";
constexpr size_t kFirstClouds = 5;            // that tell how points tell their times
constexpr size_t kSharpnessPoints = 200'000;  // about, by which sharpness is judged

constexpr char kUsage[] =
    "Usage: aggregate_clouds BAG [BAG...] --imu-sensor T [options]\n\n"
    "Calibrates as calibrate_bag does, and writes one map of all point clouds, each\n"
    "point placed by the trajectory at its own time.\n\n";
constexpr char kExitStatus[] =
    "\nExit status: 0 written, 1 bad usage or unreadable input, 2 data that cannot be\n"
    "calibrated, or no cloud within the trajectory.\n";

/// Clouds of a recording to put together. Empty: the default.
struct Request {
  /// What to calibrate from; only bags, and all are one recording. The result goes beside the map.
  OfflineRequest recording;
  std::string cloud_topic;
  SensorMount sensor;               ///< that the clouds are of, but for the clock:
  std::string cloud_clock;          ///< of the clouds' stamps: "imu" (default) or "poses"
  std::string point_time = "auto";  ///< see FindPointTime()
  std::string output;               ///< PCD file; default: x.map.pcd for x.bag
  std::string uncalibrated;         ///< PCD file of the map without any calibration
  double voxel_m = 0.05;            ///< cubes of the map
  double min_range_m = 0.3;         ///< nearer points are of the sensor's own body
  double max_range_m = 200.0;
  double radius_m = 0.3;  ///< around a point, for the sharpness
  bool publish = false, quiet = false;
};

// --- Command line ---

/// An option that is a transform, see ReadTransform(); launch files leave it empty.
auto* Transform(const char* name, std::optional<Rigid3>* T) {
  return po::value<std::string>()->value_name("T")->notifier([=](const std::string& text) {
    if (!text.empty()) *T = ReadTransform(name, text);
  });
}

po::options_description Describe(Request* request) {
  OfflineRequest& recording = request->recording;
  po::options_description options("Options");
  auto add = options.add_options();
  add("imu-sensor", Transform("imu_sensor", &request->sensor.T_IS),
      "T_imu_sensor (x_imu = T x_sensor): \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("marker-sensor", Transform("marker_sensor", &request->sensor.T_MS),
      "T_marker_sensor, instead of it");
  add("cloud-topic", Value(&request->cloud_topic), "PointCloud2; default: the one in the bag");
  add("cloud-clock", Value(&request->cloud_clock), "clock of its stamps: imu (default) or poses");
  add("point-time", ValueOrDefault(&request->point_time, "UNIT"),
      "unit of the points' own times: s, ms, us, ns; none: they have none");
  add("output", Value(&request->output, "FILE"), "map; default: BAG.map.pcd next to the bag");
  add("voxel", ValueOrDefault(&request->voxel_m, "M"), "one point of the map for each such cube");
  add("min-range", ValueOrDefault(&request->min_range_m, "M"), "nearer points are left out");
  add("max-range", ValueOrDefault(&request->max_range_m, "M"), "farther points are left out");
  add("radius", ValueOrDefault(&request->radius_m, "M"), "around a point, to judge sharpness");
  add("uncalibrated", Value(&request->uncalibrated, "FILE"),
      "also write the map of the poses as recorded, without any calibration");
  add("guess", Transform("guess", &request->sensor.guessed_T_MI),
      "its T_marker_imu; default: nearest right angles, no lever arm");
  add("publish", po::bool_switch(&request->publish), "stay as a ROS node: ~map, ~uncalibrated");
  add("quiet", po::bool_switch(&request->quiet), "print errors only");

  po::options_description calibration("Calibration, as calibrate_bag has it");
  calibration.add_options()("calibration", Value(&recording.calibration, "FILE"),
                            "result of another recording: its T_marker_imu is kept");
  const RequestOptions known = OptionsOf(&recording);
  for (const auto& group : {known.common, known.others})
    AddRequestOptions(group, &calibration,
                      {"imu_topic", "pose_topic", "body", "gyro_topic", "accel_topic", "tf_parent",
                       "tf_child", "imu_frame", "imu_yaml", "config", "start", "duration"});
  options.add(calibration);
  return options;
}

void CheckRange(const char* name, double value, double least, double most) {
  if (!(value >= least && value <= most))
    Reject(name, " = ", YamlNumber(value), " must be within ", YamlNumber(least), " and ",
           YamlNumber(most));
}

/// Throws InputError when a map cannot be written there.
void PlanMap(const char* name, const std::string& path, OutputFiles* outputs) {
  const std::filesystem::path file = path;
  if (file.extension() != ".pcd" || file.stem().empty())
    Reject(name, " '", path, "' must end in .pcd");
  CheckFolderOf(name, path);
  outputs->Plan(name, path);
}

/// Checks the request, and sets its defaults.
void Complete(Request* request) {
  OfflineRequest& recording = request->recording;
  SensorMount& sensor = request->sensor;
  if (recording.paths.empty()) throw InputError("no bag is given");
  if (sensor.T_IS.has_value() == sensor.T_MS.has_value())
    throw InputError(
        "say where the sensor of the clouds sits: give either imu_sensor, "
        "x_imu = T x_sensor, or marker_sensor, x_marker = T x_sensor");
  sensor.is_on_imu_clock = ParseClock("cloud_clock", request->cloud_clock) == TrackClock::kImu;
  CheckRange("voxel", request->voxel_m, 1e-3, 100.0);
  CheckRange("radius", request->radius_m, 1e-2, 100.0);
  CheckRange("min_range", request->min_range_m, 0.0, 1e4);
  CheckRange("max_range", request->max_range_m, request->min_range_m, 1e4);
  if (sensor.guessed_T_MI && !sensor.T_IS)
    throw InputError("guess needs imu_sensor: T_marker_imu does not matter for marker_sensor");
  std::string& output = request->output;
  if (output.empty())
    output = std::filesystem::path(recording.paths.front()).replace_extension(".map.pcd");
  OutputFiles tried;
  PlanMap("output", output, &tried);
  if (!request->uncalibrated.empty()) PlanMap("uncalibrated", request->uncalibrated, &tried);
  recording.one_recording = recording.keep_data = true;
  recording.output = std::filesystem::path(output).replace_extension(".calibration.yaml");
}

// --- Clouds ---

/// The topic of the clouds.
BagTopic ChooseClouds(const Bags& bags, const std::string& name) {
  if (!name.empty()) return bags.Find("cloud_topic", name, {kCloudType});
  const auto candidates = bags.Select([](const BagTopic& t) { return t.type == kCloudType; });
  if (candidates.empty()) Reject("no topic of type ", kCloudType, " in ", bags.Contents());
  if (candidates.size() > 1)
    Reject("several topics of clouds: ", Describe(candidates), "; choose with cloud_topic");
  return candidates[0];
}

/// Puts the clouds of a recording together along several variants of the sensor's trajectory.
class Aggregator {
 public:
  /// Finds the clouds, and how their points tell their times.
  explicit Aggregator(const Request& request)
      : request_(request),
        bags_(request.recording.paths, request.recording.start_s, request.recording.duration_s),
        topic_(ChooseClouds(bags_, request.cloud_topic)) {
    std::vector<sensor_msgs::PointCloud2> first;
    bags_.ForEach({topic_.name}, [&](const BagMessage& message) {
      const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
      if (!cloud->data.empty()) first.push_back(*cloud);
      return first.size() < kFirstClouds;
    });
    if (first.empty()) Reject("cloud_topic '", topic_.name, "' has no points in any cloud");
    Named(first.front(), [&] {
      time_ = FindPointTime(first, request.point_time);
      stride_ = ReadCloud(first.front(), time_).size() * topic_.count / kSharpnessPoints + 1;
      has_intensity_ = HasIntensity(first.front());
    });
  }

  /// Places all points by each of the variants, of which the last one makes the map.
  void Place(const std::vector<SensorPoses>& variants) {
    for (const SensorPoses& poses : variants) variants_.push_back({poses, {}, {}, {}});
    variants_.back().map.emplace(request_.voxel_m);
    if (request_.publish || !request_.uncalibrated.empty())
      variants_.front().map.emplace(request_.voxel_m);
    bags_.ForEach({topic_.name}, [&](const BagMessage& message) {
      const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
      Named(*cloud, [&] {
        if (cloud->header.stamp.isZero()) throw InputError("its stamp must be set");
        Add(ToNanoseconds(cloud->header.stamp), ReadCloud(*cloud, time_));
      });
      return true;
    });
  }

  std::vector<MapPoint> Map() const { return variants_.back().map->Points(); }
  /// None when it is not wanted.
  std::vector<MapPoint> Uncalibrated() const {
    const std::optional<VoxelMap>& map = variants_.front().map;
    return map ? map->Points() : std::vector<MapPoint>();
  }
  bool has_intensity() const { return has_intensity_; }

  /// What a person wants to know of the map. Throws DataError saying why if there is none.
  std::string Describe(const SessionData& data) const {
    if (placed_ == 0) throw DataError(Refusal(data));
    return Counts() + SharpnessTable();
  }

 private:
  struct Variant : SensorPoses {
    std::optional<CloudMotion> motion;  ///< during the cloud that is placed
    std::optional<VoxelMap> map;
    std::vector<Eigen::Vector3f> samples;  ///< every stride-th point; not finite: not placed

    /// Of the points that it places.
    double Share() const {
      const auto placed = std::count_if(samples.begin(), samples.end(),
                                        [](const auto& p) { return p.allFinite(); });
      return static_cast<double>(placed) / static_cast<double>(samples.size());
    }
  };

  /// Runs `run`; errors name topic and cloud.
  template <typename Run>
  void Named(const sensor_msgs::PointCloud2& cloud, Run run) const {
    try {
      run();
    } catch (const InputError& error) {
      Reject("cloud_topic '", topic_.name, "', cloud stamped ",
             Format("%.9f", cloud.header.stamp.toSec()), ": ", error.what());
    }
  }

  void Add(int64_t stamp_ns, const std::vector<CloudPoint>& points) {
    for (Variant& variant : variants_) variant.motion.emplace(variant.pose);
    const size_t placed_before = placed_, points_before = points_;
    for (const CloudPoint& point : points) {
      least_ns_ = std::min(least_ns_, point.time_after_ns);
      most_ns_ = std::max(most_ns_, point.time_after_ns);
      if (!point.p_S.allFinite()) continue;
      const auto range = static_cast<double>(point.p_S.norm());
      if (range == 0.0) continue;  // how many drivers write that nothing was seen
      if (range < request_.min_range_m || range > request_.max_range_m) {
        ++out_of_range_;
        continue;
      }
      const bool is_sample = points_++ % stride_ == 0;
      for (Variant& variant : variants_) {
        if (!variant.map && !is_sample) continue;
        const auto p_W = variant.motion->Place(stamp_ns + point.time_after_ns, point.p_S);
        if (is_sample)
          variant.samples.emplace_back(p_W.value_or(Eigen::Vector3d::Constant(NAN)).cast<float>());
        if (p_W && variant.map) variant.map->Add(*p_W, point.intensity);
        if (p_W && &variant == &variants_.back()) ++placed_;
      }
    }
    if (points_ > points_before && placed_ == placed_before) ++left_out_;
    if (clouds_seen_++ == 0) begin_ns_ = stamp_ns;
    end_ns_ = stamp_ns;
  }

  std::string Refusal(const SessionData& data) const {
    const bool on_imu_clock = request_.sensor.is_on_imu_clock;
    const std::vector<int64_t> stamps =
        on_imu_clock ? Stamps(data.imus[0].gyro) : Stamps(data.poses);
    const auto [first, last] = std::minmax_element(stamps.begin(), stamps.end());
    return Format(
        "no point of the %zu clouds of '%s', stamped %.3f to %.3f s, is within the trajectory and "
        "min_range to max_range; cloud_clock is %s stamped %.3f to %.3f s",
        clouds_seen_, topic_.name.c_str(), Seconds(begin_ns_), Seconds(end_ns_),
        on_imu_clock ? "imu, which is" : "poses, which are", Seconds(*first), Seconds(*last));
  }

  std::string Counts() const {
    const size_t not_placed = points_ - placed_;
    return Wrap("clouds     ", Format("%zu of %s, %zu points, on the clock of the %s", clouds_seen_,
                                      topic_.name.c_str(), points_,
                                      request_.sensor.is_on_imu_clock ? "imu" : "poses")) +
           Wrap("times      ",
                time_.field.empty()
                    ? "all points of a cloud at its stamp: they tell no times of their own"
                    : Format("field '%s', in %s: %.1f to %.1f ms after the stamp",
                             time_.field.c_str(), time_.unit.c_str(), 1e3 * Seconds(least_ns_),
                             1e3 * Seconds(most_ns_))) +
           Wrap("left out   ",
                Format("%zu clouds, %zu points (%.1f %%) without trajectory; %zu nearer than %g m "
                       "or beyond %g m",
                       left_out_, not_placed,
                       100.0 * (static_cast<double>(not_placed) / static_cast<double>(points_)),
                       out_of_range_, request_.min_range_m, request_.max_range_m)) +
           Wrap("map        ", Format("%zu points, means of cubes of %g m",
                                      variants_.back().map->size(), request_.voxel_m));
  }

  std::string SharpnessTable() const {
    std::vector<std::vector<Eigen::Vector3f>> maps;
    for (const Variant& variant : variants_)
      if (IsCompared(variant)) maps.push_back(variant.samples);
    const std::vector<Sharpness> sharpness = CompareSharpness(maps, request_.radius_m);
    auto row = sharpness.begin();
    std::string text =
        Format("\n  %-38s %12s %16s\n", "sharpness, better below", "map entropy", "planes [mm]");
    for (const Variant& variant : variants_) {
      if (!IsCompared(variant)) {
        text += Format("  %-38s %.0f %% of points within the poses\n", variant.name.c_str(),
                       100 * variant.Share());
        continue;
      }
      text += Format("  %-38s %12.3f %16.1f\n", variant.name.c_str(), row->entropy,
                     1e3 * row->thickness);
      ++row;
    }
    return text + Format("  (within %g m around the same %zu points in each)\n", request_.radius_m,
                         sharpness.back().places);
  }

  /// One that places less than half of the points is not worth to be compared.
  bool IsCompared(const Variant& variant) const {
    return variant.Share() >= 0.5 || &variant == &variants_.back();
  }

  const Request& request_;
  const Bags bags_;
  const BagTopic topic_;
  PointTime time_;
  bool has_intensity_ = false;
  size_t stride_ = 1;

  int64_t begin_ns_ = 0, end_ns_ = 0;      ///< stamps of the first and last cloud
  int64_t least_ns_ = 0, most_ns_ = 0;     ///< from the stamp of a cloud to those of its points
  size_t clouds_seen_ = 0, left_out_ = 0;  ///< the latter all without trajectory
  size_t points_ = 0, placed_ = 0, out_of_range_ = 0;
  std::vector<Variant> variants_;
};

/// Calibrates, and puts the clouds together through the trajectory of the solve, each point at its
/// own time; what has no trajectory is left out. Judges the map's sharpness, with and without the
/// calibration.
///
/// Throws InputError when something cannot be used as given, DataError when no calibration can come
/// from the data, or no cloud is within the trajectory.
void Run(int argc, char** argv) {
  Request request;
  if (!ParseOrHelp(argc, argv, kUsage, Describe(&request), kExitStatus,
                   Unnamed{"bag", Value(&request.recording.paths), -1}))
    return;
  Complete(&request);
  auto guard = std::make_unique<InterruptGuard>();
  const Progress progress = ShowProgress(request.quiet);
  Aggregator aggregator(request);  // before it takes long
  OfflineResult offline = CalibrateOffline(request.recording, progress);
  if (progress) progress("clouds", std::nullopt);
  aggregator.Place(PosesWithAndWithout(request.sensor, offline));
  const std::string text = aggregator.Describe(offline.sessions[0]);
  if (progress) progress("clouds", 0);

  const std::vector<MapPoint> map = aggregator.Map(), uncalibrated = aggregator.Uncalibrated();
  for (const auto& [path, points] :
       {std::pair(request.output, &map), {request.uncalibrated, &uncalibrated}}) {
    if (path.empty()) continue;
    offline.outputs->Write(path, ToPcd(*points, aggregator.has_intensity()));
    offline.written.push_back(path);
  }
  WriteResult(&offline);
  guard.reset();
  if (!request.quiet) std::cout << text << WrittenTo(offline.written) << std::flush;
  if (!request.publish) return;
  ros::NodeHandle node("~");
  std::vector<ros::Publisher> publishers;  // offer the maps as long as they are there
  for (const auto& [topic, points] : {std::pair("map", &map), {"uncalibrated", &uncalibrated}}) {
    publishers.push_back(node.advertise<sensor_msgs::PointCloud2>(topic, 1, true));
    publishers.back().publish(ToMessage(*points, offline.infos[0].world_frame));
  }
  ros::spin();
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  ros::init(argc, argv, "aggregate_clouds");  // takes out what roslaunch adds; starts nothing
  return imu_pose_calib::RunCommand("aggregate_clouds", [&] { imu_pose_calib::Run(argc, argv); });
}
