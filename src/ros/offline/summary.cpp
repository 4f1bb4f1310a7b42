#include "imu_pose_calib/ros/offline/summary.h"

#include <algorithm>
#include <boost/algorithm/string/case_conv.hpp>
#include <boost/algorithm/string/join.hpp>
#include <cctype>
#include <cmath>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/verdict/verdict.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/transform_file.h"

namespace imu_pose_calib {
namespace {

constexpr double kCertain = 3.0;        // sigma
constexpr double kNotableFreeze = 0.1;  // [s]
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

size_t CountLines(const std::string& text) {
  return static_cast<size_t>(std::count(text.begin(), text.end(), '\n'));
}

/// "OK: the reason".
std::string Verdict(const std::string& verdict, const std::string& message) {
  return Wrap(boost::to_upper_copy(verdict) + ": ", message);
}

/// What the covariances of the poses say, a line.
std::string Stated(const char* indent, const std::optional<PoseStd>& stated) {
  if (!stated) return "";
  return Format("%stheir covariances say %.3g mm and %.3g deg per axis\n", indent,
                1e3 * stated->position, kDegrees * stated->rotation);
}

/// "0.12 mm, 0.034 deg".
std::string Text(const PoseStd& size) {
  return Format("%.3g mm, %.3g deg", 1e3 * size.position, kDegrees * size.rotation);
}

/// Of the clock of an IMU or a pose sensor in one session.
template <typename Session>
std::string TimeShift(const Session& session) {
  return Format("%.7f s +- %.4f ms", session.time_shift, 1e3 * session.time_shift_std);
}

std::string AndDropped(const StreamReport& report) {
  const std::string dropped = Dropped(report);
  return dropped.empty() ? "" : "; dropped " + dropped;
}

std::string Recovered(bool is_recovered, double jitter_s) {
  return is_recovered ? "; stamps: recovered, jitter " + Time(jitter_s) : "";
}

// --- Of a result: what a person wants to know first ---

/// Sigmas of roll, pitch and yaw [rad]: about the imu axes, R Exp(dtheta) turns by
/// E (droll, dpitch, dyaw). Nothing where the pitch leaves the other two undetermined.
std::optional<Eigen::Vector3d> RollPitchYawStd(const ImuCalibration& imu) {
  constexpr double kNearLock = 0.1;  // cosine of the pitch, 6 deg
  const Eigen::Vector3d rpy = RollPitchYaw(imu.T_MI.q);
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

/// A verdict, unless the result is in doubt for a reason that no sigma shows and that is not of a
/// pose sensor.
std::string UnlessDoubted(const Calibration& result, Status verdict) {
  const bool is_doubted =
      result.status != Status::kOk && result.message.rfind("sensor", 0) != 0 &&
      std::all_of(result.observability.begin(), result.observability.end(),
                  [](const Observability& o) { return o.status == Status::kOk; });
  return is_doubted ? "in doubt" : ToString(verdict);
}

/// Worst verdict of the directions whose name begins with `name`; "fixed" when there are none.
std::string VerdictOf(const Calibration& result, const std::string& name) {
  for (const Observability& o : result.observability)  // the worst first
    if (o.direction.compare(0, name.size(), name) == 0) return UnlessDoubted(result, o.status);
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
  return UnlessDoubted(result, Status::kOk);
}

/// Of a single IMU.
std::string Table(const Calibration& result) {
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& clock = result.sessions[0].imus[0];
  const Vector6d sigma = imu.Std();
  const std::optional<Eigen::Vector3d> rpy_sigma = RollPitchYawStd(imu);
  const auto row = [](const char* name, const std::string& value, const std::string& std_dev,
                      const std::string& verdict) {
    return Format("  %-16s %-29s %-22s %s\n", name, value.c_str(),
                  verdict == "fixed" ? "" : std_dev.c_str(), verdict.c_str());
  };
  std::string text = "\n" + row("imu in marker", "value", "sigma", "verdict");
  text += row("translation [mm]", List(1e3 * imu.T_MI.p, "%.3f"),
              List(1e3 * sigma.head<3>(), "%.3f"), VerdictOf(result, "p_MI"));
  text +=
      row("rpy [deg]", List(kDegrees * RollPitchYaw(imu.T_MI.q), "%.3f"),
          List(kDegrees * rpy_sigma.value_or(sigma.tail<3>()), "%.4f"), VerdictOf(result, "R_MI"));
  if (!rpy_sigma)
    text += "    pitch near 90 deg: roll and yaw turn about one axis; sigma about imu x, y, z\n";
  text += row("time shift", Format("%.7f s", clock.time_shift),
              Format("%.4f ms", 1e3 * clock.time_shift_std), VerdictOf(result, "time_shift"));
  text += row("accel delay", Format("%.4f ms", 1e3 * imu.accel_delay),
              Format("%.4f ms", 1e3 * imu.accel_delay_std), VerdictOf(result, "accel_delay"));
  if (clock.clock_drift_std > 0.0)
    text += row("clock drift", Format("%.2f ppm", 1e6 * clock.clock_drift),
                Format("%.2f ppm", 1e6 * clock.clock_drift_std), DriftVerdict(result));
  return text;
}

std::string TransformHead(const std::string& frame) {
  return Format("  %-9s%24s %7s %25s %9s\n", frame.c_str(), "translation [mm]", "sigma",
                "rpy [deg]", "sigma");
}

/// Of an IMU or a pose sensor; `number` prints what is in lists.
std::string TransformRow(const char* sensor, size_t place, const Rigid3& T, const Vector6d& sigma,
                         const char* number = "%.3f") {
  const std::string name = sensor + std::to_string(place);
  const int width = 32 - std::max(6, static_cast<int>(name.size()));
  return Format("  %-6s %*s %7.3f %25s %9.4f\n", name.c_str(), width,
                List(1e3 * T.p, number).c_str(), 1e3 * sigma.head<3>().maxCoeff(),
                List(kDegrees * RollPitchYaw(T.q), number).c_str(),
                kDegrees * sigma.tail<3>().maxCoeff());
}

/// Of several IMUs: one row for each, and their transforms to the first.
std::string ImuTable(const Calibration& result, const RecordingInfo& info) {
  std::string text = "\n" + TransformHead("in marker");
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += TransformRow("imu", i, result.imus[i].T_MI, result.imus[i].Std());
  text += TransformHead("in imu0");
  for (const BetweenImus& between : result.between_imus)
    text += TransformRow("imu", between.second, between.T, between.Std());
  text += "  sigma: the largest, of translations and about the axes of the imu\n";
  for (size_t i = 0; i < result.imus.size(); ++i)
    text += Wrap(Format("  imu%zu: ", i),
                 info.imus[i].imu_frame + ", " + info.imus[i].GyroSource() +
                     Format(", accel delay %.4f +- %.4f ms", 1e3 * result.imus[i].accel_delay,
                            1e3 * result.imus[i].accel_delay_std));
  return text;
}

/// Of several sessions or IMUs: which is which, the clocks, and what a session says alone.
std::string SessionTable(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  const bool is_single = result.sessions.size() == 1;
  std::string text = is_single ? "\n" : "\n  session, what it says alone less all others\n";
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const SessionCalibration& session = result.sessions[s];
    if (!is_single)
      text += Wrap(Format("  %zu  ", s + 1), infos[s].Source()) +
              Format("     at most %s: %.1f sigma (chi-square %.1f of %d)\n",
                     session.agreement.worst.c_str(), session.agreement.sigmas,
                     session.agreement.chi2, session.agreement.dof);
    for (size_t i = 0; i < session.imus.size(); ++i)
      if (session.imus[i].is_present)
        text += Format("     time shift of imu%zu  ", i) + TimeShift(session.imus[i]) + "\n";
  }
  return text;
}

/// Clock, scale, noise and drift of a pose sensor in one session.
std::string Describe(const PoseSensorSession& sensor) {
  std::string text = "time shift " + TimeShift(sensor);
  if (sensor.clock_drift_std > 0.0)
    text += Format(", clock drift %.2f +- %.2f ppm", 1e6 * sensor.clock_drift,
                   1e6 * sensor.clock_drift_std);
  if (sensor.scale_std > 0.0)
    text += Format("; scale %.5f +- %.5f", sensor.scale, sensor.scale_std);
  text += "; noise " + Text(sensor.noise) + "; drift " + Text(sensor.drift) + " per sqrt(s)";
  if (sensor.errors.poses > 0)
    text += "; its own trajectory errs by " + Text(sensor.errors.absolute) + " (ATE), in 1 s by " +
            Text(sensor.errors.relative) + " (RPE)";
  const auto jumps = std::count_if(sensor.world.begin(), sensor.world.end(),
                                   [](const auto& knot) { return knot.begins_piece; }) -
                     1;
  return text + (jumps > 0 ? Format("; jumps: %td", jumps) : "");
}

/// Of the pose sensors: where each is, its verdict, and what its poses are like. `is_brief`: in the
/// first session that has it.
std::string SensorTable(const Calibration& result, const RecordingInfo& info, bool is_brief) {
  std::string rows, text;
  const auto add = [&](const std::string& name, const Rigid3& T_MF, const Matrix6d& covariance) {
    rows += TransformHead("in " + name);
    for (size_t k = 0; k < result.pose_sensors.size(); ++k) {
      const PoseSensorCalibration& sensor = result.pose_sensors[k];
      const BetweenImus in_frame = Between(T_MF, covariance, sensor.T_MS, sensor.covariance);
      if (IsUsable(sensor)) rows += TransformRow("sensor", k, in_frame.T, in_frame.Std(), "%.2f");
    }
  };
  add("marker", {}, Matrix6d::Zero());
  for (size_t i = 0; i < result.imus.size() && !is_brief; ++i)
    add(Format("imu%zu", i), result.imus[i].T_MI, result.imus[i].covariance);
  for (size_t k = 0; k < result.pose_sensors.size(); ++k) {
    const PoseSensorCalibration& sensor = result.pose_sensors[k];
    const PoseSensorInfo& names = info.pose_sensors[k];
    const std::string label = Format("  sensor%zu: ", k), indent(label.size(), ' ');
    text += Wrap(label, names.frame + ", " + names.topic) +
            Wrap(indent, Verdict(ToString(sensor.status), sensor.message));
    for (size_t s = 0; s < sensor.sessions.size() && IsUsable(sensor); ++s) {
      if (!sensor.sessions[s].is_present) continue;
      text += Wrap(indent + (sensor.sessions.size() > 1 ? Format("session %zu: ", s + 1) : ""),
                   Describe(sensor.sessions[s]));
      if (is_brief) break;
    }
  }
  if (!is_brief) text += "  x_marker = R x_sensor + p, t_pose = t_sensor + time_shift\n";
  return "\n" + rows + "  sigma: the largest, of translations and about the axes of the sensor\n" +
         text;
}

/// A stream of a session, and what the solve used of it.
struct UsedStream {
  std::string role, of_imu, topic;
  const StreamReport& report;
};
std::vector<UsedStream> UsedStreams(const Calibration& result, size_t s,
                                    const RecordingInfo& info) {
  const SessionCalibration& session = result.sessions[s];
  std::vector<UsedStream> streams = {{"poses", "", info.pose_topic, session.poses}};
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const ImuSession& imu = session.imus[i];
    const std::string of = OfImu(i, session.imus.size());
    if (!imu.is_present) continue;
    streams.push_back({"gyro", of, info.imus[i].GyroSource(), imu.gyro});
    streams.push_back({"accel", of, info.imus[i].AccelSource(), imu.accel});
  }
  for (size_t k = 0; k < result.pose_sensors.size(); ++k) {
    const PoseSensorSession& sensor = result.pose_sensors[k].sessions[s];
    if (sensor.is_present)
      streams.push_back({Format("sensor%zu", k), "", info.pose_sensors[k].topic, sensor.poses});
  }
  return streams;
}

/// One line instead of the table of the sessions.
std::string MostApart(const Calibration& result) {
  const auto most = std::max_element(result.sessions.begin(), result.sessions.end(),
                                     [](const SessionCalibration& a, const SessionCalibration& b) {
                                       return a.agreement.sigmas < b.agreement.sigmas;
                                     });
  return Format("\n  %zu sessions; farthest from the others: session %td, %s, %.1f sigma\n",
                result.sessions.size(), most - result.sessions.begin() + 1,
                most->agreement.worst.c_str(), most->agreement.sigmas);
}

/// What was dropped of all streams.
std::string AllDropped(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::vector<std::string> all;
  for (size_t s = 0; s < infos.size(); ++s)
    for (const UsedStream& stream : UsedStreams(result, s, infos[s]))
      if (const std::string dropped = Dropped(stream.report); !dropped.empty())
        all.push_back(stream.role + stream.of_imu + OfSession(s, infos.size()) + " " + dropped);
  return "\n" + Wrap("  dropped: ", all.empty() ? "no samples" : boost::join(all, "; "));
}

/// So many lines at most of the warnings, with the number of those left out.
std::string FirstWarnings(const Calibration& result, size_t lines) {
  std::string text;
  size_t more = result.warnings.size(), shown = 0;
  for (; more > 0; --more, ++shown) {
    const std::string longer = text + Wrap("  warning: ", Printable(result.warnings[shown]));
    if (CountLines(longer) + (more > 1 ? 1 : 0) > lines) break;
    text = longer;
  }
  if (more > 0) text += Format("  %zu %swarnings: --verbose\n", more, shown > 0 ? "more " : "");
  return text;
}

/// Commands that publish the transforms.
std::string StaticTransforms(const Calibration& result, const RecordingInfo& info) {
  std::string text;
  for (const auto& [name, T] : BodyFrames(result, info)) {
    text += "\nrosrun tf2_ros static_transform_publisher \\\n" +
            Format("  %.6f %.6f %.6f %.8f %.8f %.8f %.8f \\\n", T.p.x(), T.p.y(), T.p.z(), T.q.x(),
                   T.q.y(), T.q.z(), T.q.w()) +
            "  " + ShellWord(info.marker_frame) + " " + ShellWord(name) + "\n";
  }
  return text;
}

// --- Of a result: all the rest ---

std::string Warnings(const Calibration& result) {
  std::string text;
  for (const std::string& direction : result.unobservable)
    text += Wrap("  undetermined: ", direction);
  for (const std::string& warning : result.warnings) text += Wrap("  warning: ", warning);
  return text.empty() ? "" : "\n" + text;
}

std::string Data(const Calibration& result, const std::vector<RecordingInfo>& infos) {
  std::string text;
  for (size_t s = 0; s < result.sessions.size(); ++s) {
    const SessionCalibration& session = result.sessions[s];
    const RecordingInfo& info = infos[s];
    text += "\n";
    text +=
        infos.size() == 1 ? "Data\n" : Wrap(Format("Data of session %zu: ", s + 1), info.Source());
    for (const auto& [role, of_imu, topic, report] : UsedStreams(result, s, info)) {
      const std::string used =
          Format(": %zu at %.1f Hz over %.1f s", report.used, report.rate_hz, report.duration_s);
      text += Wrap(Format("  %-5s  ", role.c_str()),
                   topic + used + Recovered(report.stamps_recovered, report.stamp_jitter_s) +
                       AndDropped(report));
      if (role == "poses") text += Stated("         ", info.stated_pose_std);
    }
    if (!info.imu_yaml.empty()) text += Wrap("  noise  ", info.imu_yaml);
    if (session.gaps + session.jumps > 0)
      text += Format("  %zu gaps and %zu jumps in the poses leave %zu segments\n", session.gaps,
                     session.jumps, session.segments);
  }
  return text;
}

std::string Transform(const Rigid3& T) {
  const auto rows = [](const Rigid3& x) {
    return Format("  p = [%s] mm\n  R = [%.6f, %.6f, %.6f, %.6f] (x, y, z, w)\n",
                  List(1e3 * x.p, "%.3f").c_str(), x.q.x(), x.q.y(), x.q.z(), x.q.w());
  };
  return "\nT_marker_imu, the imu seen from the marker: x_marker = R x_imu + p\n" + rows(T) +
         "  sigma of p along the marker axes, of R about the imu axes\n"
         "T_imu_marker, its inverse: x_imu = R x_marker + p\n" +
         rows(T.Inverse());
}

/// How far a clock is off a line, and where it steps.
std::string Wander(const ClockOffsets& clock) {
  if (!clock.wanders) return "";
  const auto size = static_cast<Eigen::Index>(clock.t.size());
  Eigen::ArrayXd t = Eigen::Map<const Eigen::ArrayXd>(clock.t.data(), size);
  Eigen::ArrayXd offset = Eigen::Map<const Eigen::ArrayXd>(clock.offset.data(), size);
  t -= t.mean();
  offset -= offset.mean();
  const double slope = (t * offset).sum() / t.square().sum();
  std::string text =
      Format("        time_shift wanders: up to %.2f ms off a line; over time: clock in the file\n",
             1e3 * (offset - slope * t).abs().maxCoeff());
  for (const ClockOffsets::Step& step : clock.steps)
    text +=
        Format("        time_shift steps by %+.2f ms at t_imu = %.3f s\n", 1e3 * step.size, step.t);
  return text;
}

/// A remark when one of two certainly averages its samples over a longer time; `excess` [s^2]: the
/// variance of that time. `form` is given the time and its sigma [ms].
std::string Averages(double excess, double std_dev, std::string what, std::string other,
                     const char* form) {
  if (!(std::abs(excess) > kCertain * std_dev)) return "";
  if (excess < 0.0) what.swap(other);
  what.front() = static_cast<char>(std::toupper(what.front()));
  const double time = std::sqrt(std::abs(excess));
  return what + Format(form, 1e3 * time, 0.5e3 * std_dev / time) +  // NOLINT
         other + ": accounted for\n";
}

std::string Clocks(const Calibration& result) {
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& clock = result.sessions[0].imus[0];
  std::string text =
      "Clocks: t_pose = t_imu + time_shift      (inverse: t_imu = t_pose - time_shift)\n"
      "        t_pose = t_accel + time_shift - accel_delay\n";
  if (clock.clock_drift_std > 0.0)
    text += Format("        time_shift holds at t_imu = %.3f s and grows by clock drift\n",
                   clock.clock_reference);
  text += Wander(clock.clock);
  text += Averages(imu.accel_smoothing, imu.accel_smoothing_std, "accelerometer", "gyroscope",
                   " averages over %.1f ms more than the ");
  if (const auto [compliance, sigma] = imu.Compliance(); compliance > kCertain * sigma) {
    const double gravity = result.sessions[0].g_W.norm();
    text += Format(
        "The mount of the imu gives way by %.2f mm (sigma %.2f mm) to its weight: accounted for\n",
        1e3 * gravity * compliance, 1e3 * gravity * sigma);
  }
  text += Averages(result.pose_smoothing, result.pose_smoothing_std, "poses", "imu",
                   " smoothed over %.1f ms (sigma %.1f ms) more than the ");
  text += Averages(result.position_smoothing, result.position_smoothing_std, "position", "rotation",
                   " of the poses averages over %.1f ms more than their ");
  if (const double late = result.position_delay;
      std::abs(late) > kCertain * result.position_delay_std)
    text += Format("Positions of the poses are %.2f ms (sigma %.2f ms) %s than their rotations\n",
                   1e3 * std::abs(late), 1e3 * result.position_delay_std,
                   late > 0.0 ? "later" : "earlier");
  const double too_large = result.pose_scale - 1.0;
  if (std::abs(too_large) > kCertain * result.pose_scale_std)
    text += Format("Positions are too %s by %.2f %% (sigma %.2f %%): accounted for\n",
                   too_large > 0.0 ? "large" : "small", 100.0 * std::abs(too_large),
                   100.0 * result.pose_scale_std);
  return text;
}

std::string Matrix(const char* name, const Eigen::Matrix3d& M, const Eigen::Matrix3d& sigma) {
  std::string text;
  for (int row = 0; row < 3; ++row)
    text += Format("  %-12s[%s] +- [%s]\n", row == 0 ? name : "", List(M.row(row), "%9.5f").c_str(),
                   List(sigma.row(row), "%.5f").c_str());
  return text;
}

std::string Imu(const Calibration& result) {
  const ImuCalibration& imu = result.imus[0];
  const SessionCalibration& session = result.sessions[0];
  std::string text =
      Format(R"(
Gravity and mean biases
  gravity    = [%s] m/s^2 in the world frame
  gyro bias  = [%s] rad/s in the imu frame
  accel bias = [%s] m/s^2 in the imu frame
)",
             List(session.g_W, "%.5f").c_str(), List(session.imus[0].gyro_bias, "%.6f").c_str(),
             List(session.imus[0].accel_bias, "%.5f").c_str());
  if (result.imu_model != ImuModel::kCalibrated)
    text += "\nScale and misalignment: measured = M true + bias\n" +
            Matrix("gyro M =", imu.gyro_matrix, imu.gyro_matrix_std) +
            Matrix("accel M =", imu.accel_matrix, imu.accel_matrix_std);
  if (!imu.accel_positions_std.isZero(0.0))
    text +=
        "\nSize effect: places of the accelerometer's axes in the imu frame [m]\n" +
        Matrix("axes xyz =", imu.accel_positions.transpose(), imu.accel_positions_std.transpose());
  return text;
}

std::string Residuals(const Calibration& result) {
  const SessionCalibration& session = result.sessions[0];
  const ImuSession& imu = session.imus[0];
  std::string text = Format(R"(
Residuals per axis, and the noise estimated from them
  gyro      rms %.3g rad/s, noise %.3g rad/s
  accel     rms %.3g m/s^2, noise %.3g m/s^2
  position  rms %.3g mm, noise %.3g mm
  rotation  rms %.3g deg, noise %.3g deg
)",
                            imu.rms.gyro, imu.noise.gyro, imu.rms.accel, imu.noise.accel,
                            1e3 * session.rms.position, 1e3 * session.noise.position,
                            kDegrees * session.rms.rotation, kDegrees * session.noise.rotation);
  if (session.slow_errors.rotation > 0.0)
    text += "  the poses err for seconds by " + Text(session.slow_errors) + "\n";
  return text + Format("  the halves of the recording differ by up to %.1f sigma\n",
                       result.split_half.sigmas);
}

// --- Of a check of the data ---

std::string Row(const CheckedStream& stream) {
  const StreamCheck& check = stream.check;
  std::string text =
      Format("  %-6s%8zu%8.1f%9s%10s%8.1f%9.1f", stream.role.c_str(), check.count, check.rate_hz,
             Time(check.jitter_s).c_str(), Time(check.longest_gap_s).c_str(), 100.0 * check.missing,
             100.0 * check.repeated);
  if (stream.latency)
    text += Format("%12s%8s", Time(stream.latency->median_s).c_str(),
                   Time(stream.latency->spread_s).c_str());
  return text + "\n";
}

/// What the table does not show of a stream.
std::string Remarks(const CheckedStream& stream) {
  const StreamCheck& check = stream.check;
  std::string text = AndDropped(stream.report);
  if (check.longest_freeze_s > kNotableFreeze)
    text += "; no new value for up to " + Time(check.longest_freeze_s);
  if (check.cut_s > 0.0) text += Format("; stamps are multiples of %g ms", 1e3 * check.cut_s);
  text += Recovered(check.report.stamps_recovered, check.report.stamp_jitter_s);
  if (!check.report.stamps_recovered && !check.report.stamps_even)
    text += "; stamps: uneven, as recorded";
  if (check.bunched > 0.0) text += Format("; %.1f %% stamped in bunches", 100.0 * check.bunched);
  return text.empty() ? "" : Wrap("  " + stream.role + ": ", text.substr(2));
}

std::string Streams(const DataCheck& check, const RecordingInfo& info) {
  const std::vector<CheckedStream> streams = CheckedStreams(check, info);
  const bool has_latency =
      std::any_of(streams.begin(), streams.end(),
                  [](const CheckedStream& stream) { return stream.latency.has_value(); });
  std::string text = "\n         samples      Hz   jitter   max gap missing repeated";
  text += has_latency ? "     latency  spread\n" : "\n";
  text += "                                                %        %";
  text += has_latency ? "   (record - header)\n" : "\n";
  std::string topics, remarks;
  for (const CheckedStream& stream : streams) {
    text += Row(stream);
    remarks += Remarks(stream);
    if (stream.role != "accel" || info.imus[stream.imu].imu_topic.empty())
      topics += (topics.empty() ? "" : ", ") + stream.topic;
  }
  text += Wrap(info.bag.empty() ? "  files: " : "  topics: ", topics) +
          Stated("  poses: ", info.stated_pose_std) + remarks;
  if (check.gaps + check.jumps > 0)
    text += Format("  gaps in the poses: %zu, jumps: %zu\n", check.gaps, check.jumps);
  return text + "\n";
}

/// What each IMU shows, under its name when there are several.
std::string Matches(const DataCheck& check) {
  std::string text;
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    if (!imu.is_matched) continue;
    if (check.imus.size() > 1) text += Format("  imu%zu\n", i);
    text += Format("  time shift   about %.4f s", imu.time_shift);
    if (!(std::abs(imu.time_shift) < 600.0)) text += " (" + Time(imu.time_shift) + ")";
    text += Format("; %.1f s in common\n", imu.overlap_s) +
            Format("  clock drift  %.1f +- %.1f ppm\n", imu.drift_ppm, imu.drift_ppm_std) +
            Format("  same motion  the poses explain %.1f %% of the gyroscope's variance\n",
                   100.0 * imu.explained);
  }
  return text;
}

std::string Excitation(const DataCheck& check) {
  if (check.turns_M.isZero(0.0)) return "";
  std::string text = Format(
      "  turns        [%s] rad/s rms about marker x, y, z\n"
      "  moves        [%s] m/s^2 rms along world x, y, z\n",
      List(check.turns_M, "%.2f").c_str(), List(check.moves_W, "%.2f").c_str());
  for (const ImuCheck& imu : check.imus)
    text += imu.rest_s > 0.0 ? Format("  at rest      %.1f s; the accelerometer shows %.2f m/s^2\n",
                                      imu.rest_s, imu.rest_norm)
                             : "  at rest      never, so the accelerometer's norm is unchecked\n";
  return text;
}

}  // namespace

std::string Summary(const Calibration& result, const std::vector<RecordingInfo>& recordings,
                    std::optional<size_t> lines) {
  std::vector<RecordingInfo> infos;
  for (const RecordingInfo& recording : recordings) infos.push_back(WithPrintableNames(recording));
  std::string text = Verdict(ToString(result.status), result.message);
  if (!result.IsUsable()) return text + Data(result, infos) + Warnings(result);
  const bool is_rig = result.imus.size() > 1, has_imu = !result.imus.empty();
  if (has_imu) text += is_rig ? ImuTable(result, infos[0]) : Table(result);
  if (has_imu && lines && infos.size() > 1)
    text += MostApart(result);
  else if (has_imu && (is_rig || infos.size() > 1))
    text += SessionTable(result, infos);
  if (!result.pose_sensors.empty()) text += SensorTable(result, infos[0], lines.has_value());
  const std::string tf = StaticTransforms(result, infos[0]);
  if (!lines) {
    text += Warnings(result) + Data(result, infos);
    if (has_imu)
      text += Transform(result.imus[0].T_MI) + Clocks(result) + Imu(result) + Residuals(result);
    return text + tf;
  }
  text += AllDropped(result, infos);
  const size_t used = CountLines(text) + CountLines(tf);
  return text + FirstWarnings(result, *lines > used ? *lines - used : 0) + tf;
}

std::string WrittenTo(const std::vector<std::string>& paths) {
  std::string text;
  for (const std::string& path : paths)
    text += (text.empty() ? "\nWritten to " : "           ") + Printable(path) + "\n";
  return text;
}

std::vector<CheckedStream> CheckedStreams(const DataCheck& check, const RecordingInfo& info) {
  std::vector<CheckedStream> streams = {
      {"poses", 0, info.pose_topic, check.poses, check.poses.report, info.pose_latency}};
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    const ImuInfo& source = info.imus[i];
    streams.push_back(
        {"gyro", i, source.GyroSource(), imu.gyro, imu.gyro.report, source.gyro_latency});
    streams.push_back(
        {"accel", i, source.AccelSource(), imu.accel, imu.accel.report, source.accel_latency});
  }
  return streams;
}

std::string Summary(const DataCheck& check, const RecordingInfo& recording) {
  const RecordingInfo info = WithPrintableNames(recording);
  std::string text = Verdict(ToString(check.verdict), check.message) + Streams(check, info) +
                     Matches(check) + Excitation(check);
  for (const std::string& warning : check.warnings) text += Wrap("  warning: ", warning);
  return text;
}

}  // namespace imu_pose_calib
