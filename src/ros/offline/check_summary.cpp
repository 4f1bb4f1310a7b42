#include "imu_pose_calib/ros/offline/summary.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr double kNotableFreeze = 0.1;  // [s]

std::string Verdict(const DataCheck& check) {
  switch (check.verdict) {
    case DataVerdict::kGood:
      return Wrap("GOOD: ", check.message);
    case DataVerdict::kUsable:
      return Wrap("USABLE: ", check.message);
    case DataVerdict::kRecordAgain:
      break;
  }
  return Wrap("RECORD AGAIN: ", check.message);
}

std::string Row(const char* label,
                const StreamCheck& stream,
                const std::optional<Latency>& latency) {
  return Format("  %-6s%8zu%8.1f%9s%10s%8.1f%9.1f",
                label,
                stream.count,
                stream.rate_hz,
                Time(stream.jitter_s).c_str(),
                Time(stream.longest_gap_s).c_str(),
                100.0 * stream.missing,
                100.0 * stream.repeated) +
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
  text += Row("poses", check.poses, info.pose_latency);
  std::string topics = info.pose_topic,
              remarks = Remarks("  poses: ", check.poses, check.poses_report);
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    text += Row("gyro", imu.gyro, info.imus[i].gyro_latency) +
            Row("accel", imu.accel, info.imus[i].accel_latency);
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
                                   imu.rest_s,
                                   imu.rest_norm)
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

std::string Summary(const DataCheck& check, const RecordingInfo& recording) {
  const RecordingInfo info = WithPrintableNames(recording);
  std::string text = Verdict(check) + Streams(check, info) + "\n" + Matches(check);
  if (!check.turns_M.isZero(0.0)) text += Excitation(check);
  for (const std::string& warning : check.warnings) text += Wrap("  warning: ", warning);
  return text;
}

}  // namespace imu_pose_calib
