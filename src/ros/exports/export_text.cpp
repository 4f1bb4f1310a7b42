#include "imu_pose_calib/ros/exports/export_text.h"

#include <Eigen/QR>
#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <cmath>
#include <cstdio>
#include <filesystem>

#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

double Density(double sigma, double rate_hz, const std::string& what) {
  if (!(sigma > 0.0 && rate_hz > 0.0))
    throw InputError("the result has no noise and rate of the " + what +
                     ", which must be positive: " + YamlNumber(sigma) + " at " +
                     YamlNumber(rate_hz) + " Hz");
  return sigma / std::sqrt(rate_hz);
}

Lines Clocks(const StoredResult& stored) {
  const ImuSession& clock = stored.Clock(0);
  Lines lines = {"clocks:    t_pose = t_imu + time_shift, time_shift = " +
                 YamlNumber(clock.time_shift) + " s, sigma " + Short(clock.time_shift_std) + " s"};
  if (clock.clock_drift != 0.0)
    lines.push_back("           at t_imu = " + YamlNumber(clock.clock_reference) +
                    " s; it grows by " + Short(clock.clock_drift) +
                    " s/s, which nothing below holds");
  if (stored.result.sessions.size() > 1)
    lines.push_back("           of session 1 of " + std::to_string(stored.result.sessions.size()) +
                    "; the others have clocks of their own");
  if (std::abs(clock.time_shift) > 1.0)
    lines.emplace_back(
        "           The clocks differ by more than 1 s, which many programs take for an error: "
        "shift the stamps first.");
  lines.push_back("           t_pose = t_accel + time_shift - accel_delay, accel_delay = " +
                  Short(stored.result.imus[0].accel_delay) + " s: no key below holds it;");
  lines.emplace_back("           subtract it from the stamps of accelerometer samples");
  return lines;
}

}  // namespace

Lines Head(const StoredResult& stored, const std::string& what, bool all_imus, const Lines& more) {
  const ImuInfo& imu = stored.Info(0);
  Lines lines = {
      what + ", from " + std::filesystem::path(stored.path).filename().string() +
          " by imu_pose_calib " + stored.version +
          (stored.run_id.empty() ? "" : ", run_id: " + stored.run_id),
      std::string("status:    ") + ToString(stored.result.status) + ": " + stored.result.message,
      "transform: x_marker = R x_imu + p, R and p are T_marker_imu; marker '" +
          stored.infos.front().marker_frame + "', imu '" + imu.imu_frame + "'"};
  for (const std::string& line : Clocks(stored)) lines.push_back(line);
  const size_t imus = stored.result.imus.size();
  if (imus > 1 && all_imus)
    lines.push_back("imus:      all " + std::to_string(imus) +
                    " of the rig; the clocks above are of the first");
  if (imus > 1 && !all_imus)
    lines.push_back("imus:      the first of " + std::to_string(imus) +
                    "; the others do not fit in");
  lines.insert(lines.end(), more.begin(), more.end());
  for (std::string& line : lines) line = Printable(line);
  return lines;
}

std::string Short(double value) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.4g", value);
  return text;
}

std::string YamlComment(const Lines& lines) {
  std::string text;
  for (const std::string& line : lines) text += "# " + line + "\n";
  return text;
}

std::string XmlComment(const Lines& lines) {
  std::string text = "<!--\n";
  for (std::string line : lines) {
    boost::replace_all(line, "--", "- -");  // "--" must not stand in a comment
    if (!line.empty() && line.back() == '-') line += " ";
    text += "  " + line + "\n";
  }
  return text + "-->\n";
}

std::string JsonList(const Lines& lines) {
  std::string text = "[";
  for (const std::string& line : lines)
    text += (text.size() > 1 ? ",\n    " : "\n    ") + Quoted(line);
  return text + "\n  ]";
}

std::string XmlText(const std::string& text) {
  std::string escaped = Printable(text);
  boost::replace_all(escaped, "&", "&amp;");
  boost::replace_all(escaped, "<", "&lt;");
  boost::replace_all(escaped, ">", "&gt;");
  boost::replace_all(escaped, "\"", "&quot;");
  return escaped;
}

std::string Quoted(const std::string& text) {
  std::string escaped = Printable(text);
  boost::replace_all(escaped, "\\", "\\\\");
  boost::replace_all(escaped, "\"", "\\\"");
  return "\"" + escaped + "\"";
}

std::string Numbers(const Eigen::MatrixXd& values) {
  std::string text;
  // Adding zero makes -0.0 a 0.0.
  for (Eigen::Index i = 0; i < values.rows(); ++i)
    for (Eigen::Index j = 0; j < values.cols(); ++j)
      text += (text.empty() ? "" : ", ") + YamlNumber(values(i, j) + 0.0);
  return text;
}

std::string List(const Eigen::MatrixXd& values) { return "[" + Numbers(values) + "]"; }

std::string Rows(const Eigen::MatrixXd& matrix, const std::string& indent) {
  std::string text;
  for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    text += indent + "- " + List(matrix.row(i)) + "\n";
  return text;
}

std::string Block(const Eigen::MatrixXd& matrix, const std::string& indent) {
  std::string text = "[";
  for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    text += (i == 0 ? "" : ",\n" + indent) + Numbers(matrix.row(i));
  return text + "]";
}

Vector7d PoseNumbers(const Rigid3& T) { return (Vector7d() << T.p, T.q.coeffs()).finished(); }

int64_t Nanoseconds(double seconds) {
  const double whole = std::floor(seconds);
  if (!(std::abs(whole) < 9e9))
    throw InputError("time_shift = " + YamlNumber(seconds) + " s does not fit nanoseconds");
  return static_cast<int64_t>(whole) * 1'000'000'000 + std::llround((seconds - whole) * 1e9);
}

NoiseDensity Noise(const StoredResult& stored, size_t imu) {
  const ImuSession& session = stored.Clock(imu);
  return {Density(session.noise.gyro, session.gyro.rate_hz, "gyroscope"),
          stored.options.gyro_bias_walk,
          Density(session.noise.accel, session.accel.rate_hz, "accelerometer"),
          stored.options.accel_bias_walk, session.gyro.rate_hz};
}

std::string NoiseKeys(const NoiseDensity& noise, const std::string& indent) {
  return indent + "accelerometer_noise_density: " + YamlNumber(noise.accel) +
         "  # [m/s^2/sqrt(Hz)]\n" + indent +
         "accelerometer_random_walk: " + YamlNumber(noise.accel_walk) + "  # [m/s^3/sqrt(Hz)]\n" +
         indent + "gyroscope_noise_density: " + YamlNumber(noise.gyro) + "  # [rad/s/sqrt(Hz)]\n" +
         indent + "gyroscope_random_walk: " + YamlNumber(noise.gyro_walk) +
         "  # [rad/s^2/sqrt(Hz)]\n";
}

LowerTimesRotation SplitLower(const Eigen::Matrix3d& M) {
  // M^T = Q^T L^T
  const Eigen::HouseholderQR<Eigen::Matrix3d> qr(M.transpose());
  const Eigen::Matrix3d upper = qr.matrixQR().triangularView<Eigen::Upper>();
  const Eigen::Vector3d signs =
      upper.diagonal().unaryExpr([](double d) { return d < 0.0 ? -1.0 : 1.0; });
  const Eigen::Matrix3d Q_transposed = qr.householderQ();
  return {(signs.asDiagonal() * upper).transpose(), signs.asDiagonal() * Q_transposed.transpose()};
}

AccelAxes ToAccelAxes(const ImuCalibration& imu) {
  const LowerTimesRotation accel = SplitLower(imu.accel_matrix);
  const LowerTimesRotation gyro = SplitLower(imu.gyro_matrix * accel.Q.transpose());
  const Eigen::Quaterniond q_IA(Eigen::Matrix3d(accel.Q.transpose()));
  return {{(imu.T_MI.q * q_IA).normalized(), imu.T_MI.p},
          accel.L,
          gyro.L,
          gyro.Q,
          q_IA.angularDistance(Eigen::Quaterniond::Identity())};
}

}  // namespace imu_pose_calib
