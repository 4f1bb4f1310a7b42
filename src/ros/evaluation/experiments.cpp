#include "imu_pose_calib/ros/evaluation/experiments.h"

#include <algorithm>

#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

const std::vector<Base> kBoth = {Base::kBag, Base::kSimulation};

/// Values that are their own labels, in `unit` of the value that is set.
std::vector<Axis::Value> Values(const std::vector<double>& shown, double unit = 1.0) {
  std::vector<Axis::Value> values;
  for (const double value : shown) values.push_back({Format("%g", value), value * unit});
  return values;
}

constexpr double kShort = 20.0;  // [s] where the length of a recording is not the matter

/// Poses of 1 mm and 1 mrad.
Case Ordinary() {
  Case base;
  base.simulator.accel_delay_s = 2e-3;
  return base;
}

/// A motion-capture system as that of the paper, before noise is added.
Case MotionCapture() {
  Case base = Ordinary();
  base.simulator.position_std = 1e-4;
  base.simulator.rotation_std = 2e-4;
  return base;
}

Experiment Guess() {
  Experiment guess;
  guess.name = "guess";
  guess.title = "Robustness to the initial guess";
  guess.remark =
      "Figure 3 of the paper: guesses up to 180 deg and 1 m off, and none. Recordings of 20 s; in "
      "simulation the transform itself is as random, and the clocks are up to an hour apart.";
  guess.bases = kBoth;
  guess.axes = {{"guess", {{"none", 0.0}, {"wrong", 1.0}}, [](double value, Case* trial) {
                   trial->is_guessed = value > 0.0;
                 }}};
  guess.trials = [](size_t trials, Base) { return trials * 20 / 3; };
  guess.base = MotionCapture();
  guess.base.is_random_rig = true;
  guess.base.simulator.duration_s = guess.base.source.duration_s = kShort;
  return guess;
}

/// What the experiments with noise have in common.
Experiment Noise(const std::string& name, const std::string& title) {
  Experiment noise;
  noise.name = name;
  noise.title = title;
  noise.bases = kBoth;
  noise.trials = [](size_t trials, Base) { return trials; };
  noise.base = MotionCapture();
  return noise;
}

Experiment ImuNoise() {
  Experiment noise = Noise("imu_noise", "Noise of the IMU");
  noise.remark = "White noise added to accelerometer [m/s^2] and gyroscope [rad/s].";
  noise.printed_in = "Tables 2 and 3";
  noise.printed = {{0.0012, 0.050}, {0.0053, 0.043}, {0.0129, 0.049},
                   {0.0011, 0.498}, {0.0060, 0.654}, {0.0102, 0.638},
                   {0.0012, 1.776}, {0.0055, 1.865}, {0.0115, 1.850}};
  noise.axes = {{"accel [m/s^2]", Values({0.001, 0.01, 0.1}),
                 [](double value, Case* trial) { trial->imu_noise.accel = value; }},
                {"gyro [rad/s]", Values({0.001, 0.005, 0.01}),
                 [](double value, Case* trial) { trial->imu_noise.gyro = value; }}};
  return noise;
}

Experiment PoseNoise() {
  Experiment noise = Noise("pose_noise", "Noise of the poses");
  noise.remark = "White noise added to positions [m] and rotations [rad].";
  noise.printed_in = "Tables 4 and 5";
  noise.printed = {{0.011, 3.38}, {0.065, 3.07}, {0.118, 4.08}, {0.011, 12.4}, {0.056, 11.7},
                   {0.135, 13.8}, {0.011, 16.7}, {0.064, 21.7}, {0.125, 23.5}};
  noise.axes = {{"position [m]", Values({0.001, 0.005, 0.01}),
                 [](double value, Case* trial) { trial->pose_noise.position = value; }},
                {"rotation [rad]", Values({0.001, 0.005, 0.01}),
                 [](double value, Case* trial) { trial->pose_noise.rotation = value; }}};
  return noise;
}

Experiment RepeatabilityExperiment() {
  Experiment repeat;
  repeat.name = "repeatability";
  repeat.title = "Repeatability";
  repeat.remark =
      "Recordings of one rig, each calibrated alone and compared with every other: what Table 1 of "
      "the paper is about.";
  repeat.bases = kBoth;
  repeat.trials = [](size_t, Base base) -> size_t { return base == Base::kBag ? 1 : 4; };
  repeat.is_compared = true;
  repeat.base = Ordinary();
  repeat.base.is_one_rig = true;
  return repeat;
}

/// An experiment with one axis, on short simulated recordings.
Experiment OneAxis(const std::string& name, const std::string& title, const std::string& remark,
                   const Axis& axis) {
  Experiment experiment;
  experiment.name = name;
  experiment.title = title;
  experiment.remark = remark;
  experiment.bases = {Base::kSimulation};
  experiment.axes = {axis};
  experiment.trials = [](size_t trials, Base) { return std::max<size_t>(1, trials / 3); };
  experiment.base = Ordinary();
  experiment.base.simulator.duration_s = kShort;
  return experiment;
}

std::vector<Axis::Value> MotionValues() {
  std::vector<Axis::Value> values;
  for (const Motion motion : {Motion::kTumble, Motion::kHandheld, Motion::kArm, Motion::kDrone})
    values.push_back({ToString(motion), static_cast<double>(motion)});
  return values;
}

std::vector<Axis::Value> EffectValues() {
  std::vector<Axis::Value> values = {{"none", -1.0}};
  for (const EffectOption& effect : EffectOptions())
    values.push_back(
        {Format("%s %g", effect.name, effect.usual), static_cast<double>(values.size() - 1)});
  return values;
}

void SetEffect(double value, Case* trial) {
  if (value < 0.0) return;
  const EffectOption& effect = EffectOptions()[static_cast<size_t>(value)];
  effect.strength(&trial->simulator) = effect.usual;
}

std::string FileName(std::string label) {
  for (char& c : label)
    if (c == ' ' || c == '/') c = '_';
  return label.substr(0, label.find("_["));
}

}  // namespace

std::vector<Experiment> Experiments() {
  const auto simulator = [](auto set) {
    return [set](double value, Case* trial) { set(value, &trial->simulator); };
  };
  using Options = SimulatorOptions;
  return {
      Guess(),
      ImuNoise(),
      PoseNoise(),
      RepeatabilityExperiment(),
      OneAxis("time_shift", "Time shift",
              "True shift between the clocks, which nothing tells the calibration.",
              {"time shift [s]", Values({0.0, 0.02, 1.5, 3600.0, 1e6}),
               simulator([](double value, Options* o) { o->time_shift_s = value; })}),
      OneAxis("accel_delay", "Delay of the accelerometer",
              "True delay of the accelerometer's samples against the gyroscope's.",
              {"delay [ms]", Values({-5.0, 0.0, 5.0, 20.0, 45.0}, 1e-3),
               simulator([](double value, Options* o) { o->accel_delay_s = value; })}),
      OneAxis("duration", "Duration", "Poses have to span 5 s.",
              {"duration [s]", Values({5.1, 10.0, 20.0, 40.0, 80.0, 120.0}),
               simulator([](double value, Options* o) { o->duration_s = value; })}),
      OneAxis("pose_rate", "Rate of the poses", "",
              {"rate [Hz]", Values({5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0}),
               simulator([](double value, Options* o) { o->pose_rate_hz = value; })}),
      OneAxis("excitation", "Excitation",
              "Motions of the simulator, from many full turns to the hovering of a drone.",
              {"motion", MotionValues(), simulator([](double value, Options* o) {
                 o->motion = static_cast<Motion>(value);
               })}),
      OneAxis("lever_arm", "Lever arm", "Distance between marker and IMU.",
              {"distance [m]", Values({0.01, 0.03, 0.1, 0.3, 1.0}),
               simulator(
                   [](double value, Options* o) { o->T_MI.p = value * o->T_MI.p.normalized(); })}),
      OneAxis("dropouts", "Dropouts of the poses",
              "Share of the time that is lost, in gaps of 1 s.",
              {"lost [%]", Values({0.0, 5.0, 10.0, 30.0, 50.0}),
               [](double value, Case* trial) { trial->lost = value; }}),
      OneAxis("outliers", "Outliers of the poses", "Poses that are 10 cm and 20 deg astray.",
              {"outliers [%]", Values({0.0, 0.1, 1.0, 5.0}),
               [](double value, Case* trial) { trial->outliers = value; }}),
      OneAxis("recordings", "Number of recordings", "Recordings of one rig, calibrated together.",
              {"recordings", Values({1.0, 2.0, 4.0}),
               [](double value, Case* trial) { trial->recordings = static_cast<size_t>(value); }}),
      OneAxis("effects", "What real recordings have",
              "Each effect of the simulator alone, at its usual strength. The bound knows nothing "
              "of them.",
              {"effect", EffectValues(), SetEffect}),
  };
}

std::vector<Cell> Cells(const Experiment& experiment) {
  std::vector<Cell> cells = {{{}, "", [](Case*) {}}};
  for (const Axis& axis : experiment.axes) {
    std::vector<Cell> finer;
    for (const Cell& cell : cells) {
      for (const Axis::Value& value : axis.values) {
        Cell one = cell;
        one.labels.push_back(value.label);
        one.name +=
            (one.name.empty() ? "" : ",") + FileName(axis.name) + "_" + FileName(value.label);
        one.set = [before = cell.set, set = axis.set, value = value.value](Case* trial) {
          before(trial);
          set(value, trial);
        };
        finer.push_back(one);
      }
    }
    cells.swap(finer);
  }
  if (cells.size() == 1) cells[0].name = "all";
  return cells;
}

std::vector<Trial> Trials(const Experiment& experiment, const Cell& cell, Base base, Method method,
                          size_t trials) {
  Case what = experiment.base;
  what.base = base;
  what.method = method;
  cell.set(&what);
  size_t count = experiment.trials(trials, base);
  // The same bag gives the same again.
  const bool is_random = base == Base::kSimulation || what.is_guessed || what.outliers > 0.0 ||
                         what.pose_noise.position > 0.0 || what.imu_noise.gyro > 0.0;
  if (!is_random) count = 1;
  std::vector<Trial> all;
  for (size_t i = 1; i <= count; ++i) {
    what.index = static_cast<uint32_t>(i);
    all.push_back({Format("%s/%s/%s/%s/%03zu", experiment.name.c_str(), ToString(base),
                          cell.name.c_str(), ToString(method), i),
                   what});
  }
  return all;
}

}  // namespace imu_pose_calib
