#include "imu_pose_calib/ros/io/recording.h"

#include <ros/serialization.h>

#include <sstream>

namespace ros::serialization {

using imu_pose_calib::ImuSample;
using imu_pose_calib::Latency;
using imu_pose_calib::PoseSample;
using imu_pose_calib::PoseStd;
using imu_pose_calib::Recording;
using imu_pose_calib::RecordingInfo;

template <int N>
struct Serializer<Eigen::Matrix<double, N, 1>> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    for (int i = 0; i < N; ++i) stream.next(value[i]);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <typename T>
struct Serializer<std::optional<T>> {
  template <typename Stream>
  static void write(Stream& stream, const std::optional<T>& value) {
    stream.next(value.has_value());
    if (value) stream.next(*value);
  }
  template <typename Stream>
  static void read(Stream& stream, std::optional<T>& value) {
    bool has_value = false;
    stream.next(has_value);
    if (has_value) stream.next(value.emplace());
  }
  static uint32_t serializedLength(const std::optional<T>& value) {
    return serializationLength(true) + (value ? serializationLength(*value) : 0);
  }
};

template <>
struct Serializer<PoseStd> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.position);
    stream.next(value.rotation);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<PoseSample> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.t_ns);
    stream.next(value.q_WM.coeffs());
    stream.next(value.p_WM);
    stream.next(value.stated_std);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<ImuSample> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.t_ns);
    stream.next(value.value);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<Latency> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.median_s);
    stream.next(value.spread_s);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<RecordingInfo> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.bag);
    stream.next(value.imu_topic);
    stream.next(value.gyro_topic);
    stream.next(value.accel_topic);
    stream.next(value.pose_topic);
    stream.next(value.world_frame);
    stream.next(value.marker_frame);
    stream.next(value.imu_frame);
    stream.next(value.imu_yaml);
    stream.next(value.stated_pose_std);
    stream.next(value.pose_latency);
    stream.next(value.gyro_latency);
    stream.next(value.accel_latency);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<Recording> {
  template <typename Stream, typename Value>
  static void allInOne(Stream& stream, Value value) {
    stream.next(value.info);
    stream.next(value.data.poses);
    stream.next(value.data.imus[0].gyro);
    stream.next(value.data.imus[0].accel);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

}  // namespace ros::serialization

namespace imu_pose_calib {

namespace rs = ros::serialization;

bool IsPair(const Given& one, const Given& first, const Given& second) {
  if (first.value.empty() && second.value.empty()) return false;
  const std::string pair = std::string(first.name) + " and " + second.name;
  if (first.value.empty() || second.value.empty())
    throw InputError(pair + " belong together: " +
                     (first.value.empty() ? first.name : second.name) + " is missing");
  if (!one.value.empty())
    throw InputError(std::string("give either ") + one.name + ", or " + pair + ", not all");
  return true;
}

void CheckSpan(double start_s, double duration_s) {
  const auto check = [](const char* field, double value, const char* hint) {
    if (value >= 0.0) return;
    std::ostringstream text;
    text << field << " = " << value << " s must be at least 0 s" << hint;
    throw InputError(text.str());
  };
  check("start", start_s, "");
  check("duration", duration_s, " (0: all)");
}

std::string ToBytes(const Recording& recording) {
  std::string bytes(rs::serializationLength(recording), '\0');
  rs::OStream stream(reinterpret_cast<uint8_t*>(bytes.data()), static_cast<uint32_t>(bytes.size()));
  rs::serialize(stream, recording);
  return bytes;
}

Recording FromBytes(std::string bytes) {
  rs::IStream stream(reinterpret_cast<uint8_t*>(bytes.data()), static_cast<uint32_t>(bytes.size()));
  Recording recording;
  rs::deserialize(stream, recording);
  return recording;
}

}  // namespace imu_pose_calib
