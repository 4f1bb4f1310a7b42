#include "imu_pose_calib/ros/evaluation/trial.h"

#include <yaml-cpp/yaml.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <random>
#include <sstream>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/solution.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/evaluation/task_runner.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr uint32_t kFirstSeed = 1000, kRecordingSeeds = 100000;
constexpr double kGuessAngle = M_PI, kGuessDistance = 1.0;                   // [rad], [m], at most
constexpr double kClocks = 3600.0;                                           // [s] at most
constexpr double kOutlierDistance = 0.1, kOutlierAngle = 20.0 / 180 * M_PI;  // [m], [rad]
constexpr double kGap = 1.0;                                                 // [s]

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

std::vector<SimulatorOptions> Truths(const Case& trial) {
  std::vector<SimulatorOptions> truths(trial.recordings, trial.simulator);
  std::mt19937 random = RandomOf(Use::kRig, trial.index);
  const Rigid3 rig = RandomTransform(&random);
  for (size_t s = 0; s < truths.size(); ++s) {
    SimulatorOptions& truth = truths[s];
    truth.seed = kFirstSeed + trial.index + kRecordingSeeds * static_cast<uint32_t>(s);
    if (trial.is_random_rig) truth.T_MI = rig;
    if (trial.is_random_rig || trial.is_one_rig || trial.recordings > 1)
      truth.time_shift_s = Uniform(&random, -kClocks, kClocks);
  }
  return truths;
}

void AddNoise(const Case& trial, std::mt19937* random, SessionData* data) {
  for (PoseSample& pose : data->poses) {
    pose.p_WM += Gaussian(random, trial.pose_noise.position);
    pose.q_WM = pose.q_WM * Exp(Gaussian(random, trial.pose_noise.rotation));
  }
  for (ImuSample& gyro : data->imus[0].gyro) gyro.value += Gaussian(random, trial.imu_noise.gyro);
  for (ImuSample& accel : data->imus[0].accel)
    accel.value += Gaussian(random, trial.imu_noise.accel);
}

void AddOutliers(const Case& trial, std::mt19937* random, SessionData* data) {
  for (PoseSample& pose : data->poses) {
    if (Uniform(random, 0.0, 100.0) >= trial.outliers) continue;
    pose.p_WM += kOutlierDistance * RandomDirection(random);
    pose.q_WM = pose.q_WM * Exp<double>(kOutlierAngle * RandomDirection(random));
  }
}

/// Loses `lost` of the poses in gaps of 1 s at even distances.
void Lose(double lost, SessionData* data) {
  if (lost <= 0.0 || data->poses.empty()) return;
  const double period = kGap * 100.0 / lost;
  const int64_t first_ns = data->poses.front().t_ns;
  const auto is_lost = [&](const PoseSample& pose) {
    const double t = Seconds(pose.t_ns - first_ns);
    return std::fmod(t, period) >= period - kGap;
  };
  auto& poses = data->poses;
  poses.erase(std::remove_if(poses.begin(), poses.end(), is_lost), poses.end());
}

/// What one calibration and its trial have in common.
void Judge(const Calibration& result, const Errors& e, TrialOutcome* outcome) {
  using Covariance = Eigen::Matrix<double, 8, 8>;
  const Marginals& marginals = result.solution->marginals;
  Eigen::MatrixXd select = Eigen::MatrixXd::Zero(8, marginals.model.cols());
  Eigen::Index row = 0;
  for (const auto& [kind, size] : {std::pair{ParameterKind::kTranslation, 3},
                                   {ParameterKind::kRotation, 3},
                                   {ParameterKind::kTimeShift, 1},
                                   {ParameterKind::kAccelDelay, 1}})
    for (int i = 0; i < size; ++i) select(row++, marginals.Find(kind) + i) = 1.0;
  const Covariance model = select * marginals.model * select.transpose();
  const Eigen::VectorXd larger = select * Enlargement(marginals.model, marginals.robust);
  const Covariance reported = larger.asDiagonal() * model * larger.asDiagonal();
  outcome->chi2 = e.dot(reported.llt().solve(e));
  outcome->model_chi2 = e.dot(model.llt().solve(e));
}

// --- YAML ---

using Numbers = std::vector<double*>;

Numbers NumbersOf(Rigid3* T) {
  double *p = T->p.data(), *q = T->q.coeffs().data();
  return {p, p + 1, p + 2, q, q + 1, q + 2, q + 3};
}

Numbers NumbersOf(ErrorNorms* norms) {
  return {&norms->translation, &norms->rotation, &norms->time_shift, &norms->accel_delay};
}

/// The lists of numbers in the YAML of an outcome, in the order in which they are written.
std::vector<std::pair<const char*, Numbers>> ListsOf(TrialOutcome* o) {
  Numbers covariance;
  for (int i = 0; i < 36; ++i) covariance.push_back(o->covariance.data() + i);
  return {{"T_MI", NumbersOf(&o->T_MI)},
          {"covariance", covariance},
          {"clocks", {&o->time_shift, &o->time_shift_std, &o->accel_delay, &o->accel_delay_std}},
          {"true_T_MI", NumbersOf(&o->truth.T_MI)},
          {"true_clocks", {&o->truth.time_shift, &o->truth.accel_delay}},
          {"chi2", {&o->chi2, &o->model_chi2}},
          {"least", NumbersOf(&o->bounds.least)},
          {"as_joint", NumbersOf(&o->bounds.as_joint)},
          {"guess", {&o->guess_angle, &o->guess_distance}}};
}

}  // namespace

const char* ToString(Base base) { return base == Base::kBag ? "sample" : "simulation"; }

std::string Describe(const Case& trial) {
  std::ostringstream text;
  text.precision(10);
  text << kVersion << " " << ToString(trial.method) << " trial " << trial.index;
  if (trial.base == Base::kBag) {
    text << " " << DescribeFile(trial.source.path) << " from " << trial.source.start_s << " for "
         << trial.source.duration_s;
  } else {
    SimulatorOptions s = trial.simulator;
    Eigen::Matrix<double, 7, 1> T_MI;
    T_MI << s.T_MI.p, s.T_MI.q.coeffs();
    text << " " << ToString(s.motion) << " " << s.duration_s << " s, " << s.pose_rate_hz << " "
         << s.gyro_rate_hz << " " << s.accel_rate_hz << " Hz, " << s.position_std << " "
         << s.rotation_std << " " << s.gyro_std << " " << s.accel_std << ", bias "
         << s.gyro_bias.transpose() << " " << s.gyro_bias_walk << " " << s.accel_bias.transpose()
         << " " << s.accel_bias_walk << ", T_MI " << YamlNumbers(T_MI) << ", " << s.time_shift_s
         << " " << s.accel_delay_s << " s";
    for (const Effect& effect : Effects(&s))
      if (*effect.strength != 0.0) text << ", " << effect.name << " " << *effect.strength;
    text << "; recordings " << trial.recordings << (trial.is_random_rig ? " random" : "")
         << (trial.is_one_rig ? " one rig" : "");
  }
  text << "; added " << trial.pose_noise.position << " " << trial.pose_noise.rotation << " "
       << trial.imu_noise.gyro << " " << trial.imu_noise.accel << ", outliers " << trial.outliers
       << ", lost " << trial.lost << (trial.is_guessed ? ", guessed" : "");
  return text.str();
}

Errors ErrorsOf(const Comparable& estimate, const Comparable& truth) {
  Errors errors;
  errors << estimate.T_MI.p - truth.T_MI.p,
      Log(Eigen::Quaterniond(truth.T_MI.q.conjugate() * estimate.T_MI.q)),
      estimate.time_shift - truth.time_shift, estimate.accel_delay - truth.accel_delay;
  return errors;
}

ErrorNorms NormsOf(const Errors& errors) {
  const Eigen::Vector3d translation = errors.head<3>(), rotation = errors.segment<3>(3);
  return {translation.norm(), rotation.norm(), std::abs(errors[6]), std::abs(errors[7])};
}

void Take(const Calibration& result, TrialOutcome* outcome) {
  outcome->verdict = ToString(result.status);
  outcome->reason = result.message;
  if (!result.IsUsable()) return;
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& clock = result.sessions[0].imus[0];
  outcome->warnings = result.warnings.size();
  outcome->T_MI = imu.T_MI;
  outcome->covariance = imu.covariance;
  outcome->time_shift = clock.time_shift;
  outcome->time_shift_std = clock.time_shift_std;
  outcome->accel_delay = imu.accel_delay;
  outcome->accel_delay_std = imu.accel_delay_std;
}

TrialOutcome RunTrial(const Case& trial, const SessionData& bag, const TrialOutcome& reference) {
  TrialOutcome outcome;
  std::vector<SimulatorOptions> truths;
  std::vector<SessionData> recordings = {bag};
  const bool is_simulated = trial.base == Base::kSimulation;
  if (is_simulated) {
    truths = Truths(trial);
    recordings.clear();
    for (const SimulatorOptions& truth : truths) recordings.push_back(Simulate(truth));
    const TrueClock clock(truths[0]);
    outcome.truth.T_MI = truths[0].T_MI;
    outcome.truth.time_shift = clock.time_shift_s;
    outcome.truth.accel_delay = clock.accel_delay_s;
  }
  for (size_t s = 0; s < recordings.size(); ++s) {
    std::mt19937 noise = RandomOf(Use::kNoise, trial.index, s);
    std::mt19937 outliers = RandomOf(Use::kOutliers, trial.index, s);
    AddNoise(trial, &noise, &recordings[s]);
    AddOutliers(trial, &outliers, &recordings[s]);
    Lose(trial.lost, &recordings[s]);
  }
  if (is_simulated && trial.method == Method::kJoint) {
    for (SimulatorOptions& truth : truths) {
      truth.position_std = std::hypot(truth.position_std, trial.pose_noise.position);
      truth.rotation_std = std::hypot(truth.rotation_std, trial.pose_noise.rotation);
      truth.gyro_std = std::hypot(truth.gyro_std, trial.imu_noise.gyro);
      truth.accel_std = std::hypot(truth.accel_std, trial.imu_noise.accel);
    }
    outcome.bounds = FindErrorBounds(truths, recordings);
  }

  CalibrationOptions options;
  options.method = trial.method;
  options.num_threads = 1;  // trials run side by side, and give the same on any machine
  if (trial.is_guessed) {
    std::mt19937 random = RandomOf(Use::kGuess, trial.index);
    const Rigid3 away = RandomTransform(&random);
    const Rigid3& truth = is_simulated ? outcome.truth.T_MI : reference.T_MI;
    options.initial_rotation = truth.q * away.q;
    options.initial_translation = truth.p + away.p;
    outcome.guess_angle = Eigen::Quaterniond::Identity().angularDistance(away.q);
    outcome.guess_distance = away.p.norm();
  }
  try {
    const Calibration result = Calibrate(options, recordings);
    Take(result, &outcome);
    if (result.IsUsable() && is_simulated)
      Judge(result, ErrorsOf(outcome, outcome.truth), &outcome);
  } catch (const DataError& error) {
    outcome.verdict = "refused";
    outcome.reason = error.what();
  }
  return outcome;
}

std::string ToYaml(TrialOutcome outcome) {
  YAML::Emitter reason;
  reason << YAML::DoubleQuoted << outcome.reason;
  std::string text = "verdict: " + outcome.verdict + "\nreason: " + reason.c_str() +
                     "\nwarnings: " + std::to_string(outcome.warnings) + "\n";
  for (const auto& [key, numbers] : ListsOf(&outcome)) {
    Eigen::VectorXd values(static_cast<Eigen::Index>(numbers.size()));
    for (size_t i = 0; i < numbers.size(); ++i) values[static_cast<Eigen::Index>(i)] = *numbers[i];
    text += key + (": " + YamlNumbers(values)) + "\n";
  }
  return text;
}

TrialOutcome ParseOutcome(const std::string& text) {
  TrialOutcome outcome;
  const std::string failed = kFailed + std::string(": ");
  if (text.rfind(failed, 0) == 0) {
    outcome.verdict = kFailed;
    outcome.reason = text.substr(failed.size());
    return outcome;
  }
  const YAML::Node node = YAML::Load(text);
  outcome.verdict = node["verdict"].as<std::string>();
  outcome.reason = node["reason"].as<std::string>();
  outcome.warnings = node["warnings"].as<size_t>();
  for (const auto& [key, numbers] : ListsOf(&outcome)) {
    const auto values = node[key].as<std::vector<double>>();
    for (size_t i = 0; i < numbers.size(); ++i) *numbers[i] = values.at(i);
  }
  return outcome;
}

}  // namespace imu_pose_calib
