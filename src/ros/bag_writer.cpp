#include "imu_pose_calib/ros/bag_writer.h"

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <rosbag/bag.h>
#include <sensor_msgs/Imu.h>

#include <algorithm>
#include <functional>
#include <sstream>
#include <vector>

#include "imu_pose_calib/ros/conversions.h"
#include "imu_pose_calib/ros/result_yaml.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kDay = 86'400'000'000'000;  // [ns]
const char kPoseTopic[] = "/mocap/pose";

std_msgs::Header MakeHeader(int64_t t_ns, const char* frame) {
  std_msgs::Header header;
  header.stamp = FromNanoseconds(t_ns);
  header.frame_id = frame;
  return header;
}

template <typename Vector>
void SetVector(const Eigen::Vector3d& v, Vector* msg) {
  msg->x = v.x();
  msg->y = v.y();
  msg->z = v.z();
}

void SetQuaternion(const Eigen::Quaterniond& q, geometry_msgs::Quaternion* msg) {
  SetVector(q.vec(), msg);
  msg->w = q.w();
}

geometry_msgs::PoseStamped ToPoseStamped(const PoseSample& pose) {
  geometry_msgs::PoseStamped msg;
  msg.header = MakeHeader(pose.t_ns, "world");
  SetVector(pose.p_WM, &msg.pose.position);
  SetQuaternion(pose.q_WM, &msg.pose.orientation);
  return msg;
}

geometry_msgs::TransformStamped ToTransformStamped(const PoseSample& pose) {
  geometry_msgs::TransformStamped msg;
  msg.header = MakeHeader(pose.t_ns, "world");
  msg.child_frame_id = "marker";
  SetVector(pose.p_WM, &msg.transform.translation);
  SetQuaternion(pose.q_WM, &msg.transform.rotation);
  return msg;
}

/// An Imu message of one or both samples; what is missing is marked as the message defines it.
sensor_msgs::Imu ToImu(const ImuSample* gyro, const ImuSample* accel) {
  sensor_msgs::Imu msg;
  msg.header = MakeHeader((gyro ? gyro : accel)->t_ns, "imu");
  msg.orientation_covariance[0] = -1.0;
  msg.angular_velocity_covariance[0] = gyro ? 0.0 : -1.0;
  msg.linear_acceleration_covariance[0] = accel ? 0.0 : -1.0;
  if (gyro) SetVector(gyro->value, &msg.angular_velocity);
  if (accel) SetVector(accel->value, &msg.linear_acceleration);
  return msg;
}

/// A message to write and its record time [ns].
struct Record {
  int64_t t_ns;
  std::function<void(rosbag::Bag*, const ros::Time&)> write;
};

void AddPoses(const std::vector<PoseSample>& poses,
              const std::string& type,
              std::vector<Record>* out) {
  if (type != "PoseStamped" && type != "TransformStamped")
    throw InputError("pose type '" + type +
                     "' is unknown; must be PoseStamped or TransformStamped");
  for (const PoseSample& pose : poses) {
    out->push_back({pose.t_ns, [&pose, type](rosbag::Bag* bag, const ros::Time& time) {
                      if (type == "PoseStamped") {
                        bag->write(kPoseTopic, time, ToPoseStamped(pose));
                      } else {
                        bag->write(kPoseTopic, time, ToTransformStamped(pose));
                      }
                    }});
  }
}

void AddImu(const CalibrationData& data, int64_t record_offset, std::vector<Record>* out) {
  if (data.gyro.size() != data.accel.size())
    throw InputError("one IMU topic needs as many gyroscope as accelerometer samples, not " +
                     std::to_string(data.gyro.size()) + " and " +
                     std::to_string(data.accel.size()));
  for (size_t k = 0; k < data.gyro.size(); ++k) {
    const ImuSample &gyro = data.gyro[k], &accel = data.accel[k];
    if (gyro.t_ns != accel.t_ns)
      throw InputError("one IMU topic needs the same stamps for gyroscope and accelerometer");
    out->push_back({gyro.t_ns + record_offset, [&](rosbag::Bag* bag, const ros::Time& time) {
                      bag->write("/imu", time, ToImu(&gyro, &accel));
                    }});
  }
}

void AddSplitImu(const CalibrationData& data, int64_t record_offset, std::vector<Record>* out) {
  for (const ImuSample& gyro : data.gyro)
    out->push_back({gyro.t_ns + record_offset, [&gyro](rosbag::Bag* bag, const ros::Time& time) {
                      bag->write("/imu/gyro", time, ToImu(&gyro, nullptr));
                    }});
  for (const ImuSample& accel : data.accel)
    out->push_back({accel.t_ns + record_offset, [&accel](rosbag::Bag* bag, const ros::Time& time) {
                      bag->write("/imu/accel", time, ToImu(nullptr, &accel));
                    }});
}

/// What to add to IMU stamps to get record times.
int64_t RecordOffset(const CalibrationData& data) {
  if (data.poses.empty() || data.gyro.empty()) return 0;
  const int64_t offset = data.poses.front().t_ns - data.gyro.front().t_ns;
  return std::abs(offset) > kDay ? offset : 0;
}

}  // namespace

void WriteBag(const std::string& path, const CalibrationData& data, const BagFormat& format) {
  std::vector<Record> records;
  AddPoses(data.poses, format.pose_type, &records);
  if (format.split_imu) {
    AddSplitImu(data, RecordOffset(data), &records);
  } else {
    AddImu(data, RecordOffset(data), &records);
  }
  std::stable_sort(records.begin(), records.end(), [](const Record& a, const Record& b) {
    return a.t_ns < b.t_ns;
  });
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Write);
    for (const Record& record : records) record.write(&bag, FromNanoseconds(record.t_ns));
  } catch (const rosbag::BagException& error) {
    throw InputError("cannot write bag '" + path + "': " + error.what());
  }
}

std::string TruthYaml(const SimulatorOptions& options) {
  std::ostringstream text;
  const auto list = [&](const char* key, const auto& values) {
    text << key << ": [";
    for (Eigen::Index i = 0; i < values.size(); ++i)
      text << (i == 0 ? "" : ", ") << YamlNumber(values[i]);
    text << "]\n";
  };
  text << "# T_marker_imu: x_marker = R x_imu + p\n";
  list("rotation", options.T_MI.q.coeffs());
  list("translation", options.T_MI.p);
  text << "# t_pose = t_imu + time_shift, t_pose = t_accel + time_shift - accel_delay\n"
       << "time_shift: " << YamlNumber(options.time_shift_s) << "\n"
       << "accel_delay: " << YamlNumber(options.accel_delay_s) << "\n";
  list("gravity", options.g_W);
  text << "# at the start\n";
  list("gyro_bias", options.gyro_bias);
  list("accel_bias", options.accel_bias);
  return text.str();
}

}  // namespace imu_pose_calib
