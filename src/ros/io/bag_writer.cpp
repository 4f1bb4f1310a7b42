#include "imu_pose_calib/ros/io/bag_writer.h"

#include <rosbag/bag.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <limits>
#include <sstream>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kDay = 86'400'000'000'000;  // [ns]
const char kPoseTopic[] = "/mocap/pose";

geometry_msgs::TransformStamped ToLink(int64_t t_ns, const std::string& parent,
                                       const std::string& child, const Rigid3& T) {
  return ToTransformStamped(MakeHeader(FromNanoseconds(t_ns), parent), child, T);
}

geometry_msgs::TransformStamped ToTransform(const PoseSample& pose) {
  return ToLink(pose.t_ns, "world", "marker", {pose.q_WM, pose.p_WM});
}

geometry_msgs::PoseStamped ToPoseStamped(const PoseSample& pose) {
  geometry_msgs::PoseStamped msg;
  msg.header = MakeHeader(FromNanoseconds(pose.t_ns), "world");
  msg.pose = ToPoseMsg({pose.q_WM, pose.p_WM});
  return msg;
}

geometry_msgs::PoseWithCovarianceStamped ToPoseWithCovariance(const PoseSample& pose) {
  geometry_msgs::PoseWithCovarianceStamped msg;
  msg.header = MakeHeader(FromNanoseconds(pose.t_ns), "world");
  msg.pose.pose = ToPoseMsg({pose.q_WM, pose.p_WM});
  return msg;
}

nav_msgs::Odometry ToOdometry(const PoseSample& pose) {
  nav_msgs::Odometry msg;
  msg.header = MakeHeader(FromNanoseconds(pose.t_ns), "world");
  msg.child_frame_id = "marker";
  msg.pose.pose = ToPoseMsg({pose.q_WM, pose.p_WM});
  return msg;
}

// --- Poses as an arm of six joints ---

constexpr size_t kJoints = 6;  ///< links base -> joint1 -> ... -> joint5 -> marker

Rigid3 BaseInWorld() { return {Eigen::Quaterniond(0.8, 0.0, 0.0, 0.6), {1.0, -0.5, 0.2}}; }

std::string JointName(size_t joint) {
  if (joint == 0) return "base";
  return joint == kJoints ? "marker" : "joint" + std::to_string(joint);
}

/// Whether joint 1..6 is in the message of pose k of n.
bool IsSent(size_t joint, size_t k, size_t n) {
  return joint == kJoints || k % (kJoints - 1) == joint - 1 || k == 0 || k == n - 1;
}

/// Transform of joint 1..5 at pose k. Its angle changes evenly between the messages that hold it,
/// so that interpolation gives the poses exactly.
Rigid3 JointAt(size_t joint, size_t k, const std::vector<PoseSample>& poses) {
  const auto angle = [&](size_t i) {
    return 0.4 * std::sin(0.01 * static_cast<double>(i) + static_cast<double>(joint));
  };
  size_t before = k, after = k;
  while (!IsSent(joint, before, poses.size())) --before;
  while (!IsSent(joint, after, poses.size())) ++after;
  double value = angle(before);
  if (after > before) {
    const auto seconds = [&](size_t i) {
      return 1e-9 * static_cast<double>(poses[i].t_ns - poses[before].t_ns);
    };
    value += (angle(after) - value) * seconds(k) / seconds(after);
  }
  const Eigen::Vector3d axis = Eigen::Vector3d::Unit(static_cast<Eigen::Index>(joint % 3));
  return {Eigen::Quaterniond(Eigen::AngleAxisd(value, axis)), {0.1, 0.0, 0.2}};
}

tf2_msgs::TFMessage ToTf(size_t k, const std::vector<PoseSample>& poses) {
  const PoseSample& pose = poses[k];
  tf2_msgs::TFMessage msg;
  Rigid3 arm = BaseInWorld();
  for (size_t joint = 1; joint < kJoints; ++joint) {
    const Rigid3 T = JointAt(joint, k, poses);
    arm = arm * T;
    if (IsSent(joint, k, poses.size()))
      msg.transforms.push_back(ToLink(pose.t_ns, JointName(joint - 1), JointName(joint), T));
  }
  // the last joint is free
  const Rigid3 T = arm.Inverse() * Rigid3{pose.q_WM, pose.p_WM};
  msg.transforms.push_back(ToLink(pose.t_ns, JointName(kJoints - 1), JointName(kJoints), T));
  return msg;
}

tf2_msgs::TFMessage ToFixedTf(int64_t t_ns) {
  tf2_msgs::TFMessage msg;
  msg.transforms = {ToLink(t_ns, "world", JointName(0), BaseInWorld())};
  return msg;
}

geometry_msgs::Vector3Stamped ToVector(const ImuSample& sample) {
  geometry_msgs::Vector3Stamped msg;
  msg.header = MakeHeader(FromNanoseconds(sample.t_ns), "imu");
  msg.vector = ToVector3Msg(sample.value);
  return msg;
}

/// An Imu message of one or both samples; what is missing is marked as the message defines it.
sensor_msgs::Imu ToImu(const ImuSample* gyro, const ImuSample* accel,
                       const std::string& frame = "imu") {
  sensor_msgs::Imu msg;
  msg.header = MakeHeader(FromNanoseconds((gyro ? gyro : accel)->t_ns), frame);
  msg.orientation_covariance[0] = -1.0;
  msg.angular_velocity_covariance[0] = gyro ? 0.0 : -1.0;
  msg.linear_acceleration_covariance[0] = accel ? 0.0 : -1.0;
  if (gyro) msg.angular_velocity = ToVector3Msg(gyro->value);
  if (accel) msg.linear_acceleration = ToVector3Msg(accel->value);
  return msg;
}

/// A bag of ROS 1 or ROS 2 that is being written.
struct Sink {
  rosbag::Bag* ros1;
  Ros2Writer* ros2;

  template <typename Msg>
  void Write(const std::string& topic, int64_t t_ns, const Msg& msg) {
    if (ros1)
      ros1->write(topic, FromNanoseconds(t_ns), msg);
    else
      ros2->Write(topic, t_ns, msg);
  }
};

/// A message to write and its record time [ns].
struct Record {
  int64_t t_ns;
  std::function<void(Sink*, int64_t)> write;
};

/// Appends the messages `to_msg(k)` of the samples, recorded at their stamps plus `offset` [ns],
/// but never before the sample ahead of them.
template <typename Sample, typename ToMsg>
void Add(const std::string& topic, const std::vector<Sample>& samples, int64_t offset, ToMsg to_msg,
         std::vector<Record>* records) {
  int64_t arrival = std::numeric_limits<int64_t>::min();
  for (size_t k = 0; k < samples.size(); ++k) {
    arrival = std::max(arrival, samples[k].t_ns + offset);
    records->push_back({arrival, [topic, to_msg, k](Sink* sink, int64_t t_ns) {
                          sink->Write(topic, t_ns, to_msg(k));
                        }});
  }
}

/// The gyroscope of the first IMU that has samples of it; without any when there is none.
const std::vector<ImuSample>& FirstGyro(const SessionData& data) {
  for (const ImuData& imu : data.imus)
    if (!imu.gyro.empty()) return imu.gyro;
  return data.imus[0].gyro;
}

/// What to add to the stamps of the first IMU to get record times.
int64_t RecordOffset(const SessionData& data) {
  const std::vector<ImuSample>& gyro = FirstGyro(data);
  if (data.poses.empty() || gyro.empty()) return 0;
  const int64_t offset = data.poses.front().t_ns - gyro.front().t_ns;
  return std::abs(offset) > kDay ? offset : 0;
}

/// All but the first; of those without samples, nothing.
void AddFurtherImus(const SessionData& data, int64_t offset, std::vector<Record>* records) {
  for (size_t i = 1; i < data.imus.size(); ++i) {
    const ImuData& imu = data.imus[i];
    CheckSameStamps(imu);
    if (imu.IsEmpty()) continue;
    const std::string name = "imu" + std::to_string(i);
    const auto further = [&imu, name](size_t k) {
      return ToImu(&imu.gyro[k], &imu.accel[k], name);
    };
    const int64_t own_offset = offset + FirstGyro(data).front().t_ns - imu.gyro.front().t_ns;
    Add("/" + name, imu.gyro, own_offset, further, records);
  }
}

void Write(const std::string& path, const std::vector<Record>& records,
           const std::optional<Ros2Format>& ros2) {
  if (ros2) {
    Ros2Writer writer(path, *ros2);
    Sink sink{nullptr, &writer};
    for (const Record& record : records) record.write(&sink, record.t_ns);
    return writer.Close();
  }
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Write);
    Sink sink{&bag, nullptr};
    for (const Record& record : records) record.write(&sink, record.t_ns);
  } catch (const rosbag::BagException& error) {
    throw InputError("cannot write bag '" + path + "': " + error.what());
  }
}

}  // namespace

Ros2Writer::Ros2Writer(const std::string& path, Ros2Format format)
    : storage_(format == Ros2Format::kMcap ? CreateMcap(path) : CreateSqlite(path)) {}

void Ros2Writer::Add(const std::string& topic, const std::string& ros1_type,
                     const std::string& ros1_definition, int64_t t_ns, const std::string& data) {
  const auto [known, is_new] = topics_.emplace(topic, static_cast<uint32_t>(topics_.size()));
  if (is_new)
    storage_->AddTopic(topic, boost::replace_first_copy(ros1_type, "/", "/msg/"),
                       Ros2Definition(ros1_definition));
  storage_->Write(known->second, t_ns, data);
}

std::string Ros2Definition(const std::string& ros1_definition) {
  std::istringstream lines(ros1_definition);
  std::string line, separator, text;
  bool has_time = false;
  while (std::getline(lines, line)) {
    line.resize(std::min(line.find('#'), line.size()));
    boost::trim(line);
    if (line.empty() || line == "uint32 seq") continue;  // a field of ROS 1's Header alone
    if (boost::starts_with(line, "====")) separator = line;
    if (boost::starts_with(line, "Header ")) line = "std_msgs/" + line;
    if (boost::starts_with(line, "time ")) {
      line = "builtin_interfaces/Time" + line.substr(4);
      has_time = true;
    }
    text += line + "\n";
  }
  if (has_time) text += separator + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
  return text;
}

void CheckSameStamps(const ImuData& imu) {
  const std::vector<ImuSample>&gyro = imu.gyro, &accel = imu.accel;
  if (gyro.size() != accel.size())
    throw InputError(
        "an IMU on one topic or in one file needs as many gyroscope as accelerometer samples, "
        "not " +
        std::to_string(gyro.size()) + " and " + std::to_string(accel.size()));
  for (size_t k = 0; k < gyro.size(); ++k)
    if (gyro[k].t_ns != accel[k].t_ns)
      throw InputError(
          "an IMU on one topic or in one file needs the same stamps for gyroscope and "
          "accelerometer");
}

void WriteBag(const std::string& path, const SessionData& data, const BagFormat& format) {
  const auto pose = [&](size_t k) { return ToPoseStamped(data.poses[k]); };
  const auto transform = [&](size_t k) { return ToTransform(data.poses[k]); };
  const auto covariance = [&](size_t k) { return ToPoseWithCovariance(data.poses[k]); };
  const auto odometry = [&](size_t k) { return ToOdometry(data.poses[k]); };
  const auto tf = [&](size_t k) { return ToTf(k, data.poses); };
  const auto fixed_tf = [&](size_t k) { return ToFixedTf(data.poses[k].t_ns); };
  const auto imu = [&](size_t k) { return ToImu(&data.imus[0].gyro[k], &data.imus[0].accel[k]); };
  const auto gyro_vector = [&](size_t k) { return ToVector(data.imus[0].gyro[k]); };
  const auto accel_vector = [&](size_t k) { return ToVector(data.imus[0].accel[k]); };
  const auto gyro = [&](size_t k) { return ToImu(&data.imus[0].gyro[k], nullptr); };
  const auto accel = [&](size_t k) { return ToImu(nullptr, &data.imus[0].accel[k]); };

  std::vector<Record> records;
  if (format.pose_type == "PoseStamped") {
    Add(kPoseTopic, data.poses, 0, pose, &records);
  } else if (format.pose_type == "TransformStamped") {
    Add(kPoseTopic, data.poses, 0, transform, &records);
  } else if (format.pose_type == "PoseWithCovarianceStamped") {
    Add(kPoseTopic, data.poses, 0, covariance, &records);
  } else if (format.pose_type == "Odometry") {
    Add(kPoseTopic, data.poses, 0, odometry, &records);
  } else if (format.pose_type == "tf") {
    if (!data.poses.empty())
      Add("/tf_static", std::vector<PoseSample>{data.poses.front()}, 0, fixed_tf, &records);
    Add("/tf", data.poses, 0, tf, &records);
  } else {
    throw InputError("pose type '" + format.pose_type +
                     "' is unknown; must be PoseStamped, TransformStamped, "
                     "PoseWithCovarianceStamped, Odometry or tf");
  }
  const int64_t offset = RecordOffset(data);
  if (format.imu_type == "Vector3Stamped") {
    Add("/imu/gyro", data.imus[0].gyro, offset, gyro_vector, &records);
    Add("/imu/accel", data.imus[0].accel, offset, accel_vector, &records);
  } else if (format.imu_type != "Imu") {
    throw InputError("imu type '" + format.imu_type + "' is unknown; must be Imu or " +
                     "Vector3Stamped");
  } else if (format.split_imu) {
    Add("/imu/gyro", data.imus[0].gyro, offset, gyro, &records);
    Add("/imu/accel", data.imus[0].accel, offset, accel, &records);
  } else {
    CheckSameStamps(data.imus[0]);
    Add("/imu", data.imus[0].gyro, offset, imu, &records);
  }
  AddFurtherImus(data, offset, &records);
  std::stable_sort(records.begin(), records.end(),
                   [](const Record& a, const Record& b) { return a.t_ns < b.t_ns; });
  Write(path, records, format.ros2);
}

std::string TruthYaml(const SimulatorOptions& options) {
  const TrueClock clock(options);
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
       << "time_shift: " << YamlNumber(clock.time_shift_s) << "\n"
       << "accel_delay: " << YamlNumber(clock.accel_delay_s) << "\n";
  list("gravity", (options.g_W + options.effects.gravity * options.g_W.normalized()).eval());
  text << "# at the start\n";
  list("gyro_bias", options.gyro_bias);
  list("accel_bias", options.accel_bias);
  return text.str();
}

}  // namespace imu_pose_calib
