#include "imu_pose_calib/ros/io/result_yaml.h"

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <cmath>
#include <ctime>

#include "imu_pose_calib/core/verdict/verdict.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

const char kEquations[] = R"(
#
# transform: x_marker = R x_imu + p          inverse_transform: x_imu = R' x_marker + p'
# clocks:    t_pose = t_imu + time_shift     inverse: t_imu = t_pose - time_shift
#            t_pose = t_accel + time_shift - accel_delay
#            time_shift holds at clock_reference [s, imu clock] and grows by clock_drift
# smoothing: samples are means over time; gyro_smoothing [s^2] is the variance of that time of the
#            gyroscope; accel_smoothing that of the accelerometer and pose_smoothing that of
#            rotations of poses, less the gyroscope's; position_smoothing that of positions, less
#            that of rotations; pose_cumulants are its third and fourth cumulant [s^3, s^4],
#            position_cumulants likewise; positions are position_delay [s] later than rotations
# mount:     specific force f moves the imu by mount_compliance [s^2] * f; transform is without load
# scale:     positions of poses = pose_scale * true
# imu:       measured = matrix * true + bias; row i of accel_positions: where the accelerometer's axis i is [m]
# sigmas:    translation_std along the marker axes, rotation_std about the imu axes: R Exp(error)
)";

const char kSensorEquations[] =
    R"(# pose_sensors: x_marker = R x_sensor + p   t_pose = t_sensor + time_shift, as of an imu
#            to_imus: x_imu = R x_sensor + p
#            positions in the sensor's world: scale R p_world + p, R and p of `world`, here at the
#            start t [s, clock of the poses] of each piece; they walk by drift [m, rad per sqrt(s)]
)";

const char kUnits[] = R"(# Units: m, s, rad, m/s^2. Quaternions: x, y, z, w.

)";

/// A result file that is written or read, by one description of its keys below. A key is named by
/// its path, "sessions.0.gravity.vector": numbers count the elements of a list, and "/" stands for
/// "." where a map is in one line. Errors of reading name it: "transform: rotation is missing".
class ResultFile {
 public:
  /// To write.
  ResultFile() { out_ << YAML::BeginMap; }
  /// To read.
  explicit ResultFile(const YAML::Node& root) : reads_(true), root_(root) {}

  bool reads() const { return reads_; }

  template <typename T>
  void Value(const std::string& path, T& value) {
    if (reads_)
      ReadYaml(Name(path), Find(path), &value);
    else
      Note(path, value);
  }
  /// What is not read back.
  template <typename T>
  void Note(const std::string& path, const T& value) {
    if (reads_) return;
    Open(path);
    Write(value);
  }
  template <typename T>
  void WithStd(const std::string& path, T& value, T& std_dev) {
    Value(path, value);
    Value(path + "_std", std_dev);
  }
  template <typename T>
  void NoteWithStd(const std::string& path, const T& value, const T& std_dev) {
    Note(path, value);
    Note(path + "_std", std_dev);
  }
  /// A text that is written on a condition. Whether there is one.
  bool Optional(const std::string& path, bool is_written, std::string* value) {
    const bool is_there = reads_ ? Get(path).IsDefined() : is_written;
    if (is_there) Value(path, *value);
    return is_there;
  }
  /// The number of elements of a list of maps, which is `count` when it is written; before them.
  size_t Count(const std::string& path, size_t count, bool may_be_empty = false) {
    if (!reads_) {
      if (count == 0) Note(path, std::vector<std::string>());
      return count;
    }
    const YAML::Node list = Find(path);
    for (const YAML::Node& map : list)
      if (!map.IsMap()) Fail(path, "must be a list of maps");
    if (list.size() == 0 && !may_be_empty) Fail(path, "is empty");
    return list.size();
  }

  std::string Finish() {
    Close(0);
    out_ << YAML::EndMap;
    return out_.c_str();
  }

  [[noreturn]] static void Fail(const std::string& path, const std::string& what) {
    Reject(Name(path), " ", what);
  }

 private:
  /// For errors.
  static std::string Name(const std::string& path) { return boost::join(Split(path), ": "); }
  static std::vector<std::string> Split(const std::string& path) {
    std::vector<std::string> parts;
    return boost::split(parts, path, [](char c) { return c == '.' || c == '/'; });
  }
  static bool IsIndex(const std::string& part) { return boost::all(part, boost::is_digit()); }

  // --- Writing ---

  /// Opens the maps and lists that lead to the key, and closes those that do not.
  void Open(const std::string& path) {
    const std::vector<std::string> parts = Split(path);
    size_t k = 0;
    while (k < open_.size() && k + 1 < parts.size() && open_[k].first == parts[k]) ++k;
    Close(k);
    for (; k < parts.size(); ++k) {
      if (!IsIndex(parts[k])) out_ << YAML::Key << parts[k] << YAML::Value;
      if (k + 1 == parts.size()) return;
      const bool is_list = IsIndex(parts[k + 1]);
      const bool is_line = k + 2 == parts.size() && boost::contains(path, "/");
      out_ << (is_line ? YAML::Flow : YAML::Block) << (is_list ? YAML::BeginSeq : YAML::BeginMap);
      open_.emplace_back(parts[k], is_list ? YAML::EndSeq : YAML::EndMap);
    }
  }
  void Close(size_t left) {
    for (; open_.size() > left; open_.pop_back()) out_ << open_.back().second;
  }

  void Write(double value) { out_ << YamlNumber(value); }
  void Write(size_t value) { out_ << value; }
  void Write(bool value) { out_ << value; }
  void Write(const YAML::Node& value) { out_ << value; }
  void Write(const std::string& value) { out_ << YAML::DoubleQuoted << value; }
  void Write(const char* value) { Write(std::string(value)); }
  void Write(const Eigen::Quaterniond& q) { Write(q.coeffs()); }
  void Write(const std::vector<double>& values) {
    Write(Eigen::VectorXd::Map(values.data(), static_cast<Eigen::Index>(values.size())));
  }
  void Write(const std::vector<std::string>& values) {
    out_ << (values.empty() ? YAML::Flow : YAML::Block) << YAML::BeginSeq;
    for (const std::string& value : values) Write(value);
    out_ << YAML::EndSeq;
  }
  /// A vector in one line, a matrix with a line for each row.
  template <typename Derived>
  void Write(const Eigen::MatrixBase<Derived>& matrix) {
    out_ << (Derived::IsVectorAtCompileTime ? YAML::Flow : YAML::Block) << YAML::BeginSeq;
    for (Eigen::Index row = 0; row < matrix.rows(); ++row) {
      if constexpr (Derived::IsVectorAtCompileTime)
        Write(matrix[row]);
      else
        Write(matrix.row(row).transpose());
    }
    out_ << YAML::EndSeq;
  }

  // --- Reading ---

  /// What is at the path, perhaps nothing.
  YAML::Node Get(const std::string& path) const {
    std::vector<YAML::Node> nodes{root_};
    std::string name;
    for (const std::string& part : Split(path)) {
      const YAML::Node& node = nodes.back();  // const, so that it gets no new keys
      if (!name.empty() && !node.IsDefined()) Fail(name, "is missing");
      if (!IsIndex(part) && !node.IsMap()) Fail(name, "must be a map");
      nodes.push_back(IsIndex(part) ? node[std::stoul(part)] : node[part]);
      name += (name.empty() ? "" : ".") + part;
    }
    return nodes.back();
  }
  YAML::Node Find(const std::string& path) const {
    const YAML::Node node = Get(path);
    if (!node.IsDefined()) Fail(path, "is missing");
    return node;
  }

  YAML::Emitter out_;
  std::vector<std::pair<std::string, YAML::EMITTER_MANIP>> open_;  ///< and how each is closed
  bool reads_ = false;
  YAML::Node root_;
};

// --- Keys; `at` is the path of what they are in, with a point at its end ---

std::string ImuName(size_t imu) { return "imu" + std::to_string(imu); }

/// With its covariance and sigmas, if it has any.
void Transform(const std::string& at, Rigid3& T, Matrix6d* covariance, ResultFile* file) {
  file->Value(at + "translation", T.p);
  file->Value(at + "rotation", T.q);
  file->Note(at + "matrix", T.Matrix());
  if (covariance == nullptr) return;
  const Vector6d std_dev = covariance->diagonal().cwiseSqrt();
  file->Note(at + "translation_std", std_dev.head<3>());
  file->Note(at + "rotation_std", std_dev.tail<3>());
  file->Value(at + "covariance", *covariance);
}

void Transforms(const std::string& at, ImuCalibration& imu, ResultFile* file) {
  Transform(at + "transform.", imu.T_MI, &imu.covariance, file);
  Rigid3 T_IM = imu.T_MI.Inverse();
  if (!file->reads()) Transform(at + "inverse_transform.", T_IM, nullptr, file);
}

void AccelDelay(const std::string& at, ImuCalibration& imu, ResultFile* file) {
  file->WithStd(at + "accel_delay", imu.accel_delay, imu.accel_delay_std);
  file->NoteWithStd(at + "gyro_smoothing", imu.gyro_smoothing, imu.gyro_smoothing_std);
  file->NoteWithStd(at + "accel_smoothing", imu.accel_smoothing, imu.accel_smoothing_std);
  file->NoteWithStd(at + "mount_compliance", imu.mount_compliance, imu.mount_compliance_std);
}

void Clock(const std::string& at, ImuSession& imu, ResultFile* file) {
  file->WithStd(at + "clock_drift", imu.clock_drift, imu.clock_drift_std);
  file->Value(at + "clock_reference", imu.clock_reference);
  if (file->reads()) return;
  file->Note(at + "clock.t", imu.clock.t);
  file->Note(at + "clock.offset", imu.clock.offset);
  file->Note(at + "clock.std", imu.clock.std);
  for (size_t k = 0; k < file->Count(at + "clock.steps", imu.clock.steps.size()); ++k) {
    const std::string step = at + "clock.steps." + std::to_string(k) + "/";
    file->Note(step + "t", imu.clock.steps[k].t);
    file->Note(step + "size", imu.clock.steps[k].size);
  }
}

void Gravity(const std::string& at, SessionCalibration& session, ResultFile* file) {
  file->Value(at + "gravity.vector", session.g_W);
  file->Note(at + "gravity.std", session.g_W_std);
  file->Note(at + "gravity.magnitude", session.g_W.norm());
}

void Biases(const std::string& at, ImuSession& imu, ResultFile* file) {
  file->Value(at + "biases.gyro", imu.gyro_bias);
  file->Value(at + "biases.accel", imu.accel_bias);
  file->Note(at + "biases.gyro_std", imu.gyro_bias_std);
  file->Note(at + "biases.accel_std", imu.accel_bias_std);
}

void Intrinsics(const std::string& at, ImuModel* model, ImuCalibration& imu, ResultFile* file) {
  std::string name = ToString(*model);
  file->Value(at + "model", name);
  *model = name == ToString(ImuModel::kCalibrated) ? ImuModel::kCalibrated
                                                   : ImuModel::kScaleMisalignment;
  file->Value(at + "gyro_matrix", imu.gyro_matrix);
  file->Note(at + "gyro_matrix_std", imu.gyro_matrix_std);
  file->Value(at + "accel_matrix", imu.accel_matrix);
  file->Note(at + "accel_matrix_std", imu.accel_matrix_std);
  Eigen::Matrix3d places = imu.accel_positions.transpose();
  file->Value(at + "accel_positions", places);
  imu.accel_positions = places.transpose();
  file->Note(at + "accel_positions_std", imu.accel_positions_std.transpose());
}

void Noise(const std::string& at, ImuSession& imu, ResultFile* file) {
  file->Value(at + "noise.gyro_std", imu.noise.gyro);
  file->Value(at + "noise.accel_std", imu.noise.accel);
}

Status ToStatus(const std::string& name) {
  for (const Status status : {Status::kOk, Status::kWeak, Status::kDegenerate})
    if (name == ToString(status)) return status;
  return Status::kNotRun;
}

/// The estimate of the first IMU in the first session.
void FirstImu(StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  SessionCalibration& session = result.sessions[0];
  ImuSession& imu = session.imus[0];
  file->Value("frames.imu", stored->infos[0].imus[0].imu_frame);
  Transforms("", result.imus[0], file);
  imu.is_present = true;
  file->WithStd("time_shift", imu.time_shift, imu.time_shift_std);
  AccelDelay("", result.imus[0], file);
  Clock("", imu, file);
  file->NoteWithStd("pose_smoothing", result.pose_smoothing, result.pose_smoothing_std);
  file->NoteWithStd("position_smoothing", result.position_smoothing, result.position_smoothing_std);
  file->NoteWithStd("pose_cumulants", result.pose_cumulants, result.pose_cumulants_std);
  file->NoteWithStd("position_cumulants", result.position_cumulants, result.position_cumulants_std);
  file->NoteWithStd("position_delay", result.position_delay, result.position_delay_std);
  file->NoteWithStd("pose_scale", result.pose_scale, result.pose_scale_std);
  Gravity("", session, file);
  Biases("", imu, file);
  Intrinsics("imu.", &result.imu_model, result.imus[0], file);
}

/// Run, frames, and the estimate of the first IMU, if there is one.
void First(const RunInfo& run, StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  std::string status = ToString(result.status);
  file->Value("imu_pose_calib.version", stored->version);
  file->Note("imu_pose_calib.method", ToString(result.method));
  file->Value("imu_pose_calib.status", status);
  result.status = ToStatus(status);
  if (file->reads() && !result.IsUsable())
    ResultFile::Fail("imu_pose_calib.status",
                     "is '" + status + "'; only a result that is ok or weak can be used");
  file->Value("imu_pose_calib.message", result.message);
  file->Note("imu_pose_calib.date", UtcText(std::time(nullptr), "%Y-%m-%dT%H:%M:%SZ"));
  file->Optional("imu_pose_calib.run_id", !stored->run_id.empty(), &stored->run_id);
  if (!run.files.empty()) file->Note("imu_pose_calib.files", run.files);
  file->Value("frames.world", stored->infos[0].world_frame);
  file->Value("frames.marker", stored->infos[0].marker_frame);
  if (!result.imus.empty()) FirstImu(stored, file);
}

/// All IMUs; their names.
std::vector<std::string> Imus(StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  if (result.imus.empty()) return {};
  std::vector<std::string> names(file->Count("imus", result.imus.size()));
  if (file->reads()) stored->infos[0].imus.assign(names.size(), {});
  result.imus.resize(names.size());
  for (size_t i = 0; i < names.size(); ++i) {
    const std::string at = "imus." + std::to_string(i) + ".";
    ImuInfo& info = stored->infos[0].imus[i];
    names[i] = ImuName(i);
    file->Value(at + "name", names[i]);
    std::string topic = info.GyroSource();
    file->Value(at + "topic", topic);
    const bool is_split =
        file->Optional(at + "accel_topic", info.imu_topic.empty(), &info.accel_topic);
    (is_split ? info.gyro_topic : info.imu_topic) = topic;
    file->Value(at + "frame", info.imu_frame);
    Transforms(at, result.imus[i], file);
    AccelDelay(at, result.imus[i], file);
    Intrinsics(at + "intrinsics.", &result.imu_model, result.imus[i], file);
  }
  if (file->reads()) return names;
  for (size_t k = 0; k < file->Count("between_imus", result.between_imus.size()); ++k) {
    const std::string at = "between_imus." + std::to_string(k) + ".";
    BetweenImus& between = result.between_imus[k];
    file->Note(at + "first", ImuName(between.first));
    file->Note(at + "second", ImuName(between.second));
    Transform(at + "transform.", between.T, &between.covariance, file);
  }
  return names;
}

/// What a session says alone, and how that agrees with the others.
void Own(const std::string& at, const SessionCalibration& session, ResultFile* file) {
  const OwnEstimate& own = session.own;
  file->Note(at + "own.imu", ImuName(own.imu));
  file->Note(at + "own.translation", own.T_MI.p);
  file->Note(at + "own.translation_std", own.std.head<3>());
  file->Note(at + "own.rotation", own.T_MI.q);
  file->Note(at + "own.rotation_std", own.std.tail<3>());
  file->NoteWithStd(at + "own.time_shift", own.time_shift, own.time_shift_std);
  file->NoteWithStd(at + "own.accel_delay", own.accel_delay, own.accel_delay_std);
  file->Note(at + "agreement.chi2", session.agreement.chi2);
  file->Note(at + "agreement.dof", static_cast<size_t>(session.agreement.dof));
  file->Note(at + "agreement.worst",
             session.agreement.worst + Format(", %.1f sigma", session.agreement.sigmas));
}

/// The IMUs of a session, which are called by their names.
void SessionImus(const std::string& session_at, const std::vector<std::string>& names,
                 SessionCalibration* session, ResultFile* file) {
  if (names.empty()) return session->imus.clear();
  std::vector<size_t> present;  // places; to be read
  for (size_t i = 0; i < session->imus.size(); ++i)
    if (session->imus[i].is_present) present.push_back(i);
  present.resize(file->Count(session_at + "imus", present.size()));
  if (file->reads()) session->imus.assign(names.size(), {});
  for (size_t k = 0; k < present.size(); ++k) {
    const std::string at = session_at + "imus." + std::to_string(k) + ".";
    std::string name = ImuName(present[k]);
    file->Value(at + "name", name);
    const auto place = std::find(names.begin(), names.end(), name) - names.begin();
    if (place == static_cast<std::ptrdiff_t>(names.size()))
      ResultFile::Fail(at + "name", "is not among the imus");
    ImuSession& imu = session->imus[static_cast<size_t>(place)];
    imu.is_present = true;
    file->WithStd(at + "time_shift", imu.time_shift, imu.time_shift_std);
    Clock(at, imu, file);
    Biases(at, imu, file);
    Noise(at, imu, file);
    file->Value(at + "rates.gyro", imu.gyro.rate_hz);
    file->Value(at + "rates.accel", imu.accel.rate_hz);
  }
}

void Sessions(const std::vector<std::string>& names, StoredResult* stored, ResultFile* file) {
  std::vector<SessionCalibration>& sessions = stored->result.sessions;
  sessions.resize(file->Count("sessions", sessions.size()));
  for (size_t s = 0; s < sessions.size(); ++s) {
    const std::string at = "sessions." + std::to_string(s) + ".";
    if (s == stored->infos.size()) stored->infos.push_back(stored->infos.front());
    RecordingInfo& info = stored->infos[s];
    std::string source = info.Source();
    file->Value(at + "source", source);
    if (file->reads()) info.bag = source;
    file->Value(at + "world", info.world_frame);
    SessionImus(at, names, &sessions[s], file);
    if (names.empty()) continue;
    Gravity(at, sessions[s], file);
    if (sessions.size() > 1) Own(at, sessions[s], file);
  }
}

void Rejected(const std::string& at, const StreamReport& report, ResultFile* file) {
  for (const auto& [key, words, count] : kDropReasons) file->Note(at + "/" + key, report.*count);
}

void Spectrum(const std::string& path, const std::vector<Observability>& spectrum,
              ResultFile* file) {
  if (file->reads()) return;
  for (size_t k = 0; k < file->Count(path, spectrum.size()); ++k) {
    const std::string at = path + "." + std::to_string(k) + "/";
    const Observability& o = spectrum[k];
    file->Note(at + "direction", o.direction);
    file->Note(at + "std", o.std);
    file->Note(at + "unit", o.unit);
    file->Note(at + "status", ToString(o.status));
  }
}

void Poses(const std::string& at, PoseStd& std_dev, ResultFile* file) {
  file->Value(at + "/position", std_dev.position);
  file->Value(at + "/rotation", std_dev.rotation);
}

/// A pose sensor in one session.
void SensorSession(const std::string& at, PoseSensorSession& sensor, ResultFile* file) {
  sensor.is_present = true;
  file->WithStd(at + "time_shift", sensor.time_shift, sensor.time_shift_std);
  file->WithStd(at + "clock_drift", sensor.clock_drift, sensor.clock_drift_std);
  file->Value(at + "clock_reference", sensor.clock_reference);
  file->WithStd(at + "scale", sensor.scale, sensor.scale_std);
  Poses(at + "noise", sensor.noise, file);
  Poses(at + "rms", sensor.rms, file);
  Poses(at + "drift", sensor.drift, file);
  Poses(at + "absolute_error", sensor.errors.absolute, file);
  Poses(at + "relative_error", sensor.errors.relative, file);
  std::vector<PoseSensorSession::WorldKnot> pieces;
  for (const PoseSensorSession::WorldKnot& knot : sensor.world)
    if (pieces.empty() || knot.begins_piece) pieces.push_back(knot);
  file->Note(at + "pieces", pieces.size());
  pieces.resize(file->Count(at + "world", pieces.size(), true), {0.0, {}, true});
  for (size_t k = 0; k < pieces.size(); ++k) {
    const std::string piece = at + "world." + std::to_string(k) + ".";
    file->Value(piece + "t", pieces[k].t);
    file->Value(piece + "translation", pieces[k].T_VW.p);
    file->Value(piece + "rotation", pieces[k].T_VW.q);
  }
  if (file->reads()) sensor.world = pieces;
  StreamReport& poses = sensor.poses;
  file->Value(at + "data.count", poses.used);
  file->Value(at + "data.rate", poses.rate_hz);
  file->Value(at + "data.duration", poses.duration_s);
  file->Note(at + "data.stamps_recovered", poses.stamps_recovered);
  file->Note(at + "data.stamp_jitter", poses.stamp_jitter_s);
  Rejected(at + "data.rejected", poses, file);
}

/// The sessions that have the sensor, by their numbers from 1.
void SensorSessions(const std::string& sensor_at, size_t count, PoseSensorCalibration& sensor,
                    ResultFile* file) {
  std::vector<size_t> numbers;  // to be read
  sensor.sessions.resize(count);
  for (size_t s = 0; s < count; ++s)
    if (sensor.sessions[s].is_present) numbers.push_back(s + 1);
  numbers.resize(file->Count(sensor_at + "sessions", numbers.size(), true));
  for (size_t k = 0; k < numbers.size(); ++k) {
    const std::string at = sensor_at + "sessions." + std::to_string(k) + ".";
    file->Value(at + "session", numbers[k]);
    if (numbers[k] < 1 || numbers[k] > count)
      ResultFile::Fail(at + "session", "must be from 1 to " + std::to_string(count));
    SensorSession(at, sensor.sessions[numbers[k] - 1], file);
  }
}

void PoseSensors(StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  result.pose_sensors.resize(file->Count("pose_sensors", result.pose_sensors.size()));
  for (RecordingInfo& info : stored->infos) info.pose_sensors.resize(result.pose_sensors.size());
  for (size_t k = 0; k < result.pose_sensors.size(); ++k) {
    const std::string at = "pose_sensors." + std::to_string(k) + ".";
    PoseSensorCalibration& sensor = result.pose_sensors[k];
    PoseSensorInfo& info = stored->infos[0].pose_sensors[k];
    for (const RecordingInfo& other : stored->infos)
      if (info.topic.empty()) info = other.pose_sensors[k];
    file->Value(at + "topic", info.topic);
    file->Value(at + "frame", info.frame);
    file->Value(at + "world_frame", info.world_frame);
    std::string status = ToString(sensor.status);
    file->Value(at + "status", status);
    sensor.status = ToStatus(status);
    file->Value(at + "message", sensor.message);
    Transform(at + "transform.", sensor.T_MS, &sensor.covariance, file);
    for (size_t i = 0; i < result.imus.size() && !file->reads(); ++i) {
      const std::string to_imu = at + "to_imus." + std::to_string(i) + ".";
      BetweenImus between =
          Between(result.imus[i].T_MI, result.imus[i].covariance, sensor.T_MS, sensor.covariance);
      file->Note(to_imu + "imu", ImuName(i));
      Transform(to_imu + "transform.", between.T, &between.covariance, file);
    }
    SensorSessions(at, result.sessions.size(), sensor, file);
    Spectrum(at + "observability", sensor.observability, file);
  }
}

/// Noise, quality and trajectory.
void Quality(Calibration& result, ResultFile* file) {
  SessionCalibration& session = result.sessions[0];
  const bool has_imu = !result.imus.empty();
  file->Value("noise.position_std", session.noise.position);
  file->Value("noise.rotation_std", session.noise.rotation);
  file->Note("noise.position_error_std", session.slow_errors.position);
  file->Note("noise.rotation_error_std", session.slow_errors.rotation);
  if (has_imu) {
    Noise("", session.imus[0], file);
    file->Note("quality.gyro_rms", session.imus[0].rms.gyro);
    file->Note("quality.accel_rms", session.imus[0].rms.accel);
  }
  file->Note("quality.position_rms", session.rms.position);
  file->Note("quality.rotation_rms", session.rms.rotation);
  Spectrum("quality.observability", result.observability, file);
  if (has_imu) {
    file->Note("quality.split_half.translation", result.split_half.translation);
    file->Note("quality.split_half.rotation", result.split_half.rotation);
    file->Note("quality.split_half.time_shift", result.split_half.time_shift);
    file->Note("quality.split_half.sigmas", result.split_half.sigmas);
  }
  file->Note("quality.warnings", result.warnings);
  file->Note("trajectory.position_lengthscale_s", session.position_lengthscale_s);
  file->Note("trajectory.rotation_lengthscale_s", session.rotation_lengthscale_s);
  file->Note("trajectory.knot_spacing_s", session.knot_spacing_s);
  file->Note("trajectory.segments", session.segments);
}

/// The recording of the first session.
void Data(Calibration& result, RecordingInfo& info, ResultFile* file) {
  SessionCalibration& session = result.sessions[0];
  const bool has_imu = !result.imus.empty();
  file->Value("data.bag", info.bag);
  if (has_imu) {
    file->Value("data.imu_topic", info.imus[0].imu_topic);
    file->Value("data.gyro_topic", info.imus[0].gyro_topic);
    file->Value("data.accel_topic", info.imus[0].accel_topic);
  }
  file->Value("data.pose_topic", info.pose_topic);
  if (has_imu) file->Note("data.imu_yaml", info.imu_yaml);
  if (info.stated_pose_std) Poses("data.stated_pose_std", *info.stated_pose_std, file);
  file->Value("data.duration", session.poses.duration_s);
  std::vector<std::pair<std::string, StreamReport*>> streams = {{"poses", &session.poses}};
  if (has_imu) streams.emplace_back("gyro", &session.imus[0].gyro);
  if (has_imu) streams.emplace_back("accel", &session.imus[0].accel);
  const auto note = [&](const std::string& key, auto StreamReport::*member) {
    for (const auto& [name, report] : streams) file->Note(key + "/" + name, report->*member);
  };
  note("data.counts", &StreamReport::used);
  for (const auto& [name, report] : streams) file->Value("data.rates/" + name, report->rate_hz);
  note("data.stamps_recovered", &StreamReport::stamps_recovered);
  note("data.stamp_jitter", &StreamReport::stamp_jitter_s);
  for (const auto& [name, report] : streams) Rejected("data.rejected." + name, *report, file);
  file->Note("data.gaps", session.gaps);
  file->Note("data.jumps", session.jumps);
}

}  // namespace

std::string ToYaml(const Calibration& result, const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options, const RunInfo& run) {
  StoredResult stored{"", kVersion, run.id, result, infos, {}};
  ResultFile file;
  First(run, &stored, &file);
  if (result.imus.size() > 1 || result.sessions.size() > 1)
    Sessions(Imus(&stored, &file), &stored, &file);
  if (!result.pose_sensors.empty()) PoseSensors(&stored, &file);
  Quality(stored.result, &file);
  Data(stored.result, stored.infos[0], &file);
  file.Note("options", YAML::Load(ToYaml(options)));
  return std::string(kResultHeader) + kEquations +
         (result.pose_sensors.empty() ? "" : kSensorEquations) + kUnits + file.Finish() + "\n";
}

std::string Dropped(const StreamReport& report) {
  std::string text;
  for (const auto& [key, words, count] : kDropReasons)
    if (report.*count > 0)
      text += (text.empty() ? "" : ", ") + std::to_string(report.*count) + " " + words;
  return text;
}

bool IsUsable(const PoseSensorCalibration& sensor) {
  return sensor.status == Status::kOk || sensor.status == Status::kWeak;
}

std::vector<BodyFrame> BodyFrames(const Calibration& result, const RecordingInfo& info) {
  std::vector<BodyFrame> frames;
  for (size_t i = 0; i < result.imus.size(); ++i)
    frames.push_back({info.imus[i].imu_frame, result.imus[i].T_MI});
  for (size_t k = 0; k < result.pose_sensors.size(); ++k)
    if (IsUsable(result.pose_sensors[k]))
      frames.push_back({info.pose_sensors[k].frame, result.pose_sensors[k].T_MS});
  return frames;
}

const ImuSession& StoredResult::Clock(size_t imu) const {
  for (const SessionCalibration& session : result.sessions)
    if (session.imus[imu].is_present) return session.imus[imu];
  Reject("imus: ", imu, " is in no session");
}

StoredResult ParseResult(const std::string& yaml, const std::string& path) {
  const YAML::Node root = ParseYaml(yaml);
  if (!root.IsMap() || !root["imu_pose_calib"])
    Reject("is not a result of calibrate_bag: it has no key imu_pose_calib");
  StoredResult stored;
  stored.path = path;
  stored.infos.resize(1);
  const bool has_sensors = root["pose_sensors"].IsDefined();
  if (has_sensors && !root["transform"]) {  // there is no IMU
    stored.result.imus.clear();
    stored.result.sessions[0].imus.clear();
    stored.infos[0].imus.clear();
  }
  ResultFile file(root);
  First({}, &stored, &file);
  Quality(stored.result, &file);
  Data(stored.result, stored.infos[0], &file);
  if (root["sessions"]) Sessions(Imus(&stored, &file), &stored, &file);
  if (has_sensors) PoseSensors(&stored, &file);
  file.Value("options.gyro_bias_walk", stored.options.gyro_bias_walk);
  file.Value("options.accel_bias_walk", stored.options.accel_bias_walk);
  return stored;
}

StoredResult LoadResult(const std::string& path) {
  const auto parse = [&path](const std::string& yaml) { return ParseResult(yaml, path); };
  return LoadYaml("result", path, parse);
}

}  // namespace imu_pose_calib
