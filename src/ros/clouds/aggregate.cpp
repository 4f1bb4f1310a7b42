#include "imu_pose_calib/ros/clouds/aggregate.h"

#include <algorithm>
#include <cereal/archives/binary.hpp>
#include <cereal/types/string.hpp>
#include <cereal/types/vector.hpp>
#include <filesystem>
#include <limits>
#include <sstream>
#include <utility>

#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/io/yaml_text.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {

template <typename Archive>
void serialize(Archive& archive, MapPoint& point) {  // NOLINT(readability-identifier-naming)
  archive(point.x, point.y, point.z, point.intensity);
}

template <typename Archive>
void serialize(Archive& archive, Sharpness& sharpness) {  // NOLINT(readability-identifier-naming)
  archive(sharpness.entropy, sharpness.thickness, sharpness.places);
}

namespace {

constexpr char kCloudType[] = "sensor_msgs/PointCloud2";
constexpr size_t kFirstClouds = 5;            // that tell how points tell their times
constexpr size_t kSharpnessPoints = 200'000;  // about, by which sharpness is judged

void CheckRange(const char* name, double value, double least, double most) {
  if (!(value >= least && value <= most))
    throw InputError(std::string(name) + " = " + YamlNumber(value) + " must be within " +
                     YamlNumber(least) + " and " + YamlNumber(most));
}

void CheckPcd(const char* name, const std::string& path) {
  const std::filesystem::path file = path;
  if (file.extension() != ".pcd" || file.stem().empty())
    throw InputError(std::string(name) + " '" + path + "' must end in .pcd");
  std::error_code ignored;
  if (file.has_parent_path() && !std::filesystem::is_directory(file.parent_path(), ignored))
    throw InputError(std::string(name) + " '" + path + "' cannot be written: there is no folder '" +
                     file.parent_path().string() + "'");
}

/// The request with its defaults.
AggregateRequest Checked(AggregateRequest request) {
  OfflineRequest& recording = request.recording;
  if (recording.bag.paths.empty()) throw InputError("no bag is given");
  if (request.imu_sensor.empty() == request.marker_sensor.empty())
    throw InputError(
        "say where the sensor of the clouds sits: give either imu_sensor, "
        "x_imu = T x_sensor, or marker_sensor, x_marker = T x_sensor");
  if (!request.cloud_clock.empty() && request.cloud_clock != "imu" &&
      request.cloud_clock != "poses")
    throw InputError("cloud_clock '" + request.cloud_clock + "' is unknown; must be imu or poses");
  CheckRange("voxel", request.voxel_m, 1e-3, 100.0);
  CheckRange("radius", request.radius_m, 1e-2, 100.0);
  CheckRange("min_range", request.min_range_m, 0.0, 1e4);
  CheckRange("max_range", request.max_range_m, request.min_range_m, 1e4);
  if (!request.guess.empty() && request.imu_sensor.empty())
    throw InputError("guess needs imu_sensor: T_marker_imu does not matter for marker_sensor");
  if (request.output.empty())
    request.output =
        std::filesystem::path(recording.bag.paths.front()).replace_extension(".map.pcd");
  CheckPcd("output", request.output);
  if (!request.uncalibrated.empty()) CheckPcd("uncalibrated", request.uncalibrated);
  if (!request.uncalibrated.empty()) request.keep_uncalibrated = true;
  recording.one_recording = recording.keep_data = true;
  recording.output = std::filesystem::path(request.output).replace_extension(".calibration.yaml");
  return request;
}

SensorMount Mount(const AggregateRequest& request) {
  SensorMount sensor;
  sensor.is_on_imu = !request.imu_sensor.empty();
  sensor.T = sensor.is_on_imu ? ReadTransform("imu_sensor", request.imu_sensor)
                              : ReadTransform("marker_sensor", request.marker_sensor);
  if (!request.guess.empty()) sensor.guessed_T_MI = ReadTransform("guess", request.guess);
  return sensor;
}

// --- Clouds, read in a child process ---

/// The topic of the clouds.
BagTopic ChooseClouds(const Bags& bags, const std::string& name) {
  if (!name.empty()) {
    const BagTopic& topic = bags.Find("cloud_topic", name);
    if (topic.type != kCloudType)
      throw InputError("cloud_topic '" + name + "' is " + topic.type + ", must be " + kCloudType);
    return topic;
  }
  const std::vector<BagTopic> candidates =
      bags.Select([](const BagTopic& t) { return t.count > 0 && t.type == kCloudType; });
  if (candidates.empty())
    throw InputError(std::string("no topic of type ") + kCloudType + " in " + bags.Contents());
  if (candidates.size() > 1)
    throw InputError("several topics of clouds: " + Describe(candidates) +
                     "; choose with cloud_topic");
  return candidates[0];
}

/// The clouds of a recording.
class Clouds {
 public:
  explicit Clouds(const AggregateRequest& request)
      : bags_(request.recording.bag.paths, request.recording.bag.start_s,
              request.recording.bag.duration_s),
        topic_(ChooseClouds(bags_, request.cloud_topic)) {
    std::vector<sensor_msgs::PointCloud2> first;
    bags_.ForEach({topic_.name}, [&](const BagMessage& message) {
      const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
      if (!cloud->data.empty()) first.push_back(*cloud);
      return first.size() < kFirstClouds;
    });
    if (first.empty())
      throw InputError("cloud_topic '" + topic_.name + "' has no points in any cloud");
    Named(first.front(), [&] {
      time_ = FindPointTime(first, request.point_time);
      size_ = ReadCloud(first.front(), time_).size();
      has_intensity_ = HasIntensity(first.front());
    });
  }

  /// Calls `use(stamp_ns, points)` for each.
  template <typename Use>
  void ForEach(Use use) const {
    bags_.ForEach({topic_.name}, [&](const BagMessage& message) {
      const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
      Named(*cloud, [&] {
        if (cloud->header.stamp.isZero()) throw InputError("its stamp must be set");
        use(ToNanoseconds(cloud->header.stamp), ReadCloud(*cloud, time_));
      });
      return true;
    });
  }

  const BagTopic& topic() const { return topic_; }
  const PointTime& time() const { return time_; }
  bool has_intensity() const { return has_intensity_; }
  /// About how many points there are.
  size_t Points() const { return size_ * topic_.count; }

 private:
  /// Runs `run`; errors name topic and cloud.
  template <typename Run>
  void Named(const sensor_msgs::PointCloud2& cloud, Run run) const {
    try {
      run();
    } catch (const InputError& error) {
      throw InputError("cloud_topic '" + topic_.name + "', cloud stamped " +
                       Format("%.9f", cloud.header.stamp.toSec()) + ": " + error.what());
    }
  }

  Bags bags_;
  BagTopic topic_;
  PointTime time_;
  bool has_intensity_ = false;
  size_t size_ = 0;
};

/// What the child hands over.
struct Aggregate {
  std::string topic;
  PointTime time;
  double begin_s = 0.0, end_s = 0.0;   ///< stamps of the first and last cloud
  double least_s = 0.0, most_s = 0.0;  ///< from the stamp of a cloud to those of its points
  size_t clouds = 0, left_out = 0;     ///< the latter all without trajectory
  size_t points = 0, placed = 0, out_of_range = 0;
  bool has_intensity = false;
  std::vector<MapPoint> map, uncalibrated;
  std::vector<double> share;         ///< of the points that each variant places
  std::vector<Sharpness> sharpness;  ///< of each variant; without meaning for shares below a half

  template <typename Archive>
  void serialize(Archive& archive) {  // NOLINT(readability-identifier-naming): cereal's name
    archive(topic, time.field, time.unit, begin_s, end_s, least_s, most_s, clouds, left_out);
    archive(points, placed, out_of_range, has_intensity, map, uncalibrated);
    archive(share, sharpness);
  }
};

/// Puts clouds together, the last of the variants as the map.
class Aggregator {
 public:
  Aggregator(const AggregateRequest& request, const std::vector<SensorPoses>& variants,
             size_t about_points, Aggregate* aggregate)
      : request_(request),
        variants_(variants),
        stride_(about_points / kSharpnessPoints + 1),
        aggregate_(*aggregate),
        map_(request.voxel_m),
        uncalibrated_(request.voxel_m),
        samples_(variants.size()) {}

  void Add(int64_t stamp_ns, const std::vector<CloudPoint>& points) {
    int64_t first = 0, last = 0;  // after the stamp
    for (const CloudPoint& point : points) {
      first = std::min(first, point.time_after_ns);
      last = std::max(last, point.time_after_ns);
    }
    std::vector<CloudMotion> motions;
    for (const SensorPoses& variant : variants_)
      motions.emplace_back(variant.pose, stamp_ns + first, stamp_ns + last);

    const size_t placed_before = aggregate_.placed, points_before = aggregate_.points;
    for (const CloudPoint& point : points) {
      if (!point.p_S.allFinite()) continue;
      const auto range = static_cast<double>(point.p_S.norm());
      if (range == 0.0) continue;  // how many drivers write that nothing was seen
      if (range < request_.min_range_m || range > request_.max_range_m) {
        ++aggregate_.out_of_range;
        continue;
      }
      Place(motions, stamp_ns + point.time_after_ns, point);
    }
    const double stamp_s = 1e-9 * static_cast<double>(stamp_ns);
    if (aggregate_.clouds++ == 0) aggregate_.begin_s = stamp_s;
    aggregate_.end_s = stamp_s;
    if (aggregate_.points > points_before && aggregate_.placed == placed_before)
      ++aggregate_.left_out;
    aggregate_.least_s = std::min(aggregate_.least_s, 1e-9 * static_cast<double>(first));
    aggregate_.most_s = std::max(aggregate_.most_s, 1e-9 * static_cast<double>(last));
  }

  void Finish() {
    aggregate_.map = map_.Points();
    aggregate_.uncalibrated = uncalibrated_.Points();
    // A variant that places less than half of the points is not worth to be compared.
    std::vector<std::vector<Eigen::Vector3f>> maps;
    std::vector<size_t> compared;
    for (size_t v = 0; v < samples_.size(); ++v) {
      const auto count = std::count_if(samples_[v].begin(), samples_[v].end(),
                                       [](const auto& p) { return p.allFinite(); });
      aggregate_.share.push_back(static_cast<double>(count) /
                                 static_cast<double>(std::max<size_t>(1, samples_[v].size())));
      if (v + 1 < samples_.size() && aggregate_.share.back() < 0.5) continue;
      compared.push_back(v);
      maps.push_back(std::move(samples_[v]));
    }
    aggregate_.sharpness.resize(samples_.size());
    const std::vector<Sharpness> sharpness = CompareSharpness(maps, request_.radius_m);
    for (size_t i = 0; i < compared.size(); ++i) aggregate_.sharpness[compared[i]] = sharpness[i];
  }

 private:
  void Place(const std::vector<CloudMotion>& motions, int64_t t_ns, const CloudPoint& point) {
    const bool is_sample = aggregate_.points++ % stride_ == 0;
    for (size_t v = 0; v < motions.size(); ++v) {
      const bool is_map = v + 1 == motions.size();
      const bool is_uncalibrated = v == 0 && request_.keep_uncalibrated;
      if (!is_map && !is_uncalibrated && !is_sample) continue;
      const auto p_W = motions[v].Place(t_ns, point.p_S);
      if (is_sample)
        samples_[v].push_back(
            p_W ? Eigen::Vector3f(p_W->cast<float>())
                : Eigen::Vector3f::Constant(std::numeric_limits<float>::quiet_NaN()));
      if (!p_W) continue;
      if (is_uncalibrated) uncalibrated_.Add(*p_W, point.intensity);
      if (!is_map) continue;
      map_.Add(*p_W, point.intensity);
      ++aggregate_.placed;
    }
  }

  const AggregateRequest& request_;
  const std::vector<SensorPoses>& variants_;
  size_t stride_;
  Aggregate& aggregate_;
  VoxelMap map_, uncalibrated_;
  /// Every stride-th point by each variant; not finite: not placed.
  std::vector<std::vector<Eigen::Vector3f>> samples_;
};

Aggregate AggregateApart(const AggregateRequest& request,
                         const std::vector<SensorPoses>& variants) {
  const std::string bytes = ReadApart(request.recording.bag, [&] {
    const Clouds clouds(request);
    Aggregate aggregate;
    aggregate.topic = clouds.topic().name;
    aggregate.time = clouds.time();
    aggregate.has_intensity = clouds.has_intensity();
    Aggregator aggregator(request, variants, clouds.Points(), &aggregate);
    clouds.ForEach([&](int64_t stamp_ns, const std::vector<CloudPoint>& points) {
      aggregator.Add(stamp_ns, points);
    });
    aggregator.Finish();
    std::ostringstream stream;
    cereal::BinaryOutputArchive archive(stream);
    archive(aggregate);
    return std::move(stream).str();
  });
  std::istringstream stream(bytes);
  Aggregate aggregate;
  cereal::BinaryInputArchive archive(stream);
  archive(aggregate);
  return aggregate;
}

// --- What is said of it ---

void CheckPlaced(const AggregateRequest& request, const SessionData& data, const Aggregate& a) {
  if (a.placed > 0) return;
  const bool on_imu_clock = request.cloud_clock != "poses";
  const auto [first_ns, last_ns] = on_imu_clock ? SpanOf(data.imus[0].gyro) : SpanOf(data.poses);
  throw DataError(
      Format("no point of the %zu clouds of '%s', stamped %.3f to %.3f s, is within the trajectory "
             "and min_range to max_range; cloud_clock is %s stamped %.3f to %.3f s",
             a.clouds, a.topic.c_str(), a.begin_s, a.end_s,
             on_imu_clock ? "imu, which is" : "poses, which are",
             1e-9 * static_cast<double>(first_ns), 1e-9 * static_cast<double>(last_ns)));
}

std::string Describe(const AggregateRequest& request, const std::vector<SensorPoses>& variants,
                     const Aggregate& a) {
  std::string text = Wrap("clouds     ", Format("%zu of %s, %zu points, on the clock of the %s",
                                                a.clouds, a.topic.c_str(), a.points,
                                                request.cloud_clock == "poses" ? "poses" : "imu"));
  text +=
      Wrap("times      ",
           a.time.field.empty()
               ? "all points of a cloud at its stamp: they tell no times of their own"
               : Format("field '%s', in %s: %.1f to %.1f ms after the stamp", a.time.field.c_str(),
                        a.time.unit.c_str(), 1e3 * a.least_s, 1e3 * a.most_s));
  const size_t not_placed = a.points - a.placed;
  const double share =
      static_cast<double>(not_placed) / static_cast<double>(std::max<size_t>(1, a.points));
  text +=
      Wrap("left out   ",
           Format("%zu clouds, %zu points (%.1f %%) without trajectory; %zu nearer than %g m or "
                  "beyond %g m",
                  a.left_out, not_placed, 100.0 * share, a.out_of_range, request.min_range_m,
                  request.max_range_m));
  text += Wrap("map        ",
               Format("%zu points, means of cubes of %g m", a.map.size(), request.voxel_m));
  text += Format("\n  %-38s %12s %16s\n", "sharpness, better below", "map entropy", "planes [mm]");
  for (size_t v = 0; v < variants.size(); ++v) {
    text += Format("  %-38s", variants[v].name.c_str());
    text +=
        a.share[v] < 0.5 && v + 1 < variants.size()
            ? Format(" %.0f %% of points within the poses\n", 100 * a.share[v])
            : Format(" %12.3f %16.1f\n", a.sharpness[v].entropy, 1e3 * a.sharpness[v].thickness);
  }
  return text + Format("  (within %g m around the same %zu points in each)\n", request.radius_m,
                       a.sharpness.back().places);
}

}  // namespace

AggregateOutcome AggregateClouds(const AggregateRequest& given, const Progress& progress) {
  const AggregateRequest request = Checked(given);
  const SensorMount sensor = Mount(request);
  // Before it takes long:
  ReadApart(request.recording.bag, [&] { return Clouds(request).topic().name; });

  {
    OutputFiles tried;
    tried.Plan("output", request.output);
    if (!request.uncalibrated.empty()) tried.Plan("uncalibrated", request.uncalibrated);
  }
  OfflineResult offline = CalibrateOffline(request.recording, progress);
  const std::vector<SensorPoses> variants =
      PosesWithAndWithout(sensor, request.cloud_clock != "poses", offline);
  if (progress) progress("clouds", std::nullopt);
  Aggregate aggregate = AggregateApart(request, variants);
  if (progress) progress("clouds", 0);
  CheckPlaced(request, offline.sessions[0], aggregate);

  AggregateOutcome outcome;
  outcome.text = Describe(request, variants, aggregate);
  offline.outputs->Write(request.output, ToPcd(aggregate.map, aggregate.has_intensity));
  outcome.written.push_back(request.output);
  if (!request.uncalibrated.empty()) {
    offline.outputs->Write(request.uncalibrated,
                           ToPcd(aggregate.uncalibrated, aggregate.has_intensity));
    outcome.written.push_back(request.uncalibrated);
  }
  WriteResult(&offline);
  outcome.written.push_back(offline.request.output);
  outcome.world_frame = offline.infos[0].world_frame;
  outcome.map = std::move(aggregate.map);
  outcome.uncalibrated = std::move(aggregate.uncalibrated);
  return outcome;
}

}  // namespace imu_pose_calib
