#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/range/algorithm_ext/erase.hpp>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <string>
#include <utility>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/text_table.h"

namespace imu_pose_calib {
namespace {

std::ifstream Open(const std::string& path) {
  if (IsFolder(path)) Reject("'", path, "' is a directory, must be a file");
  std::ifstream file(path);
  if (!file) Reject("'", path, "' cannot be read: ", std::strerror(errno));
  return file;
}

/// SENSOR/data.csv of the request's folder that is of an IMU, or of poses, and is no pose sensor.
/// With pose sensors an IMU may be missing.
std::string FindTable(const RecordingRequest& request, bool is_imu) {
  const std::string& folder = request.paths[0];
  const std::string what = is_imu ? "an IMU" : "poses";
  const std::string fields = is_imu ? "imu, or gyro and accel" : "poses";
  namespace fs = std::filesystem;
  std::vector<std::string> tables;
  const std::vector<std::string> sensors = SplitPaths(request.pose_sensors);
  const auto is_sensor = [&](const std::string& path) {
    std::error_code ignored;
    return std::any_of(sensors.begin(), sensors.end(), [&](const std::string& name) {
      return fs::equivalent(SplitBody(name).first, path, ignored);
    });
  };
  try {
    const fs::path mav0 = fs::path(folder) / "mav0";
    const fs::path base = fs::is_directory(mav0) ? mav0 : fs::path(folder);
    for (const fs::directory_entry& sensor : fs::directory_iterator(base)) {
      const std::string path = (sensor.path() / "data.csv").string();
      if (!fs::is_regular_file(path) || is_sensor(path)) continue;
      std::ifstream file = Open(path);
      if (HasHeader(file, path, is_imu)) tables.push_back(path);
    }
  } catch (const fs::filesystem_error& error) {
    Reject("folder '", folder, "' cannot be read: ", error.code().message());
  }
  std::sort(tables.begin(), tables.end());
  if (tables.empty() && is_imu && !request.pose_sensors.empty()) return "";
  if (tables.empty())
    Reject("folder '", folder, "' has no SENSOR/data.csv whose header names the columns of ", what,
           "; name the file with ", fields);
  if (tables.size() > 1)
    Reject("folder '", folder, "' has several files of ", what, ": ", boost::join(tables, ", "),
           "; choose with ", fields);
  return tables[0];
}

// --- Span ---

/// Closed interval of stamps [ns].
struct Span {
  int64_t begin = std::numeric_limits<int64_t>::max(), end = std::numeric_limits<int64_t>::min();
};

Span Union(const Span& a, const Span& b) {
  return {std::min(a.begin, b.begin), std::max(a.end, b.end)};
}

template <typename Sample>
Span FindSpan(const std::vector<Sample>& samples) {
  Span span;
  for (const Sample& sample : samples) span = Union(span, {sample.t_ns, sample.t_ns});
  return span;
}

template <typename Sample>
void Keep(const Span& span, std::vector<Sample>* samples) {
  boost::remove_erase_if(*samples,
                         [&](const Sample& s) { return s.t_ns < span.begin || s.t_ns > span.end; });
}

/// Keeps the samples from `start_s` after the begin of `whole` on, for `duration_s`.
template <typename Sample>
void Cut(double start_s, double duration_s, const Span& whole, std::vector<Sample>* samples) {
  const double length_s = Seconds(whole.end - whole.begin);
  if (start_s > length_s)
    Reject("start = ", YamlNumber(start_s), " s is beyond the end of the recording, which lasts ",
           YamlNumber(length_s), " s");
  const int64_t begin = whole.begin + std::llround(1e9 * start_s);
  const bool ends_before = duration_s > 0.0 && start_s + duration_s < length_s;
  Keep({begin, ends_before ? begin + std::llround(1e9 * duration_s) : whole.end}, samples);
}

/// Keeps the poses within the time of the marker's, if there are any.
void CutToPoses(const std::vector<PoseSample>& marker, std::vector<PoseSample>* pose_sensor) {
  std::vector<PoseSample> within = *pose_sensor;
  Keep(FindSpan(marker), &within);
  if (!within.empty()) *pose_sensor = std::move(within);
}

/// See ReadText().
void CutSpan(double start_s, double duration_s, SessionData* data) {
  Span poses = FindSpan(data->poses);
  for (ImuData& samples : data->imus) {
    Span imu = Union(FindSpan(samples.gyro), FindSpan(samples.accel));
    if (poses.begin <= imu.end && imu.begin <= poses.end) imu = poses = Union(poses, imu);
    Cut(start_s, duration_s, imu, &samples.gyro);
    Cut(start_s, duration_s, imu, &samples.accel);
  }
  Cut(start_s, duration_s, poses, &data->poses);
}

/// Poses of a file that holds one body, nameless then, or of one of several.
MocapPoses ReadPoses(const std::string& path, const std::string& body) {
  std::ifstream poses = Open(path);
  if (std::optional<MocapPoses> mocap = ReadMocapCsv(poses, path, body)) return *std::move(mocap);
  if (!body.empty())
    Reject("body '", body, "' is given, but '", path,
           "' is no CSV of Motive or Vicon and holds one body");
  return {ReadPoseTable(poses, path), ""};
}

/// The marker and the pose sensors whose files are named.
void ReadAllPoses(const RecordingRequest& files, Recording* recording) {
  RecordingInfo& info = recording->info;
  std::string marker_body;
  if (!files.poses.empty()) {
    MocapPoses marker = ReadPoses(files.poses, files.body);
    recording->data.poses = std::move(marker.poses);
    info.pose_topic = files.poses;
    info.world_frame = "world";
    info.marker_frame = FrameName(marker.body, "marker");
    marker_body = marker.body;
  }
  const std::vector<std::string> sensors = SplitPaths(files.pose_sensors);
  info.pose_sensors.resize(sensors.size());
  recording->data.pose_sensors.resize(sensors.size());
  std::vector<std::string> names;
  for (size_t k = 0; k < sensors.size(); ++k) {
    if (!IsPoseFile(sensors[k])) continue;
    const auto [path, body] = SplitBody(sensors[k]);
    MocapPoses read = ReadPoses(path, body);
    const std::string stem = std::filesystem::path(path).stem();
    recording->data.pose_sensors[k] = std::move(read.poses);
    info.pose_sensors[k] = {JoinBody(path, read.body), FrameName(read.body, stem), stem + "_world"};
    names.push_back(info.pose_sensors[k].topic);
  }
  CheckPoseSensors(JoinBody(files.poses, marker_body), names);
}

}  // namespace

RecordingRequest FindFiles(RecordingRequest request) {
  const bool is_split =
      IsPair({"imu", request.imu}, {"gyro", request.gyro}, {"accel", request.accel});
  if (!request.paths.empty()) {
    if (request.poses.empty()) request.poses = FindTable(request, false);
    if (request.imu.empty() && !is_split) request.imu = FindTable(request, true);
    request.paths.clear();
  }
  if (request.poses.empty()) Reject("poses is missing: the file of the poses");
  if (request.imu.empty() && !is_split && request.pose_sensors.empty())
    Reject("imu is missing: the file of the IMU (or gyro and accel)");
  return request;
}

Recording ReadText(const RecordingRequest& request) {
  Recording recording;
  recording.info.imus.clear();
  recording.data.imus.clear();
  ReadFiles(FindFiles(request), &recording);
  return recording;
}

void ReadFiles(const RecordingRequest& files, Recording* recording) {
  CheckSpan(files.start_s, files.duration_s);
  ReadAllPoses(files, recording);
  const bool is_split = files.imu.empty();
  const std::vector<std::string> gyros = SplitPaths(is_split ? files.gyro : files.imu);
  const std::vector<std::string> accels = SplitPaths(is_split ? files.accel : files.imu);
  if (gyros.size() != accels.size())
    Reject("gyro and accel name different numbers of files: ", gyros.size(), " and ",
           accels.size());
  for (size_t i = 0; i < gyros.size(); ++i) {
    ImuInfo& info = recording->info.imus.emplace_back();
    ImuData& imu = recording->data.imus.emplace_back();
    info.imu_frame = "imu";
    std::ifstream gyro = Open(gyros[i]);
    if (is_split) {
      info.gyro_topic = gyros[i];
      info.accel_topic = accels[i];
      imu.gyro = ReadSensorTable(gyro, gyros[i], false);
      std::ifstream accel = Open(accels[i]);
      imu.accel = ReadSensorTable(accel, accels[i], true);
    } else {
      info.imu_topic = gyros[i];
      ReadImuTable(gyro, gyros[i], &imu);
    }
  }
  SessionData& data = recording->data;
  // Else it is the span of the bags.
  if (files.NamesPoseFile() || files.NamesImuFile())
    CutSpan(files.start_s, files.duration_s, &data);
  if (files.start_s == 0.0 && files.duration_s == 0.0) return;
  for (std::vector<PoseSample>& sensor : data.pose_sensors) CutToPoses(data.poses, &sensor);
}

}  // namespace imu_pose_calib
