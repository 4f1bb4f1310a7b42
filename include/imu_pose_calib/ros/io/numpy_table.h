#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

namespace imu_pose_calib {

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
  /// An .npy file. Throws InputError when it cannot be written.
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
