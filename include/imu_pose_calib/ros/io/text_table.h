#pragma once

#include <istream>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Stamps beyond would not leave room for differences: year 2115.
constexpr double kMaxStampNs = 4.6e18;

/// Text from a file for a message: short and printable.
std::string Quote(const std::string& text);

/// The lines of a text with their numbers, without blanks at both ends.
class TextLines {
 public:
  /// `name` begins all errors.
  TextLines(std::istream& in, std::string name);

  /// The next line. False at the end; throws InputError when it is no text or has a MB.
  bool Next(std::string* line);
  size_t number() const { return number_; }

  [[noreturn]] void Fail(const std::string& text) const;
  /// Names the current line.
  [[noreturn]] void FailHere(const std::string& text) const {
    Fail("line " + std::to_string(number_) + " " + text);
  }
  /// Refuses the text of a cell of the current line.
  [[noreturn]] void FailCell(const std::string& column, const std::string& text,
                             const std::string& expected) const;

 private:
  std::istream& in_;
  std::string name_, buffer_;
  size_t number_ = 0;
};

/// The whole text as a number, which may be nan or inf.
std::optional<double> ParseNumber(const std::string& text);

/// One table of samples, a line each. Columns are separated by semicolons, else commas, else
/// blanks; empty lines and lines that start with # are skipped.
///
/// A header, with or without #, names the columns in any order; others than those needed are
/// ignored. Without: timestamp tx ty tz qx qy qz qw (TUM) for poses, timestamp gx gy gz ax ay az
/// for an IMU, timestamp and three values for one of its sensors. Values are in SI units; nan is a
/// lost sample.
///
/// The header may give the unit of the stamps, as in "timestamp [ns]" or "timestamp(s)": s, ms,
/// us or ns. Without a unit they are seconds; but whole numbers above 1e15 are nanoseconds. They
/// are read as decimal numbers, exact to the nanosecond.
///
/// Throws InputError starting with `name` when the text is anything else.
std::vector<PoseSample> ReadPoseTable(std::istream& in, const std::string& name);
void ReadImuTable(std::istream& in, const std::string& name, ImuData* data);
std::vector<ImuSample> ReadSensorTable(std::istream& in, const std::string& name, bool is_accel);

/// Whether the first line is a header with all columns of poses, or of an IMU.
bool HasHeader(std::istream& in, const std::string& name, bool is_imu);

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
