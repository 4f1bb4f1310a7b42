#include "imu_pose_calib/ros/io/numpy_table.h"

#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

template <typename Number>
void NumpyTable<Number>::Write(const std::string& path) const {
  std::string header = std::string("{'descr': '") + (sizeof(Number) == 8 ? "<f8" : "<f4") +
                       "', 'fortran_order': False, 'shape': (" + std::to_string(rows()) + ", " +
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

template class NumpyTable<double>;
template class NumpyTable<float>;

}  // namespace imu_pose_calib
