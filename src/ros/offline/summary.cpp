#include "imu_pose_calib/ros/offline/summary.h"

#include <algorithm>
#include <boost/algorithm/string/case_conv.hpp>
#include <cmath>
#include <numeric>
#include <optional>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr double kCertain = 3.0;        // sigma
constexpr double kNotableFreeze = 0.1;  // [s]
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

/// "OK: the reason".
std::string Verdict(const std::string& verdict, const std::string& message) {
  return Wrap(boost::to_upper_copy(verdict) + ": ", message);
}

/// What the covariances of the poses say, a line.
std::string Stated(const char* indent, const PoseStd& stated) {
  return Format("%stheir covariances say %.3g mm and %.3g deg per axis\n", indent,
                1e3 * stated.position, kDegrees * stated.rotation);
}

std::string Stream(const char* label, const std::string& topic, const StreamReport& report) {
  const std::string recovered =
      report.stamps_recovered ? "; stamps: recovered, jitter " + Time(report.stamp_jitter_s) : "";
  return Wrap(label, topic +
                         Format(": %zu at %.1f Hz over %.1f s", report.used, report.rate_hz,
                                report.duration_s) +
                         recovered + Dropped(report));
}

std::string Data(const SessionCalibration& session, const RecordingInfo& info) {
  std::string text = Stream("  poses  ", info.pose_topic, session.poses);
  if (info.stated_pose_std) text += Stated("         ", *info.stated_pose_std);
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const ImuSession& imu = session.imus[i];
    if (!imu.is_present) continue;
    text += Stream("  gyro   ", info.imus[i].GyroSource(), imu.gyro);
    text += Stream("  accel  ", info.imus[i].AccelSource(), imu.accel);
  }
  if (!info.imu_yaml.empty()) text += Wrap("  noise  ", info.imu_yaml);
  if (session.gaps + session.jumps > 0)
    text += Format("  %zu gaps and %zu jumps in the poses leave %zu segments\n", session.gaps,
                   session.jumps, session.segments);
  return text;
}

std::string Data(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::string text;
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const bool is_single = result.sessions.size() == 1;
    text += is_single
                ? "\nData\n"
                : "\n" + Wrap("Data of session " + std::to_string(s + 1) + ": ", infos[s].Source());
    text += Data(result.sessions[s], infos[s]);
  }
  return text;
}

std::string Vector(const Eigen::Vector3d& v, const char* number) {
  return "[" + List(v, number) + "]";
}

/// Roll, pitch, yaw about the fixed axes, as tf prints them [deg].
Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  return kDegrees * Eigen::Vector3d(std::atan2(R(2, 1), R(2, 2)),
                                    std::asin(std::clamp(-R(2, 0), -1.0, 1.0)),
                                    std::atan2(R(1, 0), R(0, 0)));
}

/// Sigmas of roll, pitch and yaw [rad]: about the imu axes, R Exp(dtheta) turns by
/// E (droll, dpitch, dyaw). Nothing where the pitch leaves the other two undetermined.
std::optional<Eigen::Vector3d> RollPitchYawStd(const ImuCalibration& imu) {
  constexpr double kNearLock = 0.1;  // cosine of the pitch, 6 deg
  const Eigen::Vector3d rpy = RollPitchYaw(imu.T_MI.q) / kDegrees;
  const double sr = std::sin(rpy.x()), cr = std::cos(rpy.x());
  const double sp = std::sin(rpy.y()), cp = std::cos(rpy.y());
  if (cp < kNearLock) return std::nullopt;
  Eigen::Matrix3d E;
  E << 1.0, 0.0, -sp, 0.0, cr, cp * sr, 0.0, -sr, cp * cr;
  const Eigen::Matrix3d inverse = E.inverse();
  return (inverse * imu.covariance.bottomRightCorner<3, 3>() * inverse.transpose())
      .diagonal()
      .cwiseSqrt();
}

/// Whether the result is in doubt for a reason that no sigma shows.
bool IsDoubted(const Calibration& result) {
  return result.status != Status::kOk &&
         std::all_of(result.observability.begin(), result.observability.end(),
                     [](const Observability& o) { return o.status == Status::kOk; });
}

/// Worst verdict of the directions whose name begins with `name`; "fixed" when there are none.
std::string RowVerdict(const Calibration& result, const std::string& name) {
  for (const Observability& o : result.observability)  // the worst first
    if (o.direction.compare(0, name.size(), name) == 0)
      return IsDoubted(result) ? "in doubt" : ToString(o.status);
  return "fixed";
}

/// A drift is told when the data tell more of it than was known before, and well when it leaves the
/// time shift well known over all of the recording.
std::string DriftVerdict(const Calibration& result) {
  constexpr double kSame = 0.9;
  const ImuSession& clock = result.sessions[0].imus[0];
  if (clock.clock_drift_std > kSame * kDriftPrior) return "prior";
  const double away = 0.5 * clock.gyro.duration_s;
  if (clock.clock_drift_std * away > CalibrationOptions().weak_time_shift_std)
    return ToString(Status::kWeak);
  return IsDoubted(result) ? "in doubt" : ToString(Status::kOk);
}

std::string Row(const std::string& name, const std::string& value, const std::string& sigma,
                const std::string& verdict) {
  return Format("  %-16s %-29s %-22s %s\n", name.c_str(), value.c_str(),
                verdict == "fixed" ? "" : sigma.c_str(), verdict.c_str());
}

/// What was dropped of all streams: "; gyro: 2 outlier".
std::string AllDropped(const SessionCalibration& session, const std::string& of) {
  std::string text;
  const auto add = [&](const std::string& stream, const StreamReport& report) {
    const std::string dropped = Dropped(report);
    if (!dropped.empty())
      text += "; " + stream + of + dropped.substr(std::string("; dropped").size());
  };
  add("poses", session.poses);
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const std::string imu = OfImu(i, session.imus.size());
    add("gyro" + imu, session.imus[i].gyro);
    add("accel" + imu, session.imus[i].accel);
  }
  return text;
}

/// So many lines at most of the warnings, with the number of those left out.
std::string FirstWarnings(const Calibration& result, size_t lines) {
  std::string text;
  size_t used = 0, shown = 0;
  for (; shown < result.warnings.size(); ++shown) {
    const std::string warning = Wrap("  warning: ", Printable(result.warnings[shown]));
    const auto size = static_cast<size_t>(std::count(warning.begin(), warning.end(), '\n'));
    const bool is_last = shown + 1 == result.warnings.size();
    if (used + size + (is_last ? 0 : 1) > lines) break;
    text += warning;
    used += size;
  }
  const size_t more = result.warnings.size() - shown;
  if (more > 0) text += Format("  %zu %swarnings: --verbose\n", more, shown > 0 ? "more " : "");
  return text;
}

/// What a person wants to know first.
std::string Table(const Calibration& result) {
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& clock = result.sessions[0].imus[0];
  const Vector6d sigma = imu.Std();
  std::string text = "\n" + Row("imu in marker", "value", "sigma", "verdict");
  text += Row("translation [mm]", List(1e3 * imu.T_MI.p, "%.3f"),
              List(1e3 * sigma.head<3>(), "%.3f"), RowVerdict(result, "p_MI"));
  const std::optional<Eigen::Vector3d> rpy_sigma = RollPitchYawStd(imu);
  text +=
      Row("rpy [deg]", List(RollPitchYaw(imu.T_MI.q), "%.3f"),
          List(kDegrees * rpy_sigma.value_or(sigma.tail<3>()), "%.4f"), RowVerdict(result, "R_MI"));
  if (!rpy_sigma)
    text += "    pitch near 90 deg: roll and yaw turn about one axis; sigma about imu x, y, z\n";
  text += Row("time shift", Format("%.7f s", clock.time_shift),
              Format("%.4f ms", 1e3 * clock.time_shift_std), RowVerdict(result, "time_shift"));
  text += Row("accel delay", Format("%.4f ms", 1e3 * imu.accel_delay),
              Format("%.4f ms", 1e3 * imu.accel_delay_std), RowVerdict(result, "accel_delay"));
  if (clock.clock_drift_std > 0.0)
    text += Row("clock drift", Format("%.2f ppm", 1e6 * clock.clock_drift),
                Format("%.2f ppm", 1e6 * clock.clock_drift_std), DriftVerdict(result));
  return text;
}

/// With several IMUs: one row for each, and their transforms to the first.
std::string ImuTable(const Calibration& result, const RecordingInfo& info) {
  const auto row = [](const std::string& name, const Rigid3& T, const Vector6d& sigma) {
    return Format("  %-6s %26s %7.3f %25s %9.4f\n", name.c_str(), List(1e3 * T.p, "%.3f").c_str(),
                  1e3 * sigma.head<3>().maxCoeff(), List(RollPitchYaw(T.q), "%.3f").c_str(),
                  kDegrees * sigma.tail<3>().maxCoeff());
  };
  const std::string units =
      Format("%26s %7s %25s %9s\n", "translation [mm]", "sigma", "rpy [deg]", "sigma");
  std::string text = "\n  in marker" + units.substr(2);
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += row("imu" + std::to_string(i), result.imus[i].T_MI, result.imus[i].Std());
  text += "  in imu0  " + units.substr(2);
  for (const BetweenImus& between : result.between_imus)
    text += row("imu" + std::to_string(between.second), between.T, between.Std());
  text += "  sigma: the largest, of translations and about the axes of the imu\n";
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += Wrap("  imu" + std::to_string(i) + ": ",
                 info.imus[i].imu_frame + ", " + info.imus[i].GyroSource() +
                     Format(", accel delay %.4f +- %.4f ms", 1e3 * result.imus[i].accel_delay,
                            1e3 * result.imus[i].accel_delay_std));
  return text;
}

/// With several sessions or IMUs: which is which, the clocks, and what a session says alone.
std::string SessionTable(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::string text = "\n  session, what it says alone less all others\n";
  if (result.sessions.size() == 1) text = "\n";
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const SessionCalibration& session = result.sessions[s];
    if (result.sessions.size() > 1) {
      text += Wrap("  " + std::to_string(s + 1) + "  ", infos[s].Source());
      text += Format("     at most %s: %.1f sigma (chi-square %.1f of %d)\n",
                     session.agreement.worst.c_str(), session.agreement.sigmas,
                     session.agreement.chi2, session.agreement.dof);
    }
    for (size_t i = 0; i < session.imus.size(); ++i)
      if (session.imus[i].is_present)
        text += Format("     time shift of imu%zu  %.7f s +- %.4f ms\n", i,
                       session.imus[i].time_shift, 1e3 * session.imus[i].time_shift_std);
  }
  return text;
}

/// One line instead of the table of the sessions.
std::string MostApart(const Calibration& result) {
  const auto most = std::max_element(result.sessions.begin(), result.sessions.end(),
                                     [](const SessionCalibration& a, const SessionCalibration& b) {
                                       return a.agreement.sigmas < b.agreement.sigmas;
                                     });
  return Format("\n  %zu sessions; farthest from the others: session %d, %s, %.1f sigma\n",
                result.sessions.size(), static_cast<int>(most - result.sessions.begin()) + 1,
                most->agreement.worst.c_str(), most->agreement.sigmas);
}

std::string Transform(const Calibration& result) {
  const auto rows = [](const Rigid3& T) {
    return "  p = " + Vector(1e3 * T.p, "%.3f") +
           " mm\n  R = " + Format("[%.6f, %.6f, %.6f, %.6f]", T.q.x(), T.q.y(), T.q.z(), T.q.w()) +
           " (x, y, z, w)\n";
  };
  const Rigid3& T = result.imus[0].T_MI;
  return "\nT_marker_imu, the imu seen from the marker: x_marker = R x_imu + p\n" + rows(T) +
         "  sigma of p along the marker axes, of R about the imu axes\n"
         "T_imu_marker, its inverse: x_imu = R x_marker + p\n" +
         rows(T.Inverse());
}

/// How far a clock is off a line, and where it steps.
std::string Wander(const ClockOffsets& clock) {
  if (!clock.wanders) return "";
  const auto count = static_cast<double>(clock.t.size());
  const auto mean = [&](const std::vector<double>& x) {
    return std::accumulate(x.begin(), x.end(), 0.0) / count;
  };
  const double t = mean(clock.t), offset = mean(clock.offset);
  double tt = 0.0, ty = 0.0, off = 0.0;
  for (size_t k = 0; k < clock.t.size(); ++k) {
    tt += std::pow(clock.t[k] - t, 2);
    ty += (clock.t[k] - t) * (clock.offset[k] - offset);
  }
  for (size_t k = 0; k < clock.t.size(); ++k)
    off = std::max(off, std::abs(clock.offset[k] - offset - ty / tt * (clock.t[k] - t)));
  std::string text =
      Format("        time_shift wanders: up to %.2f ms off a line; over time: clock in the file\n",
             1e3 * off);
  for (const ClockOffsets::Step& step : clock.steps)
    text +=
        Format("        time_shift steps by %+.2f ms at t_imu = %.3f s\n", 1e3 * step.size, step.t);
  return text;
}

std::string Clocks(const Calibration& result) {
  std::string text =
      "Clocks: t_pose = t_imu + time_shift      (inverse: t_imu = t_pose - time_shift)\n";
  text += "        t_pose = t_accel + time_shift - accel_delay\n";
  if (result.sessions[0].imus[0].clock_drift_std > 0.0)
    text += Format("        time_shift holds at t_imu = %.3f s and grows by clock drift\n",
                   result.sessions[0].imus[0].clock_reference);
  text += Wander(result.sessions[0].imus[0].clock);
  const double averaging = result.imus[0].accel_smoothing;
  if (std::abs(averaging) > kCertain * result.imus[0].accel_smoothing_std)
    text += Format("%s averages over %.1f ms more than the %s: accounted for\n",
                   averaging > 0.0 ? "Accelerometer" : "Gyroscope",
                   1e3 * std::sqrt(std::abs(averaging)),
                   averaging > 0.0 ? "gyroscope" : "accelerometer");
  const double smoothing = result.pose_smoothing;
  if (std::abs(smoothing) > kCertain * result.pose_smoothing_std) {
    const double root = std::sqrt(std::abs(smoothing));
    text += Format("%s smoothed over %.1f ms (sigma %.1f ms) more than the %s: accounted for\n",
                   smoothing > 0.0 ? "Poses" : "Imu", 1e3 * root,
                   0.5e3 * result.pose_smoothing_std / root, smoothing > 0.0 ? "imu" : "poses");
  }
  const double excess = result.position_smoothing;
  if (std::abs(excess) > kCertain * result.position_smoothing_std)
    text += Format("%s of the poses averages over %.1f ms more than their %s: accounted for\n",
                   excess > 0.0 ? "Position" : "Rotation", 1e3 * std::sqrt(std::abs(excess)),
                   excess > 0.0 ? "rotation" : "position");
  if (std::abs(result.pose_scale - 1.0) > kCertain * result.pose_scale_std)
    text += Format("Positions are too %s by %.2f %% (sigma %.2f %%): accounted for\n",
                   result.pose_scale > 1.0 ? "large" : "small",
                   100.0 * std::abs(result.pose_scale - 1.0), 100.0 * result.pose_scale_std);
  return text;
}

std::string Matrix(const char* name, const Eigen::Matrix3d& M, const Eigen::Matrix3d& sigma) {
  std::string text;
  for (int row = 0; row < 3; ++row)
    text += Format("  %-12s", row == 0 ? name : "") + Vector(M.row(row), "%9.5f") + " +- " +
            Vector(sigma.row(row), "%.5f") + "\n";
  return text;
}

std::string Imu(const Calibration& result) {
  const ImuCalibration& imu = result.imus[0];
  const SessionCalibration& session = result.sessions[0];
  std::string text = "\nGravity and mean biases\n";
  text += "  gravity    = " + Vector(session.g_W, "%.5f") + " m/s^2 in the world frame\n";
  text +=
      "  gyro bias  = " + Vector(session.imus[0].gyro_bias, "%.6f") + " rad/s in the imu frame\n";
  text +=
      "  accel bias = " + Vector(session.imus[0].accel_bias, "%.5f") + " m/s^2 in the imu frame\n";
  if (result.imu_model != ImuModel::kCalibrated) {
    text += "\nScale and misalignment: measured = M true + bias\n";
    text += Matrix("gyro M =", imu.gyro_matrix, imu.gyro_matrix_std);
    text += Matrix("accel M =", imu.accel_matrix, imu.accel_matrix_std);
  }
  if (!imu.accel_positions_std.isZero(0.0)) {
    text += "\nSize effect: places of the accelerometer's axes in the imu frame [m]\n";
    text +=
        Matrix("axes xyz =", imu.accel_positions.transpose(), imu.accel_positions_std.transpose());
  }
  return text;
}

std::string Residuals(const Calibration& result) {
  const auto row = [](const char* name, double rms, double noise, const char* unit) {
    return Format("  %-9s rms %.3g %s, noise %.3g %s\n", name, rms, unit, noise, unit);
  };
  const SessionCalibration& session = result.sessions[0];
  const ImuStd &imu_rms = session.imus[0].rms, &imu_noise = session.imus[0].noise;
  const PoseStd &rms = session.rms, &noise = session.noise;
  return "\nResiduals per axis, and the noise estimated from them\n" +
         row("gyro", imu_rms.gyro, imu_noise.gyro, "rad/s") +
         row("accel", imu_rms.accel, imu_noise.accel, "m/s^2") +
         row("position", 1e3 * rms.position, 1e3 * noise.position, "mm") +
         row("rotation", kDegrees * rms.rotation, kDegrees * noise.rotation, "deg") +
         (session.rotation_error_std > 0.0
              ? Format("  rotations of the poses err for seconds by %.3g deg\n",
                       kDegrees * session.rotation_error_std)
              : std::string()) +
         Format("  the halves of the recording differ by up to %.1f sigma\n",
                result.split_half.sigmas);
}

std::string Warnings(const Calibration& result) {
  std::string text;
  for (const std::string& direction : result.unobservable)
    text += Wrap("  undetermined: ", direction);
  for (const std::string& warning : result.warnings) text += Wrap("  warning: ", warning);
  return text.empty() ? "" : "\n" + text;
}

std::string StaticTransform(const Rigid3& T, const std::string& marker_frame,
                            const std::string& imu_frame) {
  return "\nrosrun tf2_ros static_transform_publisher \\\n" +
         Format("  %.6f %.6f %.6f %.8f %.8f %.8f %.8f \\\n", T.p.x(), T.p.y(), T.p.z(), T.q.x(),
                T.q.y(), T.q.z(), T.q.w()) +
         "  " + marker_frame + " " + imu_frame + "\n";
}

// --- Of a check of the data ---

std::string StreamRow(const char* label, const StreamCheck& stream,
                      const std::optional<Latency>& latency) {
  return Format("  %-6s%8zu%8.1f%9s%10s%8.1f%9.1f", label, stream.count, stream.rate_hz,
                Time(stream.jitter_s).c_str(), Time(stream.longest_gap_s).c_str(),
                100.0 * stream.missing, 100.0 * stream.repeated) +
         (latency
              ? Format("%12s%8s", Time(latency->median_s).c_str(), Time(latency->spread_s).c_str())
              : "") +
         "\n";
}

/// What the table does not show of a stream.
std::string Remarks(const char* label, const StreamCheck& stream, const StreamReport& report) {
  std::string text = Dropped(report);
  if (stream.longest_freeze_s > kNotableFreeze)
    text += "; no new value for up to " + Time(stream.longest_freeze_s);
  if (stream.cut_s > 0.0) text += Format("; stamps are multiples of %g ms", 1e3 * stream.cut_s);
  if (stream.stamps.recovered)
    text += "; stamps: recovered, jitter " + Time(stream.stamps.jitter_s);
  else if (!stream.stamps.even)
    text += "; stamps: uneven, as recorded";
  if (stream.bunched > 0.0) text += Format("; %.1f %% stamped in bunches", 100.0 * stream.bunched);
  return text.empty() ? "" : Wrap(label, text.substr(2));
}

std::string Streams(const DataCheck& check, const RecordingInfo& info) {
  bool has_latency = info.pose_latency.has_value();
  for (const ImuInfo& imu : info.imus)
    has_latency = has_latency || imu.gyro_latency || imu.accel_latency;
  std::string text = "\n         samples      Hz   jitter   max gap missing repeated";
  text += has_latency ? "     latency  spread\n" : "\n";
  text += "                                                %        %";
  text += has_latency ? "   (record - header)\n" : "\n";
  text += StreamRow("poses", check.poses, info.pose_latency);
  std::string topics = info.pose_topic,
              remarks = Remarks("  poses: ", check.poses, check.poses_report);
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    text += StreamRow("gyro", imu.gyro, info.imus[i].gyro_latency) +
            StreamRow("accel", imu.accel, info.imus[i].accel_latency);
    topics += ", " + info.imus[i].GyroSource();
    if (info.imus[i].imu_topic.empty()) topics += ", " + info.imus[i].accel_topic;
    remarks += Remarks("  gyro: ", imu.gyro, imu.gyro_report) +
               Remarks("  accel: ", imu.accel, imu.accel_report);
  }
  text += Wrap(info.bag.empty() ? "  files: " : "  topics: ", topics);
  if (info.stated_pose_std) text += Stated("  poses: ", *info.stated_pose_std);
  text += remarks;
  if (check.gaps + check.jumps > 0)
    text += Format("  gaps in the poses: %zu, jumps: %zu\n", check.gaps, check.jumps);
  return text;
}

std::string Match(const ImuCheck& imu) {
  if (!imu.is_matched) return "";
  return Format("  time shift   about %.4f s", imu.time_shift) +
         (std::abs(imu.time_shift) < 600.0 ? "" : " (" + Time(imu.time_shift) + ")") +
         Format("; %.1f s in common\n", imu.overlap_s) +
         Format("  clock drift  %.1f +- %.1f ppm\n", imu.drift_ppm, imu.drift_ppm_std) +
         Format("  same motion  the poses explain %.1f %% of the gyroscope's variance\n",
                100.0 * imu.explained);
}

/// What each IMU shows, under its name when there are several.
std::string Matches(const DataCheck& check) {
  std::string text;
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const std::string match = Match(check.imus[i]);
    if (check.imus.size() > 1 && !match.empty()) text += "  imu" + std::to_string(i) + "\n";
    text += match;
  }
  return text;
}

std::string Rest(const ImuCheck& imu) {
  return imu.rest_s > 0.0 ? Format("  at rest      %.1f s; the accelerometer shows %.2f m/s^2\n",
                                   imu.rest_s, imu.rest_norm)
                          : "  at rest      never, so the accelerometer's norm is unchecked\n";
}

std::string Excitation(const DataCheck& check) {
  std::string text = "  turns        " + Vector(check.turns_M, "%.2f") +
                     " rad/s rms about marker x, y, z\n" + "  moves        " +
                     Vector(check.moves_W, "%.2f") + " m/s^2 rms along world x, y, z\n";
  for (const ImuCheck& imu : check.imus) text += Rest(imu);
  return text;
}

}  // namespace

std::string Summary(const Calibration& result, const std::vector<RecordingInfo>& recordings) {
  std::vector<RecordingInfo> infos;
  for (const RecordingInfo& recording : recordings) infos.push_back(WithPrintableNames(recording));
  std::string text = Verdict(ToString(result.status), result.message);
  if (!result.IsUsable()) return text + Data(result, infos) + Warnings(result);
  const bool is_single = result.imus.size() == 1 && result.sessions.size() == 1;
  text += result.imus.size() == 1 ? Table(result) : ImuTable(result, infos.front());
  if (!is_single) text += SessionTable(result, infos);
  text += Warnings(result) + Data(result, infos) + Transform(result) + Clocks(result) +
          Imu(result) + Residuals(result);
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += StaticTransform(result.imus[i].T_MI, infos[0].marker_frame, infos[0].imus[i].imu_frame);
  return text;
}

std::string Brief(const Calibration& result, const std::vector<RecordingInfo>& recordings,
                  size_t lines) {
  std::vector<RecordingInfo> infos;
  for (const RecordingInfo& recording : recordings) infos.push_back(WithPrintableNames(recording));
  std::string text = Verdict(ToString(result.status), result.message);
  text += result.imus.size() == 1 ? Table(result) : ImuTable(result, infos.front());
  if (result.sessions.size() > 1)
    text += MostApart(result);
  else if (result.imus.size() > 1)
    text += SessionTable(result, infos);
  std::string dropped;
  for (size_t s = 0; s < result.sessions.size(); ++s)
    dropped += AllDropped(result.sessions[s], OfSession(s, result.sessions.size()));
  text += "\n" + Wrap("  dropped: ", dropped.empty() ? "no samples" : dropped.substr(2));
  std::string tf;
  for (size_t i = 0; i < result.imus.size(); ++i)
    tf += StaticTransform(result.imus[i].T_MI, infos[0].marker_frame, infos[0].imus[i].imu_frame);
  const auto used = static_cast<size_t>(std::count(text.begin(), text.end(), '\n') +
                                        std::count(tf.begin(), tf.end(), '\n'));
  return text + FirstWarnings(result, lines > used ? lines - used : 0) + tf;
}

std::string WrittenTo(const std::vector<std::string>& paths) {
  std::string text;
  for (const std::string& path : paths)
    text += (text.empty() ? "\nWritten to " : "           ") + Printable(path) + "\n";
  return text;
}

std::string Summary(const DataCheck& check, const RecordingInfo& recording) {
  const RecordingInfo info = WithPrintableNames(recording);
  std::string text = Verdict(ToString(check.verdict), check.message) + Streams(check, info) + "\n" +
                     Matches(check);
  if (!check.turns_M.isZero(0.0)) text += Excitation(check);
  for (const std::string& warning : check.warnings) text += Wrap("  warning: ", warning);
  return text;
}

}  // namespace imu_pose_calib
