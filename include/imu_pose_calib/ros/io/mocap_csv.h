#pragma once

#include <istream>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Poses of one rigid body, T_WM, from a table that the software of a motion capture system has
/// exported.
struct MocapPoses {
  std::vector<PoseSample> poses;
  std::string body;  ///< its name
};

/// Reads a CSV export of OptiTrack's Motive (format 1.2 and later, with its header) or of Vicon's
/// Nexus or Tracker ("Segments" or "Objects"). `body` names the rigid body; empty: the only one.
///
/// W has the axes of the file: y is up in Motive by default, z in Vicon. M is the body as it was
/// defined there. Positions are turned into [m] by the unit that the file states. Rotations of
/// Motive: quaternions, or Euler angles [deg] about axes that turn along, in the order stated;
/// of Vicon: quaternions where there is RW, else helical (axis times angle) in the unit stated.
/// Stamps of Motive: "Capture Start Time" as if it were UTC, if given, plus the time of the row;
/// of Vicon: frame / rate. Rows without values of the body are left out: gaps.
///
/// Nothing when the first line is not that of such an export; the stream is at its start then.
/// Throws InputError starting with `name`, with line and column, when what follows is not as it
/// must be.
std::optional<MocapPoses> ReadMocapCsv(std::istream& in, const std::string& name,
                                       const std::string& body);

}  // namespace imu_pose_calib
