#include "imu_pose_calib/core/data/conditioned_data.h"

#include <algorithm>

namespace imu_pose_calib {

size_t ConditionedData::FirstImu() const {
  const auto is_present = [](const ConditionedImu& imu) { return imu.IsPresent(); };
  return static_cast<size_t>(std::find_if(imus.begin(), imus.end(), is_present) - imus.begin());
}

std::string OfImu(size_t imu, size_t count) {
  return count == 1 ? "" : " of imu" + std::to_string(imu);
}

std::string OfSession(size_t session, size_t count) {
  return count == 1 ? "" : " in session " + std::to_string(session + 1);
}

}  // namespace imu_pose_calib
