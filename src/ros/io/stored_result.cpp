#include "imu_pose_calib/ros/io/stored_result.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

/// A map of the file and how errors call it: "transform: ".
struct Section {
  YAML::Node node;
  std::string name;

  bool Has(const char* key) const { return static_cast<bool>(node[key]); }
};

[[noreturn]] void Fail(const Section& section, const char* key, const std::string& what) {
  throw InputError(section.name + key + " " + what);
}

YAML::Node Child(const Section& section, const char* key) {
  const YAML::Node child = section.node[key];
  if (!child) Fail(section, key, "is missing");
  return child;
}

Section Map(const Section& section, const char* key) {
  const YAML::Node child = Child(section, key);
  if (!child.IsMap()) Fail(section, key, "must be a map");
  return {child, section.name + key + ": "};
}

std::vector<Section> Maps(const Section& section, const char* key) {
  std::vector<Section> maps;
  for (const YAML::Node& item : Child(section, key)) {
    maps.push_back({item, section.name + key + ": " + std::to_string(maps.size()) + ": "});
    if (!item.IsMap()) Fail(section, key, "must be a list of maps");
  }
  if (maps.empty()) Fail(section, key, "is empty");
  return maps;
}

std::string Text(const Section& section, const char* key) {
  const YAML::Node child = Child(section, key);
  if (!child.IsScalar()) Fail(section, key, "must be a string");
  return child.Scalar();
}

double ToNumber(const YAML::Node& node, const Section& section, const char* key) {
  double value = 0.0;
  if (!node.IsScalar() || !YAML::convert<double>::decode(node, value) || !std::isfinite(value))
    Fail(section, key, "must hold finite numbers");
  return value;
}

double Number(const Section& section, const char* key) {
  return ToNumber(Child(section, key), section, key);
}

template <typename Vector>
void Read(const Section& section, const char* key, Vector* vector) {
  const YAML::Node list = Child(section, key);
  if (!list.IsSequence() || static_cast<Eigen::Index>(list.size()) != vector->size())
    Fail(section, key, "must be a list of " + std::to_string(vector->size()) + " numbers");
  for (Eigen::Index i = 0; i < vector->size(); ++i)
    (*vector)[i] = ToNumber(list[static_cast<size_t>(i)], section, key);
}

template <typename Matrix>
void ReadMatrix(const Section& section, const char* key, Matrix* matrix) {
  const YAML::Node rows = Child(section, key);
  const auto size = static_cast<size_t>(matrix->rows());
  if (!rows.IsSequence() || rows.size() != size)
    Fail(section, key, "must have " + std::to_string(size) + " rows");
  for (size_t i = 0; i < size; ++i) {
    if (!rows[i].IsSequence() || rows[i].size() != size)
      Fail(section, key, "must have " + std::to_string(size) + " columns");
    for (size_t j = 0; j < size; ++j)
      (*matrix)(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j)) =
          ToNumber(rows[i][j], section, key);
  }
}

Status ReadStatus(const Section& head) {
  const std::string text = Text(head, "status");
  for (const Status status : {Status::kOk, Status::kWeak})
    if (text == ToString(status)) return status;
  Fail(head, "status", "is '" + text + "'; only a result that is ok or weak can be used");
}

ImuCalibration ReadImu(const Section& section, const Section& intrinsics) {
  ImuCalibration imu;
  const Section transform = Map(section, "transform");
  Read(transform, "translation", &imu.T_MI.p);
  Read(transform, "rotation", &imu.T_MI.q.coeffs());
  if (std::abs(imu.T_MI.q.norm() - 1.0) > 1e-6)
    Fail(transform, "rotation", "must be a unit quaternion");
  imu.T_MI.q.normalize();
  ReadMatrix(transform, "covariance", &imu.covariance);
  imu.accel_delay = Number(section, "accel_delay");
  imu.accel_delay_std = Number(section, "accel_delay_std");
  ReadMatrix(intrinsics, "gyro_matrix", &imu.gyro_matrix);
  ReadMatrix(intrinsics, "accel_matrix", &imu.accel_matrix);
  Eigen::Matrix3d places;  // rows
  ReadMatrix(intrinsics, "accel_positions", &places);
  imu.accel_positions = places.transpose();
  return imu;
}

void ReadClock(const Section& section, ImuSession* imu) {
  imu->is_present = true;
  imu->time_shift = Number(section, "time_shift");
  imu->time_shift_std = Number(section, "time_shift_std");
  imu->clock_drift = Number(section, "clock_drift");
  imu->clock_drift_std = Number(section, "clock_drift_std");
  imu->clock_reference = Number(section, "clock_reference");
  const Section biases = Map(section, "biases");
  Read(biases, "gyro", &imu->gyro_bias);
  Read(biases, "accel", &imu->accel_bias);
}

void ReadNoise(const Section& noise, const Section& rates, ImuSession* imu) {
  imu->noise = {Number(noise, "gyro_std"), Number(noise, "accel_std")};
  imu->gyro.rate_hz = Number(rates, "gyro");
  imu->accel.rate_hz = Number(rates, "accel");
}

void ReadGravity(const Section& section, SessionCalibration* session) {
  Read(Map(section, "gravity"), "vector", &session->g_W);
}

/// What is at the top: of the first IMU and the first session.
void ReadFirst(const Section& root, StoredResult* stored) {
  const Section frames = Map(root, "frames"), data = Map(root, "data");
  const Section noise = Map(root, "noise"), rates = Map(data, "rates");
  RecordingInfo info;
  info.world_frame = Text(frames, "world");
  info.marker_frame = Text(frames, "marker");
  info.imus[0].imu_frame = Text(frames, "imu");
  info.imus[0].imu_topic = Text(data, "imu_topic");
  info.imus[0].gyro_topic = Text(data, "gyro_topic");
  info.imus[0].accel_topic = Text(data, "accel_topic");
  info.pose_topic = Text(data, "pose_topic");
  info.bag = Text(data, "bag");
  stored->infos = {info};
  stored->result.imus = {ReadImu(root, Map(root, "imu"))};
  SessionCalibration session;
  ReadGravity(root, &session);
  session.noise = {Number(noise, "position_std"), Number(noise, "rotation_std")};
  session.poses.rate_hz = Number(rates, "poses");
  session.poses.duration_s = Number(data, "duration");
  ReadClock(root, &session.imus[0]);
  ReadNoise(noise, rates, &session.imus[0]);
  stored->result.sessions = {session};
}

/// Place of the IMU that a session calls by its name.
size_t Place(const Section& imu, const std::vector<std::string>& names) {
  const auto found = std::find(names.begin(), names.end(), Text(imu, "name"));
  if (found == names.end()) Fail(imu, "name", "is not among the imus");
  return static_cast<size_t>(found - names.begin());
}

/// All IMUs and sessions, when there are several.
void ReadRig(const Section& root, StoredResult* stored) {
  RecordingInfo& first = stored->infos.front();
  std::vector<std::string> names;
  stored->result.imus.clear();
  first.imus.clear();
  for (const Section& imu : Maps(root, "imus")) {
    names.push_back(Text(imu, "name"));
    stored->result.imus.push_back(ReadImu(imu, Map(imu, "intrinsics")));
    ImuInfo info;
    info.imu_frame = Text(imu, "frame");
    const bool is_split = imu.Has("accel_topic");
    (is_split ? info.gyro_topic : info.imu_topic) = Text(imu, "topic");
    if (is_split) info.accel_topic = Text(imu, "accel_topic");
    first.imus.push_back(info);
  }
  std::vector<SessionCalibration> sessions;
  for (const Section& item : Maps(root, "sessions")) {
    SessionCalibration session =
        sessions.empty() ? stored->result.sessions.front() : SessionCalibration();
    session.imus = std::vector<ImuSession>(names.size());
    ReadGravity(item, &session);
    for (const Section& imu : Maps(item, "imus")) {
      ImuSession* place = &session.imus[Place(imu, names)];
      ReadClock(imu, place);
      ReadNoise(Map(imu, "noise"), Map(imu, "rates"), place);
    }
    if (!sessions.empty()) stored->infos.push_back(first);
    stored->infos.back().bag = Text(item, "source");
    stored->infos.back().world_frame = Text(item, "world");
    sessions.push_back(session);
  }
  stored->result.sessions = sessions;
}

}  // namespace

const ImuSession& StoredResult::Clock(size_t imu) const {
  for (const SessionCalibration& session : result.sessions)
    if (session.imus[imu].is_present) return session.imus[imu];
  throw InputError("imus: " + std::to_string(imu) + " is in no session");
}

StoredResult ParseResult(const std::string& yaml, const std::string& path) {
  const Section root = {ParseYaml(yaml), ""};
  if (!root.node.IsMap() || !root.Has("imu_pose_calib"))
    throw InputError("is not a result of calibrate_bag: it has no key imu_pose_calib");
  StoredResult stored;
  stored.path = path;
  const Section head = Map(root, "imu_pose_calib");
  stored.version = Text(head, "version");
  if (head.Has("run_id")) stored.run_id = Text(head, "run_id");
  stored.result.status = ReadStatus(head);
  stored.result.message = Text(head, "message");
  const std::string model = Text(Map(root, "imu"), "model");
  stored.result.imu_model = model == ToString(ImuModel::kCalibrated) ? ImuModel::kCalibrated
                                                                     : ImuModel::kScaleMisalignment;
  ReadFirst(root, &stored);
  if (root.Has("sessions")) ReadRig(root, &stored);
  const Section options = Map(root, "options");
  stored.options.gyro_bias_walk = Number(options, "gyro_bias_walk");
  stored.options.accel_bias_walk = Number(options, "accel_bias_walk");
  return stored;
}

StoredResult LoadResult(const std::string& path) {
  const auto parse = [&path](const std::string& yaml) { return ParseResult(yaml, path); };
  return LoadYaml("result", path, parse);
}

}  // namespace imu_pose_calib
