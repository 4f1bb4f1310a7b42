#include "imu_pose_calib/ros/io/text_reader.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <utility>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/mocap_csv.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

std::ifstream Open(const std::string& path) {
  std::error_code ignored;
  if (std::filesystem::is_directory(path, ignored))
    throw InputError("'" + path + "' is a directory, must be a file");
  std::ifstream file(path);
  if (!file) throw InputError("'" + path + "' cannot be read: " + std::strerror(errno));
  return file;
}

/// Names of files with white space between them, or the name of one that has some in it.
std::vector<std::string> SplitFiles(const std::string& text) {
  return std::filesystem::exists(text) ? std::vector<std::string>{text} : SplitNames(text);
}

using HasHeader = bool (*)(std::istream&, const std::string& name);

/// SENSOR/data.csv of the folder that has the header.
std::string FindTable(const std::string& folder, HasHeader has_header, const std::string& what,
                      const std::string& fields) {
  namespace fs = std::filesystem;
  std::vector<std::string> tables;
  try {
    const fs::path mav0 = fs::path(folder) / "mav0";
    const fs::path base = fs::is_directory(mav0) ? mav0 : fs::path(folder);
    for (const fs::directory_entry& sensor : fs::directory_iterator(base)) {
      const std::string path = (sensor.path() / "data.csv").string();
      if (!fs::is_regular_file(path)) continue;
      std::ifstream file = Open(path);
      if (has_header(file, path)) tables.push_back(path);
    }
  } catch (const fs::filesystem_error& error) {
    throw InputError("folder '" + folder + "' cannot be read: " + error.code().message());
  }
  std::sort(tables.begin(), tables.end());
  if (tables.empty())
    throw InputError("folder '" + folder +
                     "' has no SENSOR/data.csv whose header names the columns of " + what +
                     "; name the file with " + fields);
  if (tables.size() > 1)
    throw InputError("folder '" + folder + "' has several files of " + what + ": " +
                     boost::join(tables, ", ") + "; choose with " + fields);
  return tables[0];
}

// --- Span ---

/// Closed interval of stamps [ns].
struct Span {
  int64_t begin, end;
};

template <typename Sample>
Span FindSpan(const std::vector<Sample>& samples) {
  const auto [first, last] =
      std::minmax_element(samples.begin(), samples.end(),
                          [](const Sample& a, const Sample& b) { return a.t_ns < b.t_ns; });
  return {first->t_ns, last->t_ns};
}

Span Union(const Span& a, const Span& b) {
  return {std::min(a.begin, b.begin), std::max(a.end, b.end)};
}

/// Keeps the samples from `start_s` after the begin of `whole` on, for `duration_s`.
template <typename Sample>
void Cut(double start_s, double duration_s, const Span& whole, std::vector<Sample>* samples) {
  const double length_s = 1e-9 * static_cast<double>(whole.end - whole.begin);
  if (start_s > length_s)
    throw InputError("start = " + YamlNumber(start_s) +
                     " s is beyond the end of the recording, which lasts " + YamlNumber(length_s) +
                     " s");
  const int64_t begin = whole.begin + std::llround(1e9 * start_s);
  int64_t end = whole.end;
  if (duration_s > 0.0 && start_s + duration_s < length_s)
    end = begin + std::llround(1e9 * duration_s);
  samples->erase(std::remove_if(samples->begin(), samples->end(),
                                [&](const Sample& s) { return s.t_ns < begin || s.t_ns > end; }),
                 samples->end());
}

void ReadPoses(const TextRequest& files, Recording* recording) {
  std::ifstream poses = Open(files.poses);
  if (IsMocapCsv(poses)) {
    MocapPoses mocap = ReadMocapCsv(poses, files.poses, files.body);
    recording->data.poses = std::move(mocap.poses);
    recording->info.marker_frame = FrameName(mocap.body, "marker");
    return;
  }
  if (!files.body.empty())
    throw InputError("body '" + files.body + "' is given, but '" + files.poses +
                     "' is no CSV of Motive or Vicon and holds one body");
  recording->data.poses = ReadPoseTable(poses, files.poses);
}

}  // namespace

TextRequest FindFiles(TextRequest request) {
  const bool is_split =
      IsPair({"imu", request.imu}, {"gyro", request.gyro}, {"accel", request.accel});
  const bool has_imu = !request.imu.empty();
  if (!request.folder.empty()) {
    if (request.poses.empty())
      request.poses = FindTable(request.folder, HasPoseHeader, "poses", "poses");
    if (!has_imu && !is_split)
      request.imu = FindTable(request.folder, HasImuHeader, "an IMU", "imu, or gyro and accel");
  }
  if (request.poses.empty()) throw InputError("poses is missing: the file of the poses");
  if (request.imu.empty() && !is_split)
    throw InputError("imu is missing: the file of the IMU (or gyro and accel)");
  return request;
}

void CutSpan(double start_s, double duration_s, SessionData* data) {
  CheckSpan(start_s, duration_s);
  Span poses = FindSpan(data->poses);
  for (ImuData& samples : data->imus) {
    Span imu = Union(FindSpan(samples.gyro), FindSpan(samples.accel));
    if (poses.begin <= imu.end && imu.begin <= poses.end) imu = poses = Union(poses, imu);
    Cut(start_s, duration_s, imu, &samples.gyro);
    Cut(start_s, duration_s, imu, &samples.accel);
  }
  Cut(start_s, duration_s, poses, &data->poses);
}

Recording ReadText(const TextRequest& request) {
  CheckSpan(request.start_s, request.duration_s);
  Recording recording = ReadFiles(FindFiles(request));
  CutSpan(request.start_s, request.duration_s, &recording.data);
  return recording;
}

Recording ReadFiles(const TextRequest& files) {
  Recording recording;
  recording.info.pose_topic = files.poses;
  recording.info.world_frame = "world";
  recording.info.marker_frame = "marker";

  if (!files.poses.empty()) ReadPoses(files, &recording);
  if (files.imu.empty() && files.gyro.empty()) {
    recording.info.imus.clear();
    return recording;
  }
  SessionData& data = recording.data;
  const bool is_split = files.imu.empty();
  const std::vector<std::string> gyros = SplitFiles(is_split ? files.gyro : files.imu);
  const std::vector<std::string> accels = SplitFiles(is_split ? files.accel : files.imu);
  if (gyros.size() != accels.size())
    throw InputError("gyro and accel name different numbers of files: " +
                     std::to_string(gyros.size()) + " and " + std::to_string(accels.size()));
  data.imus.resize(gyros.size());
  recording.info.imus.resize(gyros.size());
  for (size_t i = 0; i < gyros.size(); ++i) {
    ImuInfo& info = recording.info.imus[i];
    info.imu_frame = "imu";
    std::ifstream gyro = Open(gyros[i]);
    if (!is_split) {
      info.imu_topic = gyros[i];
      ReadImuTable(gyro, gyros[i], &data.imus[i]);
      continue;
    }
    info.gyro_topic = gyros[i];
    info.accel_topic = accels[i];
    data.imus[i].gyro = ReadGyroTable(gyro, gyros[i]);
    std::ifstream accel = Open(accels[i]);
    data.imus[i].accel = ReadAccelTable(accel, accels[i]);
  }
  return recording;
}

}  // namespace imu_pose_calib
