#include "imu_pose_calib/ros/io/text_writer.h"

#include <cstdio>
#include <cstdlib>
#include <filesystem>

#include "imu_pose_calib/ros/io/bag_writer.h"
#include "imu_pose_calib/ros/io/output_files.h"

namespace imu_pose_calib {

const char kAslImuHeader[] =
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";

void TextTable::Append(double value) {
  char number[32];
  std::snprintf(number, sizeof(number), "%c%.*g", separator_, digits_, value);
  text_ += number;
}

std::string SecondsText(int64_t t_ns) {
  constexpr int64_t kNanosecondsPerSecond = 1'000'000'000;
  char text[32];
  std::snprintf(text, sizeof(text), "%s%lld.%09lld", t_ns < 0 ? "-" : "",
                std::llabs(t_ns / kNanosecondsPerSecond), std::llabs(t_ns % kNanosecondsPerSecond));
  return text;
}

void WriteAslFolder(const std::string& folder, const SessionData& data) {
  CheckSameStamps(data.imus[0]);
  std::error_code error;
  for (const char* sensor : {"mocap0", "imu0"})
    if (!error) std::filesystem::create_directories(std::filesystem::path(folder) / sensor, error);
  if (error) throw InputError("folder '" + folder + "' cannot be made: " + error.message());

  TextTable poses(
      "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
      "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n",
      ',');
  for (const PoseSample& pose : data.poses)
    poses.AddRow(std::to_string(pose.t_ns), pose.p_WM, pose.q_WM.w(), pose.q_WM.vec());
  WriteFile(folder + "/mocap0/data.csv", poses.text());
  TextTable samples(kAslImuHeader, ',');
  const ImuData& imu = data.imus[0];
  for (size_t k = 0; k < imu.gyro.size(); ++k)
    samples.AddRow(std::to_string(imu.gyro[k].t_ns), imu.gyro[k].value, imu.accel[k].value);
  WriteFile(folder + "/imu0/data.csv", samples.text());
}

void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu) {
  TextTable poses("# timestamp tx ty tz qx qy qz qw\n", ' ');
  for (const PoseSample& pose : data.poses)
    poses.AddRow(SecondsText(pose.t_ns), pose.p_WM, pose.q_WM.coeffs());
  WriteFile(prefix + ".poses.txt", poses.text());
  const ImuData& imu = data.imus[0];
  if (!split_imu) {
    CheckSameStamps(data.imus[0]);
    TextTable samples("timestamp,gx,gy,gz,ax,ay,az\n", ',');
    for (size_t k = 0; k < imu.gyro.size(); ++k)
      samples.AddRow(SecondsText(imu.gyro[k].t_ns), imu.gyro[k].value, imu.accel[k].value);
    WriteFile(prefix + ".imu.csv", samples.text());
    return;
  }
  TextTable gyro("timestamp,gx,gy,gz\n", ',');
  for (const ImuSample& sample : imu.gyro) gyro.AddRow(SecondsText(sample.t_ns), sample.value);
  WriteFile(prefix + ".gyro.csv", gyro.text());
  TextTable accel("timestamp,ax,ay,az\n", ',');
  for (const ImuSample& sample : imu.accel) accel.AddRow(SecondsText(sample.t_ns), sample.value);
  WriteFile(prefix + ".accel.csv", accel.text());
}

}  // namespace imu_pose_calib
