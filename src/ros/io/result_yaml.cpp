#include "imu_pose_calib/ros/io/result_yaml.h"

#include <yaml-cpp/yaml.h>

#include <cstdio>
#include <ctime>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/ros_options.h"
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

/// Writes the values of a map with their keys.
class Writer {
 public:
  Writer() { out_ << YAML::BeginMap; }

  template <typename Value>
  void Put(const char* key, const Value& value) {
    Key(key);
    Write(value);
  }
  template <typename Value>
  void PutWithStd(const std::string& key, const Value& value, const Value& std_dev) {
    Put(key.c_str(), value);
    Put((key + "_std").c_str(), std_dev);
  }

  /// A map over several lines; `fill` puts what is in it.
  template <typename Fill>
  void Map(const char* key, Fill fill) {
    Key(key);
    FillMap(YAML::Block, fill);
  }
  /// A map in one line.
  template <typename Fill>
  void FlowMap(const char* key, Fill fill) {
    Key(key);
    FillMap(YAML::Flow, fill);
  }
  /// A list of maps in this style; `fill(k)` puts what is in one.
  template <typename Fill>
  void Maps(const char* key, YAML::EMITTER_MANIP style, size_t count, Fill fill) {
    Key(key);
    if (count == 0) out_ << YAML::Flow;
    out_ << YAML::BeginSeq;
    for (size_t k = 0; k < count; ++k) FillMap(style, [&] { fill(k); });
    out_ << YAML::EndSeq;
  }

  std::string Finish() {
    out_ << YAML::EndMap;
    return out_.c_str();
  }

 private:
  void Key(const char* key) { out_ << YAML::Key << key << YAML::Value; }

  template <typename Fill>
  void FillMap(YAML::EMITTER_MANIP style, Fill fill) {
    out_ << style << YAML::BeginMap;
    fill();
    out_ << YAML::EndMap;
  }

  void Write(double value) { out_ << YamlNumber(value); }
  void Write(size_t value) { out_ << value; }
  void Write(bool value) { out_ << value; }
  void Write(const char* value) { out_ << YAML::DoubleQuoted << value; }
  void Write(const std::string& value) { out_ << YAML::DoubleQuoted << value; }
  void Write(const YAML::Node& value) { out_ << value; }
  void Write(const std::vector<std::string>& values) {
    if (values.empty()) out_ << YAML::Flow;
    out_ << YAML::BeginSeq;
    for (const std::string& value : values) Write(value);
    out_ << YAML::EndSeq;
  }
  void Write(const std::vector<double>& values) {
    out_ << YAML::Flow << YAML::BeginSeq;
    for (const double value : values) Write(value);
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

  YAML::Emitter out_;
};

std::string UtcNow() {
  const std::time_t now = std::time(nullptr);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%SZ", std::gmtime(&now));
  return text;
}

std::string ImuName(size_t imu) { return "imu" + std::to_string(imu); }

void PutRejected(const char* key, const StreamReport& report, Writer* out) {
  out->FlowMap(key, [&] {
    out->Put("not_finite", report.not_finite);
    out->Put("zero_quaternion", report.zero_quaternion);
    out->Put("reversed_stamp", report.reversed_stamp);
    out->Put("duplicate_stamp", report.duplicate_stamp);
    out->Put("repeated_value", report.repeated_value);
    out->Put("saturated", report.saturated);
    out->Put("outlier", report.outlier);
    out->Put("flipped", report.flipped);
    out->Put("in_short_segment", report.in_short_segment);
    out->Put("between_updates", report.between_updates);
  });
}

/// `key: {poses, gyro, accel}` of one member of the reports.
template <typename T>
void PutPerStream(const char* key, const SessionCalibration& session, T StreamReport::*member,
                  Writer* out) {
  out->FlowMap(key, [&] {
    out->Put("poses", session.poses.*member);
    out->Put("gyro", session.imus[0].gyro.*member);
    out->Put("accel", session.imus[0].accel.*member);
  });
}

void PutTransform(const Rigid3& T, Writer* out) {
  out->Put("translation", T.p);
  out->Put("rotation", T.q.coeffs());
  out->Put("matrix", T.Matrix());
}

/// A transform of `estimate`, which states its covariance and sigmas.
template <typename Estimate>
void PutUncertainTransform(const Rigid3& T, const Estimate& estimate, Writer* out) {
  out->Map("transform", [&] {
    PutTransform(T, out);
    out->Put("translation_std", estimate.Std().template head<3>());
    out->Put("rotation_std", estimate.Std().template tail<3>());
    out->Put("covariance", estimate.covariance);
  });
}

void PutTransforms(const ImuCalibration& imu, Writer* out) {
  PutUncertainTransform(imu.T_MI, imu, out);
  out->Map("inverse_transform", [&] { PutTransform(imu.T_MI.Inverse(), out); });
}

void PutAccelDelay(const ImuCalibration& imu, Writer* out) {
  out->PutWithStd("accel_delay", imu.accel_delay, imu.accel_delay_std);
  out->PutWithStd("accel_smoothing", imu.accel_smoothing, imu.accel_smoothing_std);
}

void PutClockDrift(const ImuSession& imu, Writer* out) {
  out->PutWithStd("clock_drift", imu.clock_drift, imu.clock_drift_std);
  out->Put("clock_reference", imu.clock_reference);
  out->Map("clock", [&] {
    out->Put("t", imu.clock.t);
    out->Put("offset", imu.clock.offset);
    out->Put("std", imu.clock.std);
    out->Maps("steps", YAML::Flow, imu.clock.steps.size(), [&](size_t k) {
      out->Put("t", imu.clock.steps[k].t);
      out->Put("size", imu.clock.steps[k].size);
    });
  });
}

void PutIntrinsics(const char* key, ImuModel model, const ImuCalibration& imu, Writer* out) {
  out->Map(key, [&] {
    out->Put("model", ToString(model));
    out->PutWithStd("gyro_matrix", imu.gyro_matrix, imu.gyro_matrix_std);
    out->PutWithStd("accel_matrix", imu.accel_matrix, imu.accel_matrix_std);
    out->Put("accel_positions", imu.accel_positions.transpose());
    out->Put("accel_positions_std", imu.accel_positions_std.transpose());
  });
}

void PutBiases(const ImuSession& imu, Writer* out) {
  out->Map("biases", [&] {
    out->Put("gyro", imu.gyro_bias);
    out->Put("accel", imu.accel_bias);
    out->Put("gyro_std", imu.gyro_bias_std);
    out->Put("accel_std", imu.accel_bias_std);
  });
}

void PutGravity(const SessionCalibration& session, Writer* out) {
  out->Map("gravity", [&] {
    out->Put("vector", session.g_W);
    out->Put("std", session.g_W_std);
    out->Put("magnitude", session.g_W.norm());
  });
}

void PutImuNoise(const ImuSession& imu, Writer* out) {
  out->Put("gyro_std", imu.noise.gyro);
  out->Put("accel_std", imu.noise.accel);
}

void PutImus(const Calibration& result, const RecordingInfo& info, Writer* out) {
  out->Maps("imus", YAML::Block, result.imus.size(), [&](size_t i) {
    out->Put("name", ImuName(i));
    out->Put("topic", info.imus[i].GyroSource());
    if (info.imus[i].imu_topic.empty()) out->Put("accel_topic", info.imus[i].accel_topic);
    out->Put("frame", info.imus[i].imu_frame);
    PutTransforms(result.imus[i], out);
    PutAccelDelay(result.imus[i], out);
    PutIntrinsics("intrinsics", result.imu_model, result.imus[i], out);
  });
  out->Maps("between_imus", YAML::Block, result.between_imus.size(), [&](size_t k) {
    const BetweenImus& between = result.between_imus[k];
    out->Put("first", ImuName(between.first));
    out->Put("second", ImuName(between.second));
    PutUncertainTransform(between.T, between, out);
  });
}

void PutOwn(const SessionCalibration& session, Writer* out) {
  out->Map("own", [&] {
    const OwnEstimate& own = session.own;
    out->Put("imu", ImuName(own.imu));
    out->Put("translation", own.T_MI.p);
    out->Put("translation_std", own.std.head<3>());
    out->Put("rotation", own.T_MI.q.coeffs());
    out->Put("rotation_std", own.std.tail<3>());
    out->PutWithStd("time_shift", own.time_shift, own.time_shift_std);
    out->PutWithStd("accel_delay", own.accel_delay, own.accel_delay_std);
  });
  char sigmas[32];
  std::snprintf(sigmas, sizeof(sigmas), ", %.1f sigma", session.agreement.sigmas);
  out->Map("agreement", [&] {
    out->Put("chi2", session.agreement.chi2);
    out->Put("dof", static_cast<size_t>(session.agreement.dof));
    out->Put("worst", session.agreement.worst + sigmas);
  });
}

void PutSessions(const Calibration& result, const std::vector<RecordingInfo>& infos, Writer* out) {
  out->Maps("sessions", YAML::Block, result.sessions.size(), [&](size_t s) {
    const SessionCalibration& session = result.sessions[s];
    out->Put("source", infos[s].Source());
    out->Put("world", infos[s].world_frame);
    std::vector<size_t> present;
    for (size_t i = 0; i < session.imus.size(); ++i)
      if (session.imus[i].is_present) present.push_back(i);
    out->Maps("imus", YAML::Block, present.size(), [&](size_t k) {
      const ImuSession& imu = session.imus[present[k]];
      out->Put("name", ImuName(present[k]));
      out->PutWithStd("time_shift", imu.time_shift, imu.time_shift_std);
      PutClockDrift(imu, out);
      PutBiases(imu, out);
      out->Map("noise", [&] { PutImuNoise(imu, out); });
      out->Map("rates", [&] {
        out->Put("gyro", imu.gyro.rate_hz);
        out->Put("accel", imu.accel.rate_hz);
      });
    });
    PutGravity(session, out);
    if (result.sessions.size() > 1) PutOwn(session, out);
  });
}

void PutEstimate(const Calibration& result, Writer* out) {
  const ImuSession& imu = result.sessions[0].imus[0];
  PutTransforms(result.imus[0], out);
  out->PutWithStd("time_shift", imu.time_shift, imu.time_shift_std);
  PutAccelDelay(result.imus[0], out);
  PutClockDrift(imu, out);
  out->PutWithStd("pose_smoothing", result.pose_smoothing, result.pose_smoothing_std);
  out->PutWithStd("position_smoothing", result.position_smoothing, result.position_smoothing_std);
  out->PutWithStd("pose_scale", result.pose_scale, result.pose_scale_std);
  PutGravity(result.sessions[0], out);
  PutBiases(imu, out);
  PutIntrinsics("imu", result.imu_model, result.imus[0], out);
}

void PutQuality(const Calibration& result, Writer* out) {
  const SessionCalibration& session = result.sessions[0];
  out->Map("noise", [&] {
    out->Put("position_std", session.noise.position);
    out->Put("rotation_std", session.noise.rotation);
    out->Put("rotation_error_std", session.rotation_error_std);
    PutImuNoise(session.imus[0], out);
  });
  out->Map("quality", [&] {
    out->Put("gyro_rms", session.imus[0].rms.gyro);
    out->Put("accel_rms", session.imus[0].rms.accel);
    out->Put("position_rms", session.rms.position);
    out->Put("rotation_rms", session.rms.rotation);
    out->Maps("observability", YAML::Flow, result.observability.size(), [&](size_t k) {
      const Observability& o = result.observability[k];
      out->Put("direction", o.direction);
      out->Put("std", o.std);
      out->Put("unit", o.unit);
      out->Put("status", ToString(o.status));
    });
    out->Map("split_half", [&] {
      out->Put("translation", result.split_half.translation);
      out->Put("rotation", result.split_half.rotation);
      out->Put("time_shift", result.split_half.time_shift);
      out->Put("sigmas", result.split_half.sigmas);
    });
    out->Put("warnings", result.warnings);
  });
  out->Map("trajectory", [&] {
    out->Put("position_lengthscale_s", session.position_lengthscale_s);
    out->Put("rotation_lengthscale_s", session.rotation_lengthscale_s);
    out->Put("knot_spacing_s", session.knot_spacing_s);
    out->Put("segments", session.segments);
  });
}

void PutData(const SessionCalibration& session, const RecordingInfo& info, Writer* out) {
  out->Map("data", [&] {
    out->Put("bag", info.bag);
    out->Put("imu_topic", info.imus[0].imu_topic);
    out->Put("gyro_topic", info.imus[0].gyro_topic);
    out->Put("accel_topic", info.imus[0].accel_topic);
    out->Put("pose_topic", info.pose_topic);
    out->Put("imu_yaml", info.imu_yaml);
    if (info.stated_pose_std)
      out->FlowMap("stated_pose_std", [&] {
        out->Put("position", info.stated_pose_std->position);
        out->Put("rotation", info.stated_pose_std->rotation);
      });
    out->Put("duration", session.poses.duration_s);
    PutPerStream("counts", session, &StreamReport::used, out);
    PutPerStream("rates", session, &StreamReport::rate_hz, out);
    PutPerStream("stamps_recovered", session, &StreamReport::stamps_recovered, out);
    PutPerStream("stamp_jitter", session, &StreamReport::stamp_jitter_s, out);
    out->Map("rejected", [&] {
      PutRejected("poses", session.poses, out);
      PutRejected("gyro", session.imus[0].gyro, out);
      PutRejected("accel", session.imus[0].accel, out);
    });
    out->Put("gaps", session.gaps);
    out->Put("jumps", session.jumps);
  });
}

}  // namespace

std::string ToYaml(const Calibration& result, const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options, const RunInfo& run) {
  const RecordingInfo& info = infos.front();
  Writer out;
  out.Map("imu_pose_calib", [&] {
    out.Put("version", kVersion);
    out.Put("method", ToString(result.method));
    out.Put("status", ToString(result.status));
    out.Put("message", result.message);
    out.Put("date", UtcNow());
    if (!run.id.empty()) out.Put("run_id", run.id);
    if (!run.files.empty()) out.Put("files", run.files);
  });
  out.Map("frames", [&] {
    out.Put("world", info.world_frame);
    out.Put("marker", info.marker_frame);
    out.Put("imu", info.imus[0].imu_frame);
  });
  PutEstimate(result, &out);
  if (result.imus.size() > 1 || result.sessions.size() > 1) {
    PutImus(result, info, &out);
    PutSessions(result, infos, &out);
  }
  PutQuality(result, &out);
  PutData(result.sessions[0], info, &out);
  out.Put("options", YAML::Load(ToYaml(options)));
  return kResultHeader + std::string(kEquations) + out.Finish() + "\n";
}

}  // namespace imu_pose_calib
