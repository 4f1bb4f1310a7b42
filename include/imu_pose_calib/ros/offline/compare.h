#pragma once

#include <string>
#include <vector>

namespace imu_pose_calib {

/// Comparison of results as compare_calibrations offers it. Empty: not asked for.
struct CompareRequest {
  std::vector<std::string> results;  ///< result files, of one rig
  size_t imu = 0;                    ///< place of the IMU in rigs with several
  bool same_clocks = false;          ///< time shifts of different recordings can be compared
  /// T_marker_imu to compare with, see ReadTransform().
  std::string reference;
  /// The same as a chain: T_marker_cam (x_marker = T x_cam), and Kalibr's camchain-imucam.yaml.
  std::vector<std::string> chain;
  std::string camera = "cam0";  ///< the one of the chain that T_marker_cam is of
  /// "MM DEG": sigma of reference or chain, per axis.
  std::string reference_std = "0 0";
  /// Where marker -> imu -> cameras goes: this name with .urdf and .tf.launch.
  std::string chain_output;
};

struct CompareOutcome {
  bool agrees = true;
  std::string verdict;  ///< one line
  std::string text;     ///< for people, the verdict first
  std::vector<std::string> written;
};

/// Compares two results, or each of more with the mean of the others; and each with the reference.
/// They disagree when a component differs by more than kAgreementBound sigma. Time shifts count
/// when the results are of one recording, or when the clocks are said to be the same.
///
/// Throws InputError when something cannot be used as given.
CompareOutcome CompareResults(const CompareRequest& request);

}  // namespace imu_pose_calib
