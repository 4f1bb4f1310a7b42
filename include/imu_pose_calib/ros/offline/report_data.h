#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// What a report tells of.
struct ReportInput {
  const CalibrationOptions& options;
  const std::vector<SessionData>& sessions;  ///< as recorded
  const std::vector<RecordingInfo>& infos;   ///< of each session
  /// Without a solution: the data were refused before the solve.
  const Calibration& result;
  std::string refusal;  ///< why there is no result; empty: there is one
};

/// Puts the numbers that scripts/report.py draws into a folder:
///
///   report.yaml         verdict, names, streams, sensors, and which sessions and IMUs there are
///   result.yaml         as the result file, after a solve
///   summary.txt         the summary, after a solve
///   sS_..., sS_iI_...   series of session S and of its IMU I, each a NumPy file of rows; times are
///                       [s] after report.yaml's `epoch_ns` on the clock of the session's poses, or
///                       without a solve after the first stamp of the stream, everything else SI
///
/// Throws InputError when a file cannot be written.
void WriteReportData(const ReportInput& input, const std::string& folder);

/// A table of doubles as NumPy reads it, or of floats where these are exact enough.
template <typename Number>
class NumpyTable {
 public:
  explicit NumpyTable(size_t columns) : columns_(columns) {}

  /// A row of numbers and vectors, `columns` in all.
  template <typename... Parts>
  void AddRow(const Parts&... parts) {
    (Append(parts), ...);
  }
  size_t rows() const { return values_.size() / columns_; }
  void Write(const std::string& path) const;

 private:
  void Append(double value) { values_.push_back(static_cast<Number>(value)); }
  template <typename Derived>
  void Append(const Eigen::MatrixBase<Derived>& vector) {
    for (Eigen::Index i = 0; i < vector.size(); ++i) Append(vector[i]);
  }

  size_t columns_;
  std::vector<Number> values_;
};

}  // namespace imu_pose_calib
