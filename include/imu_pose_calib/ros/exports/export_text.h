#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

// Pieces of the files that exporters.h gives.

using Lines = std::vector<std::string>;

/// The head of every file: what it is, where it comes from with which verdict, and the equations of
/// transform and clocks; then `more`. `all_imus`: the file holds every IMU of a rig.
Lines Head(const StoredResult& stored, const std::string& what, bool all_imus, const Lines& more);

/// A number for people, four digits.
std::string Short(double value);

std::string YamlComment(const Lines& lines);  ///< each line after "# "
std::string XmlComment(const Lines& lines);
/// A list of strings, indented by two.
std::string JsonList(const Lines& lines);

/// Text that stands in quotes in XML.
std::string XmlText(const std::string& text);
/// Text in quotes, for YAML and JSON.
std::string Quoted(const std::string& text);

/// "1.0, 2.0": row by row for a matrix.
std::string Numbers(const Eigen::MatrixXd& values);
/// "[1.0, 2.0]"
std::string List(const Eigen::MatrixXd& values);
/// One line "INDENT- [1.0, 2.0]" for each row.
std::string Rows(const Eigen::MatrixXd& matrix, const std::string& indent);
/// "[1.0, 2.0,\n" and so on, one line for each row after the first, which follow `indent`.
std::string Block(const Eigen::MatrixXd& matrix, const std::string& indent);

/// A transform as seven numbers, and how many programs call them.
using Vector7d = Eigen::Matrix<double, 7, 1>;
Vector7d PoseNumbers(const Rigid3& T);
constexpr const char* kPoseKeys[] = {"x", "y", "z", "qx", "qy", "qz", "qw"};

/// The whole number of nanoseconds nearest to `seconds`.
int64_t Nanoseconds(double seconds);

/// White noise and walk of the biases of an IMU.
struct NoiseDensity {
  double gyro, gyro_walk;    ///< [rad/s/sqrt(Hz)], [rad/s^2/sqrt(Hz)]
  double accel, accel_walk;  ///< [m/s^2/sqrt(Hz)], [m/s^3/sqrt(Hz)]
  double rate_hz;            ///< of the gyroscope
};

/// Densities are sigma per sample / sqrt(rate of its sensor). Throws InputError when the result
/// does not hold noise and rates.
NoiseDensity Noise(const StoredResult& stored, size_t imu);

/// The four keys that Kalibr has named, one a line after `indent`.
std::string NoiseKeys(const NoiseDensity& noise, const std::string& indent);

/// What Noise() is, for comments.
constexpr char kNoiseRemark[] =
    "noise: density = sigma per sample / sqrt(rate), from the residuals; walks: of the options";

/// A matrix as L Q, lower triangle with a positive diagonal times rotation.
struct LowerTimesRotation {
  Eigen::Matrix3d L, Q;
};
LowerTimesRotation SplitLower(const Eigen::Matrix3d& M);

/// The IMU as models see it whose accelerometer matrix is triangular: in axes A along the
/// accelerometer's, with the origin of I.
struct AccelAxes {
  Rigid3 T_MA;                 ///< x_M = T_MA x_A
  Eigen::Matrix3d accel;       ///< measured = accel f_A + bias; lower triangular
  Eigen::Matrix3d gyro, R_GA;  ///< measured = gyro R_GA omega_A + bias; gyro lower triangular
  double angle_rad;            ///< by which A is turned from I
};
AccelAxes ToAccelAxes(const ImuCalibration& imu);
/// In every file whose imu axes are those.
constexpr char kTurnedAxes[] = "the imu's axes here are those of the accelerometer";

/// A transform that tf is to publish: x_parent = T x_child.
struct StaticTransform {
  std::string parent, child;
  Rigid3 T;
};

/// The body as a robot description, and as a launch file of ROS 1.
std::string UrdfText(const Lines& head, const std::vector<StaticTransform>& transforms);
std::string LaunchText(const Lines& head, const std::vector<StaticTransform>& transforms);

/// marker -> imu of every IMU.
std::vector<StaticTransform> ImuTransforms(const StoredResult& stored);

}  // namespace imu_pose_calib
