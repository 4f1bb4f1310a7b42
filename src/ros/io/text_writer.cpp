#include "imu_pose_calib/ros/io/text_writer.h"

#include <cstdio>

#include "imu_pose_calib/ros/io/bag_writer.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

std::string ImuTable(bool is_asl, const ImuData& imu) {
  CheckSameStamps(imu);
  TextTable table(is_asl ? kAslImuHeader : "timestamp,gx,gy,gz,ax,ay,az\n", ',');
  for (size_t k = 0; k < imu.gyro.size(); ++k) {
    const int64_t t_ns = imu.gyro[k].t_ns;
    table.AddRow(is_asl ? std::to_string(t_ns) : SecondsText(t_ns), imu.gyro[k].value,
                 imu.accel[k].value);
  }
  return table.text();
}

std::string SensorTable(const std::string& header, const std::vector<ImuSample>& samples) {
  TextTable table(header, ',');
  for (const ImuSample& sample : samples) table.AddRow(SecondsText(sample.t_ns), sample.value);
  return table.text();
}

std::string AslPoses(const std::vector<PoseSample>& poses) {
  TextTable table(
      "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
      "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n",
      ',');
  for (const PoseSample& pose : poses)
    table.AddRow(std::to_string(pose.t_ns), pose.p_WM, pose.q_WM.w(), pose.q_WM.vec());
  return table.text();
}

std::string TumPoses(const std::vector<PoseSample>& poses) {
  TextTable table("# timestamp tx ty tz qx qy qz qw\n", ' ');
  for (const PoseSample& pose : poses)
    table.AddRow(SecondsText(pose.t_ns), pose.p_WM, pose.q_WM.coeffs());
  return table.text();
}

}  // namespace

const char kAslImuHeader[] =
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";

void TextTable::Append(double value) {
  char number[32];
  std::snprintf(number, sizeof(number), "%c%.*g", separator_, digits_, value);
  text_ += number;
}

void WriteAslFolder(const std::string& folder, const SessionData& data) {
  OutputFiles files;
  const std::string imu = ImuTable(true, data.imus[0]);
  for (const char* sensor : {"", "/mocap0", "/imu0"}) files.MakeFolder(folder + sensor);
  files.Write(folder + "/mocap0/data.csv", AslPoses(data.poses));
  files.Write(folder + "/imu0/data.csv", imu);
  for (size_t k = 0; k < data.pose_sensors.size(); ++k) {
    const std::string sensor = folder + "/pose_sensor" + std::to_string(k);
    files.MakeFolder(sensor);
    files.Write(sensor + "/data.csv", AslPoses(data.pose_sensors[k]));
  }
  files.Commit();
}

void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu) {
  OutputFiles files;
  const ImuData& imu = data.imus[0];
  files.Write(prefix + ".poses.txt", TumPoses(data.poses));
  for (size_t k = 0; k < data.pose_sensors.size(); ++k)
    files.Write(prefix + ".pose_sensor" + (k == 0 ? "" : std::to_string(k)) + ".txt",
                TumPoses(data.pose_sensors[k]));
  if (split_imu) {
    files.Write(prefix + ".gyro.csv", SensorTable("timestamp,gx,gy,gz\n", imu.gyro));
    files.Write(prefix + ".accel.csv", SensorTable("timestamp,ax,ay,az\n", imu.accel));
  } else {
    files.Write(prefix + ".imu.csv", ImuTable(false, imu));
  }
  files.Commit();
}

}  // namespace imu_pose_calib
