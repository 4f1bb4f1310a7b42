#include "imu_pose_calib/ros/io/text_writer.h"

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <iomanip>
#include <sstream>
#include <vector>

#include "imu_pose_calib/ros/io/bag_writer.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {
namespace {

/// Digits that tell every double from its neighbours.
constexpr int kDigits = 17;

/// `header` and a line for each sample: its stamp and the values `values(k)`.
template <typename Sample, typename Stamp, typename Values>
void WriteTable(const std::string& path,
                const std::string& header,
                char separator,
                const std::vector<Sample>& samples,
                Stamp stamp,
                Values values) {
  std::ostringstream text;
  text << std::setprecision(kDigits) << header << "\n";
  for (size_t k = 0; k < samples.size(); ++k) {
    text << stamp(samples[k].t_ns);
    for (const double value : values(k)) text << separator << value;
    text << "\n";
  }
  WriteFile(path, text.str());
}

std::vector<double> Join(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return {a.x(), a.y(), a.z(), b.x(), b.y(), b.z()};
}

std::string Nanoseconds(int64_t t_ns) { return std::to_string(t_ns); }

}  // namespace

std::string SecondsText(int64_t t_ns) {
  constexpr int64_t kNanosecondsPerSecond = 1'000'000'000;
  char text[32];
  std::snprintf(text,
                sizeof(text),
                "%s%lld.%09lld",
                t_ns < 0 ? "-" : "",
                std::llabs(t_ns / kNanosecondsPerSecond),
                std::llabs(t_ns % kNanosecondsPerSecond));
  return text;
}

void WriteAslFolder(const std::string& folder, const SessionData& data) {
  CheckSameStamps(data);
  std::error_code error;
  for (const char* sensor : {"mocap0", "imu0"})
    if (!error) std::filesystem::create_directories(std::filesystem::path(folder) / sensor, error);
  if (error) throw InputError("folder '" + folder + "' cannot be made: " + error.message());

  WriteTable(folder + "/mocap0/data.csv",
             "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
             "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
             ',',
             data.poses,
             Nanoseconds,
             [&](size_t k) -> std::vector<double> {
               const Eigen::Vector3d& p = data.poses[k].p_WM;
               const Eigen::Quaterniond& q = data.poses[k].q_WM;
               return {p.x(), p.y(), p.z(), q.w(), q.x(), q.y(), q.z()};
             });
  WriteTable(
      folder + "/imu0/data.csv",
      "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
      "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]",
      ',',
      data.imus[0].gyro,
      Nanoseconds,
      [&](size_t k) { return Join(data.imus[0].gyro[k].value, data.imus[0].accel[k].value); });
}

void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu) {
  WriteTable(prefix + ".poses.txt",
             "# timestamp tx ty tz qx qy qz qw",
             ' ',
             data.poses,
             SecondsText,
             [&](size_t k) -> std::vector<double> {
               const Eigen::Vector3d& p = data.poses[k].p_WM;
               const Eigen::Quaterniond& q = data.poses[k].q_WM;
               return {p.x(), p.y(), p.z(), q.x(), q.y(), q.z(), q.w()};
             });
  if (!split_imu) {
    CheckSameStamps(data);
    WriteTable(
        prefix + ".imu.csv",
        "timestamp,gx,gy,gz,ax,ay,az",
        ',',
        data.imus[0].gyro,
        SecondsText,
        [&](size_t k) { return Join(data.imus[0].gyro[k].value, data.imus[0].accel[k].value); });
    return;
  }
  const auto write_sensor = [](const std::string& path,
                               const std::string& header,
                               const std::vector<ImuSample>& samples) {
    WriteTable(path, header, ',', samples, SecondsText, [&](size_t k) -> std::vector<double> {
      const Eigen::Vector3d& v = samples[k].value;
      return {v.x(), v.y(), v.z()};
    });
  };
  write_sensor(prefix + ".gyro.csv", "timestamp,gx,gy,gz", data.imus[0].gyro);
  write_sensor(prefix + ".accel.csv", "timestamp,ax,ay,az", data.imus[0].accel);
}

}  // namespace imu_pose_calib
