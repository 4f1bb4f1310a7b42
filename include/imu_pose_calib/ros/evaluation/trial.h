#pragma once

#include <string>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/simulation/error_bound.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {

/// Where the samples of a trial come from.
enum class Base {
  kBag,         ///< a real recording; what noise does shows against its own calibration
  kSimulation,  ///< recordings whose truth is known, another motion in every trial
};

/// "sample", "simulation".
const char* ToString(Base base);

/// A real recording, or a part of it.
struct Source {
  std::string path;
  double start_s = 0.0, duration_s = 0.0;  ///< [s], as in BagRequest
};

/// All that the outcome of a trial follows from.
struct Case {
  Base base = Base::kSimulation;
  Method method = Method::kJoint;
  uint32_t index = 1;  ///< place among the trials of its cell; random numbers follow from it
  Source source;       ///< of the bag
  SimulatorOptions simulator;  ///< its seed follows from `index`
  size_t recordings = 1;       ///< simulated ones of one rig, calibrated together

  // What is done to the samples:
  PoseStd pose_noise;     ///< that is added
  ImuStd imu_noise;       ///< that is added
  double outliers = 0.0;  ///< [%] of the poses, 10 cm and 20 deg astray
  double lost = 0.0;      ///< [%] of the time, in gaps of 1 s

  /// The solve starts up to 180 deg and 1 m away from the truth, or what the bag alone says.
  bool is_guessed = false;
  bool is_random_rig = false;  ///< T_MI is up to 180 deg and 1 m, the clocks hours apart
  bool is_one_rig = false;     ///< only clocks and motion differ from trial to trial
};

/// On one line.
std::string Describe(const Case& trial);

/// What became of a trial. Usable results are compared with others.
struct TrialOutcome : Comparable {
  std::string verdict;  ///< "ok", "weak", "degenerate", "refused" or "failed"
  std::string reason;   ///< message of the result or of the refusal

  size_t warnings = 0;  ///< of usable results

  // Of simulations:
  Comparable truth;
  /// Error squared by the covariance of (p_MI, R_MI, time_shift, accel_delay): chi-square of 8
  /// degrees of freedom. Model: as if the residuals were independent.
  double chi2 = 0.0, model_chi2 = 0.0;
  ErrorBounds bounds;  ///< of the joint solve's trials only

  double guess_angle = 0.0, guess_distance = 0.0;  ///< [rad], [m] from the truth, when guessed

  bool IsUsable() const { return verdict == "ok" || verdict == "weak"; }
};

/// Sets verdict and, when it is usable, the result.
void Take(const Calibration& result, TrialOutcome* outcome);

std::string ToYaml(TrialOutcome outcome);
/// `text` may be that of a task that failed.
TrialOutcome ParseOutcome(const std::string& text);

/// Runs a trial. `bag`: what its source holds; `reference`: what the bag alone says, for guesses.
TrialOutcome RunTrial(const Case& trial, const SessionData& bag, const TrialOutcome& reference);

/// Estimate less truth: p_MI [m] in M, rotation [rad] about the imu axes, time shift and accel
/// delay [s].
using Errors = Eigen::Matrix<double, 8, 1>;
Errors ErrorsOf(const Comparable& estimate, const Comparable& truth);
ErrorNorms NormsOf(const Errors& errors);

}  // namespace imu_pose_calib
