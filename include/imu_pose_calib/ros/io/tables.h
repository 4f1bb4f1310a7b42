#pragma once

#include <Eigen/Core>
#include <cstdio>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/output_files.h"

namespace imu_pose_calib {

/// Calls `use(number)` for numbers and the elements of vectors.
template <typename Use>
void ForEachNumber(Use use, double number) {
  use(number);
}
template <typename Use, typename Derived>
void ForEachNumber(Use use, const Eigen::MatrixBase<Derived>& vector) {
  for (Eigen::Index i = 0; i < vector.size(); ++i) use(vector[i]);
}

/// A table of doubles as NumPy reads it, or of floats where these are exact enough.
template <typename Number>
class NumpyTable {
 public:
  explicit NumpyTable(size_t columns) : columns_(columns) {}

  /// A row of numbers and vectors, `columns` in all.
  template <typename... Parts>
  void AddRow(const Parts&... parts) {
    (ForEachNumber([this](double v) { values_.push_back(static_cast<Number>(v)); }, parts), ...);
  }
  /// An .npy file. Throws InputError when it cannot be written.
  void Write(const std::string& path) const {
    std::string header = std::string("{'descr': '") + (sizeof(Number) == 8 ? "<f8" : "<f4") +
                         "', 'fortran_order': False, 'shape': (" +
                         std::to_string(values_.size() / columns_) + ", " +
                         std::to_string(columns_) + "), }";
    constexpr size_t kFixed = 10, kAlignment = 64;  // bytes before the header; of the values
    header.resize((kFixed + header.size() + kAlignment) / kAlignment * kAlignment - kFixed, ' ');
    header.back() = '\n';
    std::string text("\x93NUMPY\x01\x00", 8);
    text += static_cast<char>(header.size() & 0xff);
    text += static_cast<char>(header.size() >> 8);
    text += header;
    text.append(reinterpret_cast<const char*>(values_.data()), values_.size() * sizeof(Number));
    WriteFile(path, text);
  }

 private:
  size_t columns_;
  std::vector<Number> values_;
};

/// Lines of a stamp and numbers with one separator between them.
class TextTable {
 public:
  /// `header`: with the end of its line; `digits`: significant ones of a number, of which 17 tell
  /// every double from its neighbours.
  TextTable(const std::string& header, char separator, int digits = 17)
      : text_(header), separator_(separator), digits_(digits) {}

  /// A line of a stamp and of numbers and vectors.
  template <typename... Parts>
  void AddRow(const std::string& stamp, const Parts&... parts) {
    text_ += stamp;
    (ForEachNumber([this](double v) { Append(v); }, parts), ...);
    text_ += '\n';
  }
  const std::string& text() const { return text_; }

 private:
  void Append(double value) {
    char number[32];
    std::snprintf(number, sizeof(number), "%c%.*g", separator_, digits_, value);
    text_ += number;
  }
  std::string text_;
  char separator_;
  int digits_;
};

/// Of the samples of an IMU in an ASL dataset.
constexpr char kAslImuHeader[] =
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";

}  // namespace imu_pose_calib
