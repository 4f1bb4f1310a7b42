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
  [[noreturn]] void FailAt(size_t number, const std::string& text) const;
  [[noreturn]] void FailHere(const std::string& text) const { FailAt(number_, text); }
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

}  // namespace imu_pose_calib
