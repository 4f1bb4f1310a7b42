// Runs one trial of evaluate: a recording, simulated or of a bag, with noise added, calibrated.

#include <ros/package.h>
#include <yaml-cpp/yaml.h>

#include <array>
#include <boost/range/algorithm_ext/erase.hpp>
#include <cmath>
#include <iostream>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/solution.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/offline/calibration_report.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/simulation/error_bound.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

constexpr uint32_t kFirstSeed = 1000, kRecordingSeeds = 100000;
constexpr double kGuessAngle = M_PI, kGuessDistance = 1.0;                   // [rad], [m], at most
constexpr double kClocks = 3600.0;                                           // [s] at most
constexpr double kOutlierDistance = 0.1, kOutlierAngle = 20.0 / 180 * M_PI;  // [m], [rad]
constexpr double kGap = 1.0;                                                 // [s]

/// Estimate less truth: p_MI [m] in M, rotation [rad] about the imu axes, time shift and accel
/// delay [s].
using Errors = Eigen::Matrix<double, 8, 1>;

/// All that the outcome of a trial follows from.
struct Trial {
  std::string method = "joint", motion = "handheld";
  uint32_t index = 1;          ///< random numbers follow from it
  std::string bag;             ///< empty: simulated
  double start_s = 0.0;        ///< of the bag
  std::string reference;       ///< outcome of the bag as it is
  SimulatorOptions simulator;  ///< its seed follows from `index`, its duration is the bag's, too
  double lever_arm = 0.0;      ///< [m] length of p_MI; 0: as in `simulator`
  size_t recordings = 1;       ///< simulated ones of one rig, calibrated together

  PoseStd pose_noise;     ///< that is added
  ImuStd imu_noise;       ///< that is added
  double outliers = 0.0;  ///< [%] of the poses, 10 cm and 20 deg astray
  double lost = 0.0;      ///< [%] of the time, in gaps of 1 s

  bool is_guessed = false;     ///< the solve starts up to 180 deg and 1 m away from the truth
  bool is_random_rig = false;  ///< T_MI is up to 180 deg and 1 m, the clocks hours apart
  bool is_one_rig = false;     ///< only clocks and motion differ from trial to trial
};

/// Random numbers of one use in one trial.
enum class Use : uint32_t { kNoise, kGuess, kRig, kOutliers };
std::mt19937 RandomOf(Use use, uint32_t index, size_t recording = 0) {
  std::seed_seq sequence{7001u, static_cast<uint32_t>(use), index,
                         static_cast<uint32_t>(recording)};
  return std::mt19937(sequence);
}

/// A transform up to 180 deg and 1 m from none.
Rigid3 RandomTransform(std::mt19937* random) {
  const Eigen::Vector3d axis = RandomDirection(random), direction = RandomDirection(random);
  const double angle = Uniform(random, 0.0, kGuessAngle);
  return {Exp<double>(angle * axis), Uniform(random, 0.0, kGuessDistance) * direction};
}

std::vector<SimulatorOptions> Truths(const Trial& trial) {
  std::vector<SimulatorOptions> truths(trial.recordings, trial.simulator);
  std::mt19937 random = RandomOf(Use::kRig, trial.index);
  const Rigid3 rig = RandomTransform(&random);
  for (size_t s = 0; s < truths.size(); ++s) {
    SimulatorOptions& truth = truths[s];
    truth.seed = kFirstSeed + trial.index + kRecordingSeeds * static_cast<uint32_t>(s);
    if (trial.is_random_rig) truth.T_MI = rig;
    if (trial.lever_arm > 0.0) truth.T_MI.p = trial.lever_arm * truth.T_MI.p.normalized();
    if (trial.is_random_rig || trial.is_one_rig || trial.recordings > 1)
      truth.time_shift_s = Uniform(&random, -kClocks, kClocks);
  }
  return truths;
}

/// Adds noise and outliers to recording number `s` of a trial, and loses poses in gaps of 1 s at
/// even distances.
void Disturb(const Trial& trial, size_t s, SessionData* data) {
  std::mt19937 noise = RandomOf(Use::kNoise, trial.index, s);
  std::mt19937 outliers = RandomOf(Use::kOutliers, trial.index, s);
  for (PoseSample& pose : data->poses) {
    pose.p_WM += Gaussian(&noise, trial.pose_noise.position);
    pose.q_WM = pose.q_WM * Exp(Gaussian(&noise, trial.pose_noise.rotation));
    if (Uniform(&outliers, 0.0, 100.0) >= trial.outliers) continue;
    pose.p_WM += kOutlierDistance * RandomDirection(&outliers);
    pose.q_WM = pose.q_WM * Exp<double>(kOutlierAngle * RandomDirection(&outliers));
  }
  for (ImuSample& gyro : data->imus[0].gyro) gyro.value += Gaussian(&noise, trial.imu_noise.gyro);
  for (ImuSample& accel : data->imus[0].accel)
    accel.value += Gaussian(&noise, trial.imu_noise.accel);

  if (trial.lost <= 0.0 || data->poses.empty()) return;
  const double period = kGap * 100.0 / trial.lost;
  const auto is_lost = [&, first_ns = data->poses.front().t_ns](const PoseSample& pose) {
    return std::fmod(Seconds(pose.t_ns - first_ns), period) >= period - kGap;
  };
  boost::remove_erase_if(data->poses, is_lost);
}

/// Errors squared by the covariance that is reported and by that of independent residuals:
/// chi-square of 8 degrees of freedom.
Eigen::Vector2d ChiSquares(const Calibration& result, const Errors& e) {
  using Covariance = Eigen::Matrix<double, 8, 8>;
  const Marginals& marginals = result.solution->marginals;
  Eigen::MatrixXd select = Eigen::MatrixXd::Zero(8, marginals.model.cols());
  Eigen::Index row = 0;
  for (const auto& [kind, size] : {std::pair{ParameterKind::kTranslation, 3},
                                   {ParameterKind::kRotation, 3},
                                   {ParameterKind::kTimeShift, 1},
                                   {ParameterKind::kAccelDelay, 1}})
    for (int i = 0; i < size; ++i) select(row++, marginals.Find(kind) + i) = 1.0;
  const Covariance model = Propagate(select, marginals.model);
  const Eigen::VectorXd larger = select * Enlargement(marginals.model, marginals.robust);
  const Covariance reported = larger.asDiagonal() * model * larger.asDiagonal();
  return {SquaredDistance(e, reported), SquaredDistance(e, model)};
}

/// What is true by the outcome of another trial.
SimulatorOptions ParseOutcome(const YAML::Node& outcome) {
  const auto q = outcome["rotation"].as<std::array<double, 4>>();  // x, y, z, w
  const auto p = outcome["translation"].as<std::array<double, 3>>();
  SimulatorOptions truth;
  truth.T_MI = {Eigen::Quaterniond(q.data()), Eigen::Vector3d(p.data())};
  truth.time_shift_s = outcome["time_shift"][0].as<double>();
  truth.accel_delay_s = outcome["accel_delay"][0].as<double>();
  return truth;
}

/// What evaluate reads of a calibration.
void Describe(const ImuCalibration& imu, const ImuSession& clock, YAML::Node* outcome) {
  YAML::Node& node = *outcome;
  node["translation"] = YamlList(imu.T_MI.p);
  node["rotation"] = YamlList(imu.T_MI.q.coeffs());
  for (int row = 0; row < 6; ++row) node["covariance"].push_back(YamlList(imu.covariance.row(row)));
  node["accel_delay"] = YamlList(Eigen::Vector2d(imu.accel_delay, imu.accel_delay_std));
  node["time_shift"] = YamlList(Eigen::Vector2d(clock.time_shift, clock.time_shift_std));
  node["std"] = YamlList(imu.Std());
}

/// Rotation [rad], translation [m], time shift and accel delay [s].
YAML::Node ListOf(const ErrorNorms& n) {
  return YamlList(Eigen::Vector4d(n.rotation, n.translation, n.time_shift, n.accel_delay));
}

/// Sets what scripts/evaluate reads: verdict, reason, and of a usable result its numbers and, where
/// there is a truth, norms of its errors. Throws DataError when the data are refused.
void RunTrial(const Trial& trial, SessionData bag, YAML::Node* outcome) {
  const bool is_simulated = trial.bag.empty();
  std::vector<SimulatorOptions> truths;  // none: it is not known
  std::vector<SessionData> recordings;
  if (is_simulated) {
    truths = Truths(trial);
    for (const SimulatorOptions& truth : truths) recordings.push_back(Simulate(truth));
  } else {
    recordings.push_back(std::move(bag));
    if (!trial.reference.empty()) truths = {ParseOutcome(YAML::Load(trial.reference))};
  }
  for (size_t s = 0; s < recordings.size(); ++s) Disturb(trial, s, &recordings[s]);

  CalibrationOptions options;
  SetOption("method", YAML::Node(trial.method), &options);
  options.num_threads = 1;  // trials run side by side, and give the same on any machine
  if (trial.is_guessed) {
    std::mt19937 random = RandomOf(Use::kGuess, trial.index);
    const Rigid3 away = RandomTransform(&random);
    options.initial_rotation = truths[0].T_MI.q * away.q;
    options.initial_translation = truths[0].T_MI.p + away.p;
    (*outcome)["guess"] = YamlList(
        Eigen::Vector2d(Eigen::Quaterniond::Identity().angularDistance(away.q), away.p.norm()));
  }
  const Calibration result = Calibrate(options, recordings);
  (*outcome)["verdict"] = ToString(result.status);
  (*outcome)["reason"] = result.message;
  if (!result.IsUsable()) return;
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& clock = result.sessions[0].imus[0];
  Describe(imu, clock, outcome);
  if (truths.empty()) return;
  const Rigid3& T_MI = truths[0].T_MI;
  const TrueClock true_clock(truths[0]);
  Errors e;
  e << imu.T_MI.p - T_MI.p, Log(Eigen::Quaterniond(T_MI.q.conjugate() * imu.T_MI.q)),
      clock.time_shift - true_clock.time_shift_s, imu.accel_delay - true_clock.accel_delay_s;
  (*outcome)["error"] =
      ListOf({e.head<3>().norm(), e.segment<3>(3).norm(), std::abs(e[6]), std::abs(e[7])});
  if (!is_simulated) return;
  (*outcome)["chi2"] = YamlList(ChiSquares(result, e));
  if (options.method != Method::kJoint) return;
  for (SimulatorOptions& truth : truths) {  // its noise is that of the simulator and what is added
    truth.position_std = std::hypot(truth.position_std, trial.pose_noise.position);
    truth.rotation_std = std::hypot(truth.rotation_std, trial.pose_noise.rotation);
    truth.gyro_std = std::hypot(truth.gyro_std, trial.imu_noise.gyro);
    truth.accel_std = std::hypot(truth.accel_std, trial.imu_noise.accel);
  }
  const ErrorBounds bounds = FindErrorBounds(truths, recordings);
  (*outcome)["bound"] = ListOf(bounds.as_joint);
  (*outcome)["least"] = ListOf(bounds.least);
}

// --- What else evaluate asks for ---

/// Constants.
YAML::Node About() {
  const CalibrationOptions bounds;
  SimulatorOptions simulator;
  YAML::Node node;
  node["version"] = kVersion;
  node["sample"] = ros::package::getPath("imu_pose_calib") + "/data/estimator_own_clocks.bag";
  node["within"] = YamlList(Eigen::Vector3d(bounds.weak_rotation_std, bounds.weak_translation_std,
                                            bounds.weak_time_shift_std));
  for (const Effect& effect : Effects(&simulator))
    node["effects"][effect.name] = YamlNumber(effect.usual);
  return node;
}

// --- Command line ---

po::options_description Describe(Trial* trial, bool* about) {
  SimulatorOptions& simulator = trial->simulator;
  po::options_description options("Options");
  auto add = options.add_options();
  add("method", ValueOrDefault(&trial->method, "TEXT"), "joint or gp");
  add("index", ValueOrDefault(&trial->index, "N"), "random numbers follow from it");
  add("bag", Value(&trial->bag), "recording; default: simulated");
  add("start", ValueOrDefault(&trial->start_s, "S"), "seconds of the bag to skip");
  add("reference", Value(&trial->reference, "YAML"), "result of the bag as it is, for errors");
  add("duration", ValueOrDefault(&simulator.duration_s, "S"), "length; 0: all of the bag");
  add("motion", ValueOrDefault(&trial->motion, "TEXT"), "of the simulator");
  add("pose-rate", ValueOrDefault(&simulator.pose_rate_hz, "HZ"), "poses");
  add("position-std", ValueOrDefault(&simulator.position_std, "M"), "noise per axis");
  add("rotation-std", ValueOrDefault(&simulator.rotation_std, "RAD"), "noise per axis");
  add("time-shift", ValueOrDefault(&simulator.time_shift_s, "S"), "t_pose = t_imu + time_shift");
  add("accel-delay", ValueOrDefault(&simulator.accel_delay_s, "S"),
      "t_pose = t_accel + time_shift - accel_delay");
  add("lever-arm", Value(&trial->lever_arm, "M"), "distance between marker and IMU");
  add("recordings", ValueOrDefault(&trial->recordings, "N"), "of one rig, calibrated together");
  add("random-rig", po::bool_switch(&trial->is_random_rig), "T_MI and clocks are random");
  add("one-rig", po::bool_switch(&trial->is_one_rig), "clocks are random");
  for (const Effect& effect : Effects(&simulator))
    add(effect.name, ValueOrDefault(effect.strength, effect.unit), effect.text);
  add("add-position", Value(&trial->pose_noise.position, "M"), "noise that is added");
  add("add-rotation", Value(&trial->pose_noise.rotation, "RAD"), "noise that is added");
  add("add-gyro", Value(&trial->imu_noise.gyro, "RAD/S"), "noise that is added");
  add("add-accel", Value(&trial->imu_noise.accel, "M/S^2"), "noise that is added");
  add("outliers", Value(&trial->outliers, "%"), "poses that are 10 cm and 20 deg astray");
  add("lost", Value(&trial->lost, "%"), "of the poses, in gaps of 1 s");
  add("guess", po::bool_switch(&trial->is_guessed), "start up to 180 deg and 1 m from the truth");
  add("about", po::bool_switch(about), "instead: print constants that evaluate needs");
  return options;
}

/// The trial's outcome, also when it has no result.
YAML::Node Outcome(Trial trial) {
  trial.simulator.motion = ParseMotion(trial.motion);
  if (trial.recordings < 1) throw InputError("--recordings = 0 must be at least 1");
  if (trial.is_guessed && !trial.bag.empty() && trial.reference.empty())
    throw InputError("--guess of a bag needs its --reference");
  SessionData bag;
  if (!trial.bag.empty()) {
    RecordingRequest request;
    request.paths = {trial.bag};
    request.start_s = trial.start_s;
    request.duration_s = trial.simulator.duration_s;
    bag = ReadBag(request).data;
  }
  YAML::Node outcome;
  try {
    RunTrial(trial, std::move(bag), &outcome);
  } catch (const std::exception& error) {
    outcome["verdict"] = dynamic_cast<const DataError*>(&error) ? "refused" : "failed";
    outcome["reason"] = error.what();
  }
  return outcome;
}

void Run(int argc, char** argv) {
  Trial trial;
  bool about = false;
  if (ParseOrHelp(argc, argv,
                  "Usage: evaluate_trial [options]\n\nRuns one trial of evaluate and prints what "
                  "became of it as YAML.\n\n",
                  Describe(&trial, &about), ""))
    std::cout << (about ? About() : Outcome(trial)) << "\n";
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("evaluate_trial", [&] { imu_pose_calib::Run(argc, argv); });
}
