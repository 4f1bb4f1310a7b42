#include "imu_pose_calib/ros/io/result_yaml.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <fstream>
#include <random>

#include "imu_pose_calib/ros/io/ros_options.h"

namespace imu_pose_calib {

const char kVersion[] = IMU_POSE_CALIB_VERSION;
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
# Units: m, s, rad, m/s^2. Quaternions: x, y, z, w.

)";

template <typename Vector>
void EmitList(const char* key, const Vector& values, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::Flow << YAML::BeginSeq;
  for (Eigen::Index i = 0; i < values.size(); ++i) *out << YamlNumber(values[i]);
  *out << YAML::EndSeq;
}

void EmitMatrix(const char* key, const Eigen::MatrixXd& matrix, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::BeginSeq;
  for (Eigen::Index row = 0; row < matrix.rows(); ++row) {
    *out << YAML::Flow << YAML::BeginSeq;
    for (Eigen::Index col = 0; col < matrix.cols(); ++col) *out << YamlNumber(matrix(row, col));
    *out << YAML::EndSeq;
  }
  *out << YAML::EndSeq;
}

void Emit(const char* key, double value, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YamlNumber(value);
}
void Emit(const char* key, size_t value, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << value;
}
void Emit(const char* key, bool value, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << value;
}
void Emit(const char* key, const char* value, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::DoubleQuoted << value;
}
void Emit(const char* key, const std::string& value, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::DoubleQuoted << value;
}
void Emit(const char* key, const std::vector<std::string>& values, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value;
  if (values.empty()) *out << YAML::Flow;
  *out << YAML::BeginSeq;
  for (const std::string& value : values) *out << YAML::DoubleQuoted << value;
  *out << YAML::EndSeq;
}

/// `key: {...}` over several lines; `emit` fills it.
template <typename EmitContent>
void EmitMap(const char* key, EmitContent emit, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::BeginMap;
  emit();
  *out << YAML::EndMap;
}

void EmitTransform(const Rigid3& T, YAML::Emitter* out) {
  EmitList("translation", T.p, out);
  EmitList("rotation", T.q.coeffs(), out);
  EmitMatrix("matrix", T.Matrix(), out);
}

std::string UtcNow() {
  const std::time_t now = std::time(nullptr);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%SZ", std::gmtime(&now));
  return text;
}

void EmitRejected(const char* key, const StreamReport& report, YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::Flow << YAML::BeginMap;
  Emit("not_finite", report.not_finite, out);
  Emit("zero_quaternion", report.zero_quaternion, out);
  Emit("reversed_stamp", report.reversed_stamp, out);
  Emit("duplicate_stamp", report.duplicate_stamp, out);
  Emit("repeated_value", report.repeated_value, out);
  Emit("saturated", report.saturated, out);
  Emit("outlier", report.outlier, out);
  Emit("flipped", report.flipped, out);
  Emit("in_short_segment", report.in_short_segment, out);
  Emit("between_updates", report.between_updates, out);
  *out << YAML::EndMap;
}

/// `key: {poses, gyro, accel}` of one member of the reports.
template <typename T>
void EmitPerStream(const char* key,
                   const Calibration& result,
                   T StreamReport::*member,
                   YAML::Emitter* out) {
  *out << YAML::Key << key << YAML::Value << YAML::Flow << YAML::BeginMap;
  Emit("poses", result.sessions[0].poses.*member, out);
  Emit("gyro", result.sessions[0].imus[0].gyro.*member, out);
  Emit("accel", result.sessions[0].imus[0].accel.*member, out);
  *out << YAML::EndMap;
}

void EmitTransforms(const ImuCalibration& imu, YAML::Emitter* out) {
  EmitMap(
      "transform",
      [&] {
        EmitTransform(imu.T_MI, out);
        EmitList("translation_std", imu.Std().head<3>(), out);
        EmitList("rotation_std", imu.Std().tail<3>(), out);
        EmitMatrix("covariance", imu.covariance, out);
      },
      out);
  EmitMap(
      "inverse_transform", [&] { EmitTransform(imu.T_MI.Inverse(), out); }, out);
}

void EmitIntrinsics(const ImuModel model, const ImuCalibration& imu, YAML::Emitter* out) {
  Emit("model", ToString(model), out);
  EmitMatrix("gyro_matrix", imu.gyro_matrix, out);
  EmitMatrix("gyro_matrix_std", imu.gyro_matrix_std, out);
  EmitMatrix("accel_matrix", imu.accel_matrix, out);
  EmitMatrix("accel_matrix_std", imu.accel_matrix_std, out);
  EmitMatrix("accel_positions", imu.accel_positions.transpose(), out);
  EmitMatrix("accel_positions_std", imu.accel_positions_std.transpose(), out);
}

void EmitBiases(const ImuSession& imu, YAML::Emitter* out) {
  EmitMap(
      "biases",
      [&] {
        EmitList("gyro", imu.gyro_bias, out);
        EmitList("accel", imu.accel_bias, out);
        EmitList("gyro_std", imu.gyro_bias_std, out);
        EmitList("accel_std", imu.accel_bias_std, out);
      },
      out);
}

void EmitGravity(const SessionCalibration& session, YAML::Emitter* out) {
  EmitMap(
      "gravity",
      [&] {
        EmitList("vector", session.g_W, out);
        EmitList("std", session.g_W_std, out);
        Emit("magnitude", session.g_W.norm(), out);
      },
      out);
}

void EmitNoise(const ImuSession& imu, YAML::Emitter* out) {
  EmitMap(
      "noise",
      [&] {
        Emit("gyro_std", imu.noise.gyro, out);
        Emit("accel_std", imu.noise.accel, out);
      },
      out);
  EmitMap(
      "rates",
      [&] {
        Emit("gyro", imu.gyro.rate_hz, out);
        Emit("accel", imu.accel.rate_hz, out);
      },
      out);
}

std::string ImuName(size_t imu) { return "imu" + std::to_string(imu); }

void EmitImus(const Calibration& result, const RecordingInfo& info, YAML::Emitter* out) {
  *out << YAML::Key << "imus" << YAML::Value << YAML::BeginSeq;
  for (size_t i = 0; i < result.imus.size(); ++i) {
    *out << YAML::BeginMap;
    Emit("name", ImuName(i), out);
    Emit("topic", info.imus[i].GyroSource(), out);
    if (info.imus[i].imu_topic.empty()) Emit("accel_topic", info.imus[i].accel_topic, out);
    Emit("frame", info.imus[i].imu_frame, out);
    EmitTransforms(result.imus[i], out);
    Emit("accel_delay", result.imus[i].accel_delay, out);
    Emit("accel_delay_std", result.imus[i].accel_delay_std, out);
    Emit("accel_smoothing", result.imus[i].accel_smoothing, out);
    Emit("accel_smoothing_std", result.imus[i].accel_smoothing_std, out);
    EmitMap(
        "intrinsics", [&] { EmitIntrinsics(result.imu_model, result.imus[i], out); }, out);
    *out << YAML::EndMap;
  }
  *out << YAML::EndSeq;
  *out << YAML::Key << "between_imus" << YAML::Value;
  if (result.between_imus.empty()) *out << YAML::Flow;
  *out << YAML::BeginSeq;
  for (const BetweenImus& between : result.between_imus) {
    *out << YAML::BeginMap;
    Emit("first", ImuName(between.first), out);
    Emit("second", ImuName(between.second), out);
    EmitMap(
        "transform",
        [&] {
          EmitTransform(between.T, out);
          EmitList("translation_std", between.Std().head<3>(), out);
          EmitList("rotation_std", between.Std().tail<3>(), out);
          EmitMatrix("covariance", between.covariance, out);
        },
        out);
    *out << YAML::EndMap;
  }
  *out << YAML::EndSeq;
}

void EmitOwn(const SessionCalibration& session, YAML::Emitter* out) {
  const OwnEstimate& own = session.own;
  EmitMap(
      "own",
      [&] {
        Emit("imu", ImuName(own.imu), out);
        EmitList("translation", own.T_MI.p, out);
        EmitList("translation_std", own.std.head<3>(), out);
        EmitList("rotation", own.T_MI.q.coeffs(), out);
        EmitList("rotation_std", own.std.tail<3>(), out);
        Emit("time_shift", own.time_shift, out);
        Emit("time_shift_std", own.time_shift_std, out);
        Emit("accel_delay", own.accel_delay, out);
        Emit("accel_delay_std", own.accel_delay_std, out);
      },
      out);
  char sigmas[32];
  std::snprintf(sigmas, sizeof(sigmas), ", %.1f sigma", session.agreement.sigmas);
  EmitMap(
      "agreement",
      [&] {
        Emit("chi2", session.agreement.chi2, out);
        Emit("dof", static_cast<size_t>(session.agreement.dof), out);
        Emit("worst", session.agreement.worst + sigmas, out);
      },
      out);
}

void EmitSessions(const Calibration& result,
                  const std::vector<RecordingInfo>& infos,
                  YAML::Emitter* out) {
  *out << YAML::Key << "sessions" << YAML::Value << YAML::BeginSeq;
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const SessionCalibration& session = result.sessions[s];
    *out << YAML::BeginMap;
    Emit("source", infos[s].Source(), out);
    Emit("world", infos[s].world_frame, out);
    *out << YAML::Key << "imus" << YAML::Value << YAML::BeginSeq;
    for (size_t i = 0; i < session.imus.size(); ++i) {
      const ImuSession& imu = session.imus[i];
      if (!imu.is_present) continue;
      *out << YAML::BeginMap;
      Emit("name", ImuName(i), out);
      Emit("time_shift", imu.time_shift, out);
      Emit("time_shift_std", imu.time_shift_std, out);
      Emit("clock_drift", imu.clock_drift, out);
      Emit("clock_drift_std", imu.clock_drift_std, out);
      Emit("clock_reference", imu.clock_reference, out);
      EmitBiases(imu, out);
      EmitNoise(imu, out);
      *out << YAML::EndMap;
    }
    *out << YAML::EndSeq;
    EmitGravity(session, out);
    if (result.sessions.size() > 1) EmitOwn(session, out);
    *out << YAML::EndMap;
  }
  *out << YAML::EndSeq;
}

void EmitEstimate(const Calibration& result, YAML::Emitter* out) {
  EmitTransforms(result.imus[0], out);
  Emit("time_shift", result.sessions[0].imus[0].time_shift, out);
  Emit("time_shift_std", result.sessions[0].imus[0].time_shift_std, out);
  Emit("accel_delay", result.imus[0].accel_delay, out);
  Emit("accel_delay_std", result.imus[0].accel_delay_std, out);
  Emit("accel_smoothing", result.imus[0].accel_smoothing, out);
  Emit("accel_smoothing_std", result.imus[0].accel_smoothing_std, out);
  Emit("clock_drift", result.sessions[0].imus[0].clock_drift, out);
  Emit("clock_drift_std", result.sessions[0].imus[0].clock_drift_std, out);
  Emit("clock_reference", result.sessions[0].imus[0].clock_reference, out);
  Emit("pose_smoothing", result.pose_smoothing, out);
  Emit("pose_smoothing_std", result.pose_smoothing_std, out);
  Emit("position_smoothing", result.position_smoothing, out);
  Emit("position_smoothing_std", result.position_smoothing_std, out);
  Emit("pose_scale", result.pose_scale, out);
  Emit("pose_scale_std", result.pose_scale_std, out);
  EmitGravity(result.sessions[0], out);
  EmitBiases(result.sessions[0].imus[0], out);
  EmitMap(
      "imu", [&] { EmitIntrinsics(result.imu_model, result.imus[0], out); }, out);
}

void EmitObservability(const std::vector<Observability>& observability, YAML::Emitter* out) {
  *out << YAML::Key << "observability" << YAML::Value << YAML::BeginSeq;
  for (const Observability& o : observability) {
    *out << YAML::Flow << YAML::BeginMap;
    Emit("direction", o.direction, out);
    Emit("std", o.std, out);
    Emit("unit", o.unit, out);
    Emit("status", ToString(o.status), out);
    *out << YAML::EndMap;
  }
  *out << YAML::EndSeq;
}

void EmitQuality(const Calibration& result, YAML::Emitter* out) {
  EmitMap(
      "noise",
      [&] {
        Emit("position_std", result.sessions[0].noise.position, out);
        Emit("rotation_std", result.sessions[0].noise.rotation, out);
        Emit("gyro_std", result.sessions[0].imus[0].noise.gyro, out);
        Emit("accel_std", result.sessions[0].imus[0].noise.accel, out);
      },
      out);
  EmitMap(
      "quality",
      [&] {
        Emit("gyro_rms", result.sessions[0].imus[0].rms.gyro, out);
        Emit("accel_rms", result.sessions[0].imus[0].rms.accel, out);
        Emit("position_rms", result.sessions[0].rms.position, out);
        Emit("rotation_rms", result.sessions[0].rms.rotation, out);
        EmitObservability(result.observability, out);
        EmitMap(
            "split_half",
            [&] {
              EmitList("translation", result.split_half.translation, out);
              EmitList("rotation", result.split_half.rotation, out);
              Emit("time_shift", result.split_half.time_shift, out);
              Emit("sigmas", result.split_half.sigmas, out);
            },
            out);
        Emit("warnings", result.warnings, out);
      },
      out);
  EmitMap(
      "trajectory",
      [&] {
        Emit("position_lengthscale_s", result.sessions[0].position_lengthscale_s, out);
        Emit("rotation_lengthscale_s", result.sessions[0].rotation_lengthscale_s, out);
        Emit("knot_spacing_s", result.sessions[0].knot_spacing_s, out);
        Emit("segments", result.sessions[0].segments, out);
      },
      out);
}

void EmitStated(const PoseStd& stated, YAML::Emitter* out) {
  *out << YAML::Key << "stated_pose_std" << YAML::Value << YAML::Flow << YAML::BeginMap;
  Emit("position", stated.position, out);
  Emit("rotation", stated.rotation, out);
  *out << YAML::EndMap;
}

void EmitData(const Calibration& result, const RecordingInfo& info, YAML::Emitter* out) {
  EmitMap(
      "data",
      [&] {
        Emit("bag", info.bag, out);
        Emit("imu_topic", info.imus[0].imu_topic, out);
        Emit("gyro_topic", info.imus[0].gyro_topic, out);
        Emit("accel_topic", info.imus[0].accel_topic, out);
        Emit("pose_topic", info.pose_topic, out);
        Emit("imu_yaml", info.imu_yaml, out);
        if (info.stated_pose_std) EmitStated(*info.stated_pose_std, out);
        Emit("duration", result.sessions[0].poses.duration_s, out);
        EmitPerStream("counts", result, &StreamReport::used, out);
        EmitPerStream("rates", result, &StreamReport::rate_hz, out);
        EmitPerStream("stamps_recovered", result, &StreamReport::stamps_recovered, out);
        EmitPerStream("stamp_jitter", result, &StreamReport::stamp_jitter_s, out);
        EmitMap(
            "rejected",
            [&] {
              EmitRejected("poses", result.sessions[0].poses, out);
              EmitRejected("gyro", result.sessions[0].imus[0].gyro, out);
              EmitRejected("accel", result.sessions[0].imus[0].accel, out);
            },
            out);
        Emit("gaps", result.sessions[0].gaps, out);
        Emit("jumps", result.sessions[0].jumps, out);
      },
      out);
}

[[noreturn]] void FailToWrite(const std::string& path) {
  throw InputError("output '" + path + "' cannot be written: " + std::strerror(errno));
}

}  // namespace

std::string YamlNumber(double value) {
  if (std::isnan(value)) return ".nan";
  if (std::isinf(value)) return value > 0 ? ".inf" : "-.inf";
  char buffer[32];
  for (int digits = 15; digits <= 17; ++digits) {
    std::snprintf(buffer, sizeof(buffer), "%.*g", digits, value);
    if (std::strtod(buffer, nullptr) == value) break;
  }
  // YAML 1.1 takes "1" for an integer and "1e-05" for a string.
  std::string text = buffer;
  if (text.find('.') == std::string::npos) text.insert(std::min(text.find('e'), text.size()), ".0");
  return text;
}

std::string ToYaml(const Calibration& result,
                   const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options) {
  const RecordingInfo& info = infos.front();
  YAML::Emitter out;
  out << YAML::BeginMap;
  EmitMap(
      "imu_pose_calib",
      [&] {
        Emit("version", kVersion, &out);
        Emit("method", ToString(result.method), &out);
        Emit("status", ToString(result.status), &out);
        Emit("message", result.message, &out);
        Emit("date", UtcNow(), &out);
      },
      &out);
  EmitMap(
      "frames",
      [&] {
        Emit("world", info.world_frame, &out);
        Emit("marker", info.marker_frame, &out);
        Emit("imu", info.imus[0].imu_frame, &out);
      },
      &out);
  EmitEstimate(result, &out);
  if (result.imus.size() > 1 || result.sessions.size() > 1) {
    EmitImus(result, info, &out);
    EmitSessions(result, infos, &out);
  }
  EmitQuality(result, &out);
  EmitData(result, info, &out);
  out << YAML::Key << "options" << YAML::Value << YAML::Load(ToYaml(options));
  out << YAML::EndMap;
  return kResultHeader + std::string(kEquations) + out.c_str() + "\n";
}

void WriteFile(const std::string& path, const std::string& text) {
  // A name that nobody can foresee, and "x": only a new file will do, not a link that somebody has
  // laid to another. Unlike one of mkstemp(), it has the permissions that the umask leaves it.
  std::random_device random;
  std::string draft;
  std::FILE* file = nullptr;
  do {
    draft = path + ".tmp" + std::to_string(random());
    file = std::fopen(draft.c_str(), "wx");
  } while (!file && errno == EEXIST);
  if (!file) FailToWrite(path);
  const bool is_whole = std::fwrite(text.data(), 1, text.size(), file) == text.size();
  const bool is_closed = std::fclose(file) == 0;
  if (!is_whole || !is_closed || std::rename(draft.c_str(), path.c_str()) != 0) {
    const int reason = errno;
    std::remove(draft.c_str());
    errno = reason;
    FailToWrite(path);
  }
}

void RemoveOldResult(const std::string& path) {
  std::string first_line;
  std::getline(std::ifstream(path), first_line);
  if (first_line == kResultHeader) std::remove(path.c_str());
}

}  // namespace imu_pose_calib
