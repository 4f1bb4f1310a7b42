#include "imu_pose_calib/ros/io/result_yaml.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/yaml_file.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {

const char kResultHeader[] = "# imu_pose_calib: calibration of an IMU on a tracked body";

namespace {

const char kEquations[] = R"(
#
# transform: x_marker = R x_imu + p          inverse_transform: x_imu = R' x_marker + p'
# clocks:    t_pose = t_imu + time_shift     inverse: t_imu = t_pose - time_shift
#            t_pose = t_accel + time_shift - accel_delay
#            time_shift holds at clock_reference [s, imu clock] and grows by clock_drift
# smoothing: samples are means over time; pose_smoothing [s^2] is the variance of that time of
#            rotations of poses, accel_smoothing that of the accelerometer, less that of the
#            gyroscope; position_smoothing that of positions, less that of rotations
# scale:     positions of poses = pose_scale * true
# imu:       measured = matrix * true + bias; row i of accel_positions: where the accelerometer's axis i is [m]
# sigmas:    translation_std along the marker axes, rotation_std about the imu axes: R Exp(error)
# Units: m, s, rad, m/s^2. Quaternions: x, y, z, w.

)";

/// A result file that is written or read, by one description of its keys below. Errors of reading
/// name the key: "transform: rotation is missing".
class ResultFile {
 public:
  /// To write.
  ResultFile() { out_ << YAML::BeginMap; }
  /// To read.
  explicit ResultFile(const YAML::Node& root) : maps_{{root, ""}} {}

  bool reads() const { return !maps_.empty(); }

  template <typename T>
  void Value(const std::string& key, T& value) {
    if (reads())
      Read(key, Child(key), &value);
    else
      Note(key, value);
  }
  /// What is not read back.
  template <typename T>
  void Note(const std::string& key, const T& value) {
    if (reads()) return;
    Key(key);
    Write(value);
  }
  /// The same of all that `fill` describes.
  template <typename Fill>
  void Notes(Fill fill) {
    if (!reads()) fill();
  }
  template <typename T>
  void WithStd(const std::string& key, T& value, T& std_dev) {
    Value(key, value);
    Value(key + "_std", std_dev);
  }
  /// A value that is written on a condition. Whether there is one.
  bool Optional(const std::string& key, bool is_written, std::string* value) {
    const bool is_there = reads() ? static_cast<bool>(maps_.back().node[key]) : is_written;
    if (is_there) Value(key, *value);
    return is_there;
  }

  /// A map over several lines or in one, YAML::Flow.
  template <typename Fill>
  void Map(const std::string& key, Fill fill, YAML::EMITTER_MANIP style = YAML::Block) {
    if (!reads()) {
      Key(key);
      return WriteMap(style, fill);
    }
    const YAML::Node map = Child(key);
    if (!map.IsMap()) Fail(key, "must be a map");
    ReadMap(map, key, fill);
  }
  /// A list of maps, one for each element; `fill(k)` describes what is in one. Elements that there
  /// are not yet are added.
  template <typename T, typename Fill>
  void Maps(const std::string& key, std::vector<T>* elements, Fill fill,
            YAML::EMITTER_MANIP style = YAML::Block) {
    size_t k = 0;
    const auto fill_next = [&] { fill(k++); };
    if (!reads()) {
      Key(key);
      out_ << (elements->empty() ? YAML::Flow : YAML::Block) << YAML::BeginSeq;
      while (k < elements->size()) WriteMap(style, fill_next);
      out_ << YAML::EndSeq;
      return;
    }
    for (const YAML::Node& map : Child(key)) {
      if (!map.IsMap()) Fail(key, "must be a list of maps");
      if (k == elements->size()) elements->emplace_back();
      ReadMap(map, key + ": " + std::to_string(k), fill_next);
    }
    if (k == 0) Fail(key, "is empty");
  }

  std::string Finish() {
    out_ << YAML::EndMap;
    return out_.c_str();
  }

  [[noreturn]] void Fail(const std::string& key, const std::string& what) const {
    throw InputError(maps_.back().name + key + " " + what);
  }

 private:
  // --- Writing ---

  void Key(const std::string& key) { out_ << YAML::Key << key << YAML::Value; }
  template <typename Fill>
  void WriteMap(YAML::EMITTER_MANIP style, Fill fill) {
    out_ << style << YAML::BeginMap;
    fill();
    out_ << YAML::EndMap;
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

  YAML::Node Child(const std::string& key) const {
    const YAML::Node child = maps_.back().node[key];
    if (!child) Fail(key, "is missing");
    return child;
  }
  template <typename Fill>
  void ReadMap(const YAML::Node& map, const std::string& key, Fill fill) {
    maps_.push_back({map, maps_.back().name + key + ": "});
    fill();
    maps_.pop_back();
  }

  template <typename Number>
  void Read(const std::string& key, const YAML::Node& node, Number* value) const {
    if (!node.IsScalar() || !YAML::convert<Number>::decode(node, *value) || !std::isfinite(*value))
      Fail(key, "must hold finite numbers");
  }
  void Read(const std::string& key, const YAML::Node& node, std::string* value) const {
    if (!node.IsScalar()) Fail(key, "must be a string");
    *value = node.Scalar();
  }
  void Read(const std::string& key, const YAML::Node& node, Eigen::Quaterniond* value) const {
    Read(key, node, &value->coeffs());
    if (std::abs(value->norm() - 1.0) > 1e-6) Fail(key, "must be a unit quaternion");
    value->normalize();
  }
  /// A list of numbers, or of rows.
  template <int kRows, int kColumns>
  void Read(const std::string& key, const YAML::Node& rows,
            Eigen::Matrix<double, kRows, kColumns>* value) const {
    constexpr bool kIsVector = kColumns == 1;
    const auto check = [&](const YAML::Node& list, size_t size, const char* what) {
      if (!list.IsSequence() || list.size() != size)
        Fail(key, (kIsVector ? "must be a list of " : "must have ") + std::to_string(size) + what);
    };
    check(rows, kRows, kIsVector ? " numbers" : " rows");
    for (int i = 0; i < kRows; ++i) {
      if (!kIsVector) check(rows[i], kColumns, " columns");
      for (int j = 0; j < kColumns; ++j)
        Read(key, kIsVector ? rows[i] : rows[i][j], &(*value)(i, j));
    }
  }

  struct OpenMap {
    YAML::Node node;
    std::string name;  ///< how errors begin
  };

  YAML::Emitter out_;
  std::vector<OpenMap> maps_;  ///< what is being read, and what it is in; empty: to write
};

// --- Keys ---

void Pose(Rigid3& T, ResultFile* file) {
  file->Value("translation", T.p);
  file->Value("rotation", T.q);
  file->Note("matrix", T.Matrix());
}

/// A transform of `estimate`, which states its covariance and sigmas.
template <typename Estimate>
void UncertainPose(Rigid3& T, Estimate& estimate, ResultFile* file) {
  file->Map("transform", [&] {
    Pose(T, file);
    file->Note("translation_std", estimate.Std().template head<3>());
    file->Note("rotation_std", estimate.Std().template tail<3>());
    file->Value("covariance", estimate.covariance);
  });
}

void Transforms(ImuCalibration& imu, ResultFile* file) {
  UncertainPose(imu.T_MI, imu, file);
  file->Notes([&] {
    Rigid3 T_IM = imu.T_MI.Inverse();
    file->Map("inverse_transform", [&] { Pose(T_IM, file); });
  });
}

void AccelDelay(ImuCalibration& imu, ResultFile* file) {
  file->WithStd("accel_delay", imu.accel_delay, imu.accel_delay_std);
  file->Notes(
      [&] { file->WithStd("accel_smoothing", imu.accel_smoothing, imu.accel_smoothing_std); });
}

void Clock(ImuSession& imu, ResultFile* file) {
  imu.is_present = true;
  file->WithStd("clock_drift", imu.clock_drift, imu.clock_drift_std);
  file->Value("clock_reference", imu.clock_reference);
  file->Notes([&] {
    file->Map("clock", [&] {
      ClockOffsets& clock = imu.clock;
      file->Note("t", clock.t);
      file->Note("offset", clock.offset);
      file->Note("std", clock.std);
      const auto step = [&](size_t k) {
        file->Note("t", clock.steps[k].t);
        file->Note("size", clock.steps[k].size);
      };
      file->Maps("steps", &clock.steps, step, YAML::Flow);
    });
  });
}

void Intrinsics(const char* key, ImuModel* model, ImuCalibration& imu, ResultFile* file) {
  file->Map(key, [&] {
    std::string name = ToString(*model);
    file->Value("model", name);
    *model = name == ToString(ImuModel::kCalibrated) ? ImuModel::kCalibrated
                                                     : ImuModel::kScaleMisalignment;
    file->Value("gyro_matrix", imu.gyro_matrix);
    file->Note("gyro_matrix_std", imu.gyro_matrix_std);
    file->Value("accel_matrix", imu.accel_matrix);
    file->Note("accel_matrix_std", imu.accel_matrix_std);
    Eigen::Matrix3d places = imu.accel_positions.transpose();
    file->Value("accel_positions", places);
    imu.accel_positions = places.transpose();
    file->Note("accel_positions_std", imu.accel_positions_std.transpose());
  });
}

void Biases(ImuSession& imu, ResultFile* file) {
  file->Map("biases", [&] {
    file->Value("gyro", imu.gyro_bias);
    file->Value("accel", imu.accel_bias);
    file->Note("gyro_std", imu.gyro_bias_std);
    file->Note("accel_std", imu.accel_bias_std);
  });
}

void Gravity(SessionCalibration& session, ResultFile* file) {
  file->Map("gravity", [&] {
    file->Value("vector", session.g_W);
    file->Note("std", session.g_W_std);
    file->Note("magnitude", session.g_W.norm());
  });
}

void ImuNoise(ImuSession& imu, ResultFile* file) {
  file->Value("gyro_std", imu.noise.gyro);
  file->Value("accel_std", imu.noise.accel);
}

std::string ImuName(size_t imu) { return "imu" + std::to_string(imu); }

Status ToUsable(const std::string& name, const ResultFile& file) {
  for (const Status status : {Status::kOk, Status::kWeak})
    if (name == ToString(status)) return status;
  file.Fail("status", "is '" + name + "'; only a result that is ok or weak can be used");
}

/// Run, frames, and the estimate of the first IMU in the first session.
void Estimate(const RunInfo& run, StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  SessionCalibration& session = result.sessions[0];
  RecordingInfo& info = stored->infos[0];
  file->Map("imu_pose_calib", [&] {
    file->Value("version", stored->version);
    file->Note("method", ToString(result.method));
    std::string status = ToString(result.status);
    file->Value("status", status);
    if (file->reads()) result.status = ToUsable(status, *file);
    file->Value("message", result.message);
    file->Note("date", UtcText(std::time(nullptr), "%Y-%m-%dT%H:%M:%SZ"));
    file->Optional("run_id", !stored->run_id.empty(), &stored->run_id);
    if (!run.files.empty()) file->Note("files", run.files);
  });
  file->Map("frames", [&] {
    file->Value("world", info.world_frame);
    file->Value("marker", info.marker_frame);
    file->Value("imu", info.imus[0].imu_frame);
  });
  Transforms(result.imus[0], file);
  file->WithStd("time_shift", session.imus[0].time_shift, session.imus[0].time_shift_std);
  AccelDelay(result.imus[0], file);
  Clock(session.imus[0], file);
  file->Notes([&] {
    file->WithStd("pose_smoothing", result.pose_smoothing, result.pose_smoothing_std);
    file->WithStd("position_smoothing", result.position_smoothing, result.position_smoothing_std);
    file->WithStd("pose_scale", result.pose_scale, result.pose_scale_std);
  });
  Gravity(session, file);
  Biases(session.imus[0], file);
  Intrinsics("imu", &result.imu_model, result.imus[0], file);
}

/// All IMUs; their names.
std::vector<std::string> Imus(StoredResult* stored, ResultFile* file) {
  Calibration& result = stored->result;
  std::vector<ImuInfo>& infos = stored->infos[0].imus;
  std::vector<std::string> names;
  if (file->reads()) infos.clear();
  file->Maps("imus", &result.imus, [&](size_t i) {
    if (file->reads()) infos.emplace_back();
    names.push_back(ImuName(i));
    file->Value("name", names[i]);
    std::string topic = infos[i].GyroSource();
    file->Value("topic", topic);
    const bool is_split =
        file->Optional("accel_topic", infos[i].imu_topic.empty(), &infos[i].accel_topic);
    (is_split ? infos[i].gyro_topic : infos[i].imu_topic) = topic;
    file->Value("frame", infos[i].imu_frame);
    Transforms(result.imus[i], file);
    AccelDelay(result.imus[i], file);
    Intrinsics("intrinsics", &result.imu_model, result.imus[i], file);
  });
  file->Notes([&] {
    file->Maps("between_imus", &result.between_imus, [&](size_t k) {
      BetweenImus& between = result.between_imus[k];
      file->Note("first", ImuName(between.first));
      file->Note("second", ImuName(between.second));
      UncertainPose(between.T, between, file);
    });
  });
  return names;
}

/// What a session says alone, and how that agrees with the others.
void Own(SessionCalibration& session, ResultFile* file) {
  file->Map("own", [&] {
    OwnEstimate& own = session.own;
    file->Note("imu", ImuName(own.imu));
    file->Note("translation", own.T_MI.p);
    file->Note("translation_std", own.std.head<3>());
    file->Note("rotation", own.T_MI.q);
    file->Note("rotation_std", own.std.tail<3>());
    file->WithStd("time_shift", own.time_shift, own.time_shift_std);
    file->WithStd("accel_delay", own.accel_delay, own.accel_delay_std);
  });
  char sigmas[32];
  std::snprintf(sigmas, sizeof(sigmas), ", %.1f sigma", session.agreement.sigmas);
  file->Map("agreement", [&] {
    file->Note("chi2", session.agreement.chi2);
    file->Note("dof", static_cast<size_t>(session.agreement.dof));
    file->Note("worst", session.agreement.worst + sigmas);
  });
}

/// All sessions, with what is of their IMUs, which are called by their names.
void Sessions(const std::vector<std::string>& names, StoredResult* stored, ResultFile* file) {
  std::vector<SessionCalibration>& sessions = stored->result.sessions;
  file->Maps("sessions", &sessions, [&](size_t s) {
    SessionCalibration& session = sessions[s];
    if (file->reads()) {
      session.imus.assign(names.size(), {});
      if (s > 0) stored->infos.push_back(stored->infos.front());
    }
    RecordingInfo& info = stored->infos[s];
    std::string source = info.Source();
    file->Value("source", source);
    if (file->reads()) info.bag = source;
    file->Value("world", info.world_frame);
    std::vector<size_t> present;  // places
    for (size_t i = 0; i < session.imus.size(); ++i)
      if (session.imus[i].is_present) present.push_back(i);
    file->Maps("imus", &present, [&](size_t k) {
      std::string name = ImuName(present[k]);
      file->Value("name", name);
      if (file->reads()) {
        present[k] = std::find(names.begin(), names.end(), name) - names.begin();
        if (present[k] == names.size()) file->Fail("name", "is not among the imus");
      }
      ImuSession& imu = session.imus[present[k]];
      file->WithStd("time_shift", imu.time_shift, imu.time_shift_std);
      Clock(imu, file);
      Biases(imu, file);
      file->Map("noise", [&] { ImuNoise(imu, file); });
      file->Map("rates", [&] {
        file->Value("gyro", imu.gyro.rate_hz);
        file->Value("accel", imu.accel.rate_hz);
      });
    });
    Gravity(session, file);
    if (!file->reads() && sessions.size() > 1) Own(session, file);
  });
}

/// Of the first session.
void Noise(SessionCalibration& session, ResultFile* file) {
  file->Map("noise", [&] {
    file->Value("position_std", session.noise.position);
    file->Value("rotation_std", session.noise.rotation);
    file->Note("rotation_error_std", session.rotation_error_std);
    ImuNoise(session.imus[0], file);
  });
}

void Quality(Calibration& result, ResultFile* file) {
  SessionCalibration& session = result.sessions[0];
  file->Map("quality", [&] {
    file->Note("gyro_rms", session.imus[0].rms.gyro);
    file->Note("accel_rms", session.imus[0].rms.accel);
    file->Note("position_rms", session.rms.position);
    file->Note("rotation_rms", session.rms.rotation);
    const auto direction = [&](size_t k) {
      const Observability& o = result.observability[k];
      file->Note("direction", o.direction);
      file->Note("std", o.std);
      file->Note("unit", o.unit);
      file->Note("status", ToString(o.status));
    };
    file->Maps("observability", &result.observability, direction, YAML::Flow);
    file->Map("split_half", [&] {
      file->Note("translation", result.split_half.translation);
      file->Note("rotation", result.split_half.rotation);
      file->Note("time_shift", result.split_half.time_shift);
      file->Note("sigmas", result.split_half.sigmas);
    });
    file->Note("warnings", result.warnings);
  });
  file->Map("trajectory", [&] {
    file->Note("position_lengthscale_s", session.position_lengthscale_s);
    file->Note("rotation_lengthscale_s", session.rotation_lengthscale_s);
    file->Note("knot_spacing_s", session.knot_spacing_s);
    file->Note("segments", session.segments);
  });
}

/// `key: {poses, gyro, accel}` of one member of the reports.
template <typename T>
void PerStream(const char* key, SessionCalibration& session, T StreamReport::*member,
               ResultFile* file) {
  const auto streams = [&] {
    file->Value("poses", session.poses.*member);
    file->Value("gyro", session.imus[0].gyro.*member);
    file->Value("accel", session.imus[0].accel.*member);
  };
  file->Map(key, streams, YAML::Flow);
}

void Rejected(const char* key, const StreamReport& report, ResultFile* file) {
  const auto counts = [&] {
    file->Note("not_finite", report.not_finite);
    file->Note("zero_quaternion", report.zero_quaternion);
    file->Note("reversed_stamp", report.reversed_stamp);
    file->Note("duplicate_stamp", report.duplicate_stamp);
    file->Note("repeated_value", report.repeated_value);
    file->Note("saturated", report.saturated);
    file->Note("outlier", report.outlier);
    file->Note("flipped", report.flipped);
    file->Note("in_short_segment", report.in_short_segment);
    file->Note("between_updates", report.between_updates);
  };
  file->Map(key, counts, YAML::Flow);
}

void DataCounts(SessionCalibration& session, ResultFile* file) {
  PerStream("stamps_recovered", session, &StreamReport::stamps_recovered, file);
  PerStream("stamp_jitter", session, &StreamReport::stamp_jitter_s, file);
  file->Map("rejected", [&] {
    Rejected("poses", session.poses, file);
    Rejected("gyro", session.imus[0].gyro, file);
    Rejected("accel", session.imus[0].accel, file);
  });
  file->Note("gaps", session.gaps);
  file->Note("jumps", session.jumps);
}

/// The recording of the first session.
void Data(SessionCalibration& session, RecordingInfo& info, ResultFile* file) {
  file->Map("data", [&] {
    file->Value("bag", info.bag);
    file->Value("imu_topic", info.imus[0].imu_topic);
    file->Value("gyro_topic", info.imus[0].gyro_topic);
    file->Value("accel_topic", info.imus[0].accel_topic);
    file->Value("pose_topic", info.pose_topic);
    file->Note("imu_yaml", info.imu_yaml);
    if (const auto& stated = info.stated_pose_std; stated) {
      const auto sigmas = [&] {
        file->Note("position", stated->position);
        file->Note("rotation", stated->rotation);
      };
      file->Map("stated_pose_std", sigmas, YAML::Flow);
    }
    file->Value("duration", session.poses.duration_s);
    file->Notes([&] { PerStream("counts", session, &StreamReport::used, file); });
    PerStream("rates", session, &StreamReport::rate_hz, file);
    file->Notes([&] { DataCounts(session, file); });
  });
}

}  // namespace

std::string ToYaml(const Calibration& result, const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options, const RunInfo& run) {
  StoredResult stored{"", kVersion, run.id, result, infos, {}};
  SessionCalibration& first = stored.result.sessions[0];
  ResultFile out;
  Estimate(run, &stored, &out);
  if (result.imus.size() > 1 || result.sessions.size() > 1)
    Sessions(Imus(&stored, &out), &stored, &out);
  Noise(first, &out);
  Quality(stored.result, &out);
  Data(first, stored.infos[0], &out);
  out.Note("options", YAML::Load(ToYaml(options)));
  return kResultHeader + std::string(kEquations) + out.Finish() + "\n";
}

const ImuSession& StoredResult::Clock(size_t imu) const {
  for (const SessionCalibration& session : result.sessions)
    if (session.imus[imu].is_present) return session.imus[imu];
  throw InputError("imus: " + std::to_string(imu) + " is in no session");
}

StoredResult ParseResult(const std::string& yaml, const std::string& path) {
  const YAML::Node root = ParseYaml(yaml);
  if (!root.IsMap() || !root["imu_pose_calib"])
    throw InputError("is not a result of calibrate_bag: it has no key imu_pose_calib");
  StoredResult stored;
  stored.path = path;
  stored.infos.resize(1);
  SessionCalibration& first = stored.result.sessions[0];
  ResultFile file(root);
  Estimate({}, &stored, &file);
  Noise(first, &file);
  Data(first, stored.infos[0], &file);
  if (root["sessions"]) Sessions(Imus(&stored, &file), &stored, &file);
  file.Map("options", [&] {
    file.Value("gyro_bias_walk", stored.options.gyro_bias_walk);
    file.Value("accel_bias_walk", stored.options.accel_bias_walk);
  });
  return stored;
}

StoredResult LoadResult(const std::string& path) {
  const auto parse = [&path](const std::string& yaml) { return ParseResult(yaml, path); };
  return LoadYaml("result", path, parse);
}

}  // namespace imu_pose_calib
