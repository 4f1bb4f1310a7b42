#pragma once

#include <string>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

// All throw InputError that begins with `name`, which says what the text was given for.

/// "qx qy qz qw", normalized when it is within 1 % of a unit quaternion.
Eigen::Quaterniond ParseQuaternion(const std::string& name, const std::string& text);

/// A transform as seven numbers "x y z qx qy qz qw", or as the YAML or JSON file of that name,
/// which holds one of
///   x, y, z, qx, qy, qz, qw       at the top (evo) or below `transformation` (easy_handeye);
///   translation, rotation         [x, y, z] and [qx, qy, qz, qw], at the top or below `transform`;
///   matrix                        four rows of four numbers, at the top.
Rigid3 ReadTransform(const std::string& name, const std::string& text);

/// R = Rz(yaw) Ry(pitch) Rx(roll), as (roll, pitch, yaw) [rad].
Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q);

}  // namespace imu_pose_calib
