#include "imu_pose_calib/ros/simulated/recording_writer.h"

#include <rosbag/bag.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <cstdlib>
#include <functional>
#include <limits>
#include <map>
#include <optional>
#include <sstream>
#include <vector>

#include "imu_pose_calib/ros/io/cdr.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/tables.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kDay = 86'400'000'000'000;  // [ns]

// --- Messages ---

template <typename Msg>
Msg Stamped(int64_t t_ns, const std::string& frame) {
  Msg msg;
  msg.header = MakeHeader(FromNanoseconds(t_ns), frame);
  return msg;
}

template <typename Msg>
Msg ToPose(const PoseSample& pose, const std::string& frame) {
  const Rigid3 T = {pose.q_WM, pose.p_WM};
  auto msg = Stamped<Msg>(pose.t_ns, frame);
  if constexpr (std::is_same_v<Msg, geometry_msgs::PoseStamped>)
    msg.pose = ToPoseMsg(T);
  else if constexpr (std::is_same_v<Msg, geometry_msgs::TransformStamped>)
    msg = ToTransformStamped(msg.header, "marker", T);
  else
    msg.pose.pose = ToPoseMsg(T);
  if constexpr (std::is_same_v<Msg, nav_msgs::Odometry>) msg.child_frame_id = "marker";
  return msg;
}

geometry_msgs::Vector3Stamped ToVector(const ImuSample& sample, const std::string& frame) {
  auto msg = Stamped<geometry_msgs::Vector3Stamped>(sample.t_ns, frame);
  msg.vector = ToVector3Msg(sample.value);
  return msg;
}

/// An Imu message of one or both samples; what is missing is marked as the message defines it.
sensor_msgs::Imu ToImu(const ImuSample* gyro, const ImuSample* accel, const std::string& frame) {
  auto msg = Stamped<sensor_msgs::Imu>((gyro ? gyro : accel)->t_ns, frame);
  msg.orientation_covariance[0] = -1.0;
  msg.angular_velocity_covariance[0] = gyro ? 0.0 : -1.0;
  msg.linear_acceleration_covariance[0] = accel ? 0.0 : -1.0;
  if (gyro) msg.angular_velocity = ToVector3Msg(gyro->value);
  if (accel) msg.linear_acceleration = ToVector3Msg(accel->value);
  return msg;
}

// --- Poses as an arm of six joints ---

constexpr size_t kJoints = 6;  ///< links base -> joint1 -> ... -> joint5 -> marker

Rigid3 BaseInWorld() { return {Eigen::Quaterniond(0.8, 0.0, 0.0, 0.6), {1.0, -0.5, 0.2}}; }

geometry_msgs::TransformStamped ToLink(int64_t t_ns, size_t joint, const Rigid3& T) {
  const auto name = [](size_t k) {
    return k == 0 ? "base" : k == kJoints ? "marker" : "joint" + std::to_string(k);
  };
  return ToTransformStamped(
      MakeHeader(FromNanoseconds(t_ns), joint == 0 ? "world" : name(joint - 1)), name(joint), T);
}

/// Pose k on /tf: the last joint, which is free, and one of the others; all at the start and the
/// end. Those turn evenly, so that interpolation gives the poses exactly.
tf2_msgs::TFMessage ToTf(size_t k, const std::vector<PoseSample>& poses) {
  const PoseSample& pose = poses[k];
  const bool is_end = k == 0 || k + 1 == poses.size();
  tf2_msgs::TFMessage msg;
  Rigid3 arm = BaseInWorld();
  for (size_t joint = 1; joint < kJoints; ++joint) {
    const double angle = static_cast<double>(joint) + 0.1 * Seconds(pose.t_ns - poses[0].t_ns);
    const Eigen::AngleAxisd turn(angle,
                                 Eigen::Vector3d::Unit(static_cast<Eigen::Index>(joint % 3)));
    const Rigid3 T = {Eigen::Quaterniond(turn), {0.1, 0.0, 0.2}};
    arm = arm * T;
    if (is_end || k % (kJoints - 1) == joint - 1)
      msg.transforms.push_back(ToLink(pose.t_ns, joint, T));
  }
  msg.transforms.push_back(
      ToLink(pose.t_ns, kJoints, arm.Inverse() * Rigid3{pose.q_WM, pose.p_WM}));
  return msg;
}

// --- Bags ---

/// A definition of a message as ROS 2 has it, without comments.
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

/// A bag of ROS 1 or ROS 2 that is being written.
struct Sink {
  rosbag::Bag* ros1;
  Ros2Storage* ros2;
  std::map<std::string, uint32_t> topics = {};  ///< of ROS 2, by their names

  template <typename Msg>
  void Write(const std::string& topic, int64_t t_ns, const Msg& msg) {
    if (ros1) return ros1->write(topic, FromNanoseconds(t_ns), msg);
    const auto [known, is_new] = topics.emplace(topic, static_cast<uint32_t>(topics.size()));
    const std::string type = ros::message_traits::DataType<Msg>::value();
    if (is_new)
      ros2->AddTopic(topic, boost::replace_first_copy(type, "/", "/msg/"),
                     Ros2Definition(ros::message_traits::Definition<Msg>::value()));
    ros2->Write(known->second, t_ns, ToCdr(msg));
  }
};

/// Messages to write, by their record times [ns].
using Records = std::multimap<int64_t, std::function<void(Sink*, int64_t)>>;

/// Appends the messages `to_msg(k)` of the samples, recorded at their stamps plus `offset` [ns],
/// but never before the sample ahead of them.
template <typename Sample, typename ToMsg>
void Add(const std::string& topic, const std::vector<Sample>& samples, int64_t offset, ToMsg to_msg,
         Records* records) {
  int64_t arrival = std::numeric_limits<int64_t>::min();
  for (size_t k = 0; k < samples.size(); ++k) {
    arrival = std::max(arrival, samples[k].t_ns + offset);
    records->emplace(arrival, [topic, to_msg, k](Sink* sink, int64_t t_ns) {
      sink->Write(topic, t_ns, to_msg(k));
    });
  }
}

template <typename Msg>
void AddPosesAs(const std::vector<PoseSample>& poses, Records* records,
                const std::string& topic = "/mocap/pose", const std::string& frame = "world",
                int64_t offset = 0) {
  const auto to_msg = [&poses, frame](size_t k) { return ToPose<Msg>(poses[k], frame); };
  Add(topic, poses, offset, to_msg, records);
}

void AddPoses(const std::string& type, const std::vector<PoseSample>& poses, Records* records) {
  using namespace geometry_msgs;  // NOLINT(google-build-using-namespace)
  if (type == "PoseStamped") return AddPosesAs<PoseStamped>(poses, records);
  if (type == "TransformStamped") return AddPosesAs<TransformStamped>(poses, records);
  if (type == "PoseWithCovarianceStamped")
    return AddPosesAs<PoseWithCovarianceStamped>(poses, records);
  if (type == "Odometry") return AddPosesAs<nav_msgs::Odometry>(poses, records);
  if (type != "tf")
    Reject("pose type '", type,
           "' is unknown; must be PoseStamped, TransformStamped, PoseWithCovarianceStamped, "
           "Odometry or tf");
  const auto fixed = [](Sink* sink, int64_t t_ns) {
    tf2_msgs::TFMessage msg;
    msg.transforms = {ToLink(t_ns, 0, BaseInWorld())};
    sink->Write("/tf_static", t_ns, msg);
  };
  if (!poses.empty()) records->emplace(poses.front().t_ns, fixed);
  const auto to_msg = [&poses](size_t k) { return ToTf(k, poses); };
  Add("/tf", poses, 0, to_msg, records);
}

/// Throws InputError unless gyroscope and accelerometer samples have the same stamps, as one topic
/// or file for both needs.
void CheckSameStamps(const ImuData& imu) {
  const auto is_same = [](const ImuSample& a, const ImuSample& b) { return a.t_ns == b.t_ns; };
  if (!std::equal(imu.gyro.begin(), imu.gyro.end(), imu.accel.begin(), imu.accel.end(), is_same))
    Reject("an IMU on one topic or in one file needs the same stamps for its gyroscope and ",
           "accelerometer samples, of which there are ", imu.gyro.size(), " and ",
           imu.accel.size());
}

void AddImu(const BagFormat& format, const std::string& name, const ImuData& imu, int64_t offset,
            Records* records) {
  const std::vector<ImuSample>&gyro = imu.gyro, &accel = imu.accel;
  const auto add_split = [&](auto gyro_msg, auto accel_msg) {
    Add("/" + name + "/gyro", gyro, offset, gyro_msg, records);
    Add("/" + name + "/accel", accel, offset, accel_msg, records);
  };
  if (format.imu_type == "Vector3Stamped")
    return add_split([&gyro, name](size_t k) { return ToVector(gyro[k], name); },
                     [&accel, name](size_t k) { return ToVector(accel[k], name); });
  if (format.imu_type != "Imu")
    Reject("imu type '", format.imu_type, "' is unknown; must be Imu or Vector3Stamped");
  if (format.split_imu)
    return add_split([&gyro, name](size_t k) { return ToImu(&gyro[k], nullptr, name); },
                     [&accel, name](size_t k) { return ToImu(nullptr, &accel[k], name); });
  CheckSameStamps(imu);
  const auto to_msg = [&imu, name](size_t k) { return ToImu(&imu.gyro[k], &imu.accel[k], name); };
  Add("/" + name, gyro, offset, to_msg, records);
}

/// "imu", "imu1" and so on.
std::string Numbered(const std::string& name, size_t k) {
  return k == 0 ? name : name + std::to_string(k);
}

// --- Text files ---

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

std::string PoseTable(bool is_asl, const std::vector<PoseSample>& poses) {
  TextTable table(is_asl ? "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
                           "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
                         : "# timestamp tx ty tz qx qy qz qw\n",
                  is_asl ? ',' : ' ');
  for (const PoseSample& pose : poses) {
    if (is_asl)
      table.AddRow(std::to_string(pose.t_ns), pose.p_WM, pose.q_WM.w(), pose.q_WM.vec());
    else
      table.AddRow(SecondsText(pose.t_ns), pose.p_WM, pose.q_WM.coeffs());
  }
  return table.text();
}

}  // namespace

int64_t RecordOffset(int64_t first_ns, int64_t first_pose_ns) {
  const int64_t offset = first_pose_ns - first_ns;
  return std::abs(offset) > kDay ? offset : 0;
}

void WriteBag(const std::string& path, const SessionData& data, const BagFormat& format) {
  Records records;
  AddPoses(format.pose_type, data.poses, &records);
  const auto offset_of = [&](int64_t first_ns) {
    return data.poses.empty() ? 0 : RecordOffset(first_ns, data.poses.front().t_ns);
  };
  for (size_t k = 0; k < data.pose_sensors.size(); ++k) {
    const std::vector<PoseSample>& poses = data.pose_sensors[k];
    if (poses.empty()) continue;
    const std::string name = Numbered("pose_sensor", k);
    AddPosesAs<geometry_msgs::PoseStamped>(poses, &records, "/" + name, name + "_world",
                                           offset_of(poses.front().t_ns));
  }
  std::optional<int64_t> begin_ns;  // of recording the IMUs
  for (size_t i = 0; i < data.imus.size(); ++i) {
    const ImuData& imu = data.imus[i];
    if (imu.IsEmpty()) continue;
    const int64_t first_ns = (imu.gyro.empty() ? imu.accel : imu.gyro).front().t_ns;
    if (!begin_ns) begin_ns = first_ns + offset_of(first_ns);
    AddImu(i == 0 ? format : BagFormat(), Numbered("imu", i), imu, *begin_ns - first_ns, &records);
  }
  const auto write_all = [&](Sink sink) {
    for (const auto& [t_ns, write] : records) write(&sink, t_ns);
  };
  if (format.ros2) {
    const auto storage = *format.ros2 == Ros2Format::kMcap ? CreateMcap(path) : CreateSqlite(path);
    write_all({nullptr, storage.get()});
    return storage->Close();
  }
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Write);
    write_all({&bag, nullptr});
  } catch (const rosbag::BagException& error) {
    Reject("cannot write bag '", path, "': ", error.what());
  }
}

void WriteAslFolder(const std::string& folder, const SessionData& data, OutputFiles* outputs) {
  OutputFiles own, &files = outputs ? *outputs : own;
  const auto write = [&](const std::string& sensor, const std::string& table) {
    files.MakeFolder(folder + "/" + sensor);
    files.Write(folder + "/" + sensor + "/data.csv", table);
  };
  files.MakeFolder(folder);
  write("mocap0", PoseTable(true, data.poses));
  write("imu0", ImuTable(true, data.imus[0]));
  for (size_t k = 0; k < data.pose_sensors.size(); ++k)
    write("pose_sensor" + std::to_string(k), PoseTable(true, data.pose_sensors[k]));
  own.Commit();
}

void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu,
                 OutputFiles* outputs) {
  OutputFiles own, &files = outputs ? *outputs : own;
  const ImuData& imu = data.imus[0];
  files.Write(prefix + ".poses.txt", PoseTable(false, data.poses));
  for (size_t k = 0; k < data.pose_sensors.size(); ++k)
    files.Write(prefix + Numbered(".pose_sensor", k) + ".txt",
                PoseTable(false, data.pose_sensors[k]));
  if (split_imu) {
    files.Write(prefix + ".gyro.csv", SensorTable("timestamp,gx,gy,gz\n", imu.gyro));
    files.Write(prefix + ".accel.csv", SensorTable("timestamp,ax,ay,az\n", imu.accel));
  } else {
    files.Write(prefix + ".imu.csv", ImuTable(false, imu));
  }
  own.Commit();
}

std::string TruthYaml(const SimulatorOptions& options) {
  const TrueClock clock(options);
  const Eigen::Vector3d g_W = options.g_W + options.effects.gravity * options.g_W.normalized();
  std::ostringstream text;
  text << "# T_marker_imu: x_marker = R x_imu + p\n"
       << "rotation: " << YamlNumbers(options.T_MI.q.coeffs()) << "\n"
       << "translation: " << YamlNumbers(options.T_MI.p) << "\n"
       << "# t_pose = t_imu + time_shift, t_pose = t_accel + time_shift - accel_delay\n"
       << "time_shift: " << YamlNumber(clock.time_shift_s) << "\n"
       << "accel_delay: " << YamlNumber(clock.accel_delay_s) << "\n"
       << "gravity: " << YamlNumbers(g_W) << "\n# at the start\n"
       << "gyro_bias: " << YamlNumbers(options.gyro_bias) << "\n"
       << "accel_bias: " << YamlNumbers(options.accel_bias) << "\n";
  for (const SimulatedPoseSensor& sensor : options.pose_sensors)
    text << (&sensor == &options.pose_sensors[0] ? "# T_marker_sensor\npose_sensors:\n" : "")
         << "  - {rotation: " << YamlNumbers(sensor.T_MS.q.coeffs())
         << ", translation: " << YamlNumbers(sensor.T_MS.p)
         << ", time_shift: " << YamlNumber(sensor.time_shift_s) << "}\n";
  return text.str();
}

}  // namespace imu_pose_calib
