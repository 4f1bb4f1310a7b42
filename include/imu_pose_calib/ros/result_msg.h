#pragma once

// The message and the core result are both called imu_pose_calib::CalibrationResult. Inside the
// package the message goes by CalibrationResultMsg; its name in the ROS graph does not change.
#define CalibrationResult CalibrationResultMsg
#include <imu_pose_calib/CalibrationResult.h>
#undef CalibrationResult
