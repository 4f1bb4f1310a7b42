#include "imu_pose_calib/ros/evaluation/experiments.h"

#include <algorithm>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kCompared = 4;  // recordings of one rig, however many are asked for
constexpr double kShort = 20.0;  // [s] where the length of a recording is not the matter

/// Values that are their own labels, in `unit` of the value that is set.
std::vector<Axis::Value> Values(const std::vector<double>& shown, double unit = 1.0) {
  std::vector<Axis::Value> values;
  for (const double value : shown) values.push_back({Format("%g", value), value * unit});
  return values;
}

/// Poses of 1 mm and 1 mrad.
Case Ordinary() {
  Case base;
  base.simulator.accel_delay_s = 2e-3;
  return base;
}

/// Recordings of one rig.
Case OneRig() {
  Case base = Ordinary();
  base.is_one_rig = true;
  return base;
}

/// A motion-capture system as that of the paper, before noise is added.
Case MotionCapture() {
  Case base = Ordinary();
  base.simulator.position_std = 1e-4;
  base.simulator.rotation_std = 2e-4;
  return base;
}

Case Guessed() {
  Case base = MotionCapture();
  base.is_random_rig = true;
  base.simulator.duration_s = base.source.duration_s = kShort;
  return base;
}

/// One axis on short simulated recordings.
Experiment OneAxis(const std::string& name, const std::string& title, const Axis& axis) {
  Experiment experiment{name, title, 10, Ordinary(), {axis}, {Base::kSimulation}};
  experiment.base.simulator.duration_s = kShort;
  return experiment;
}

/// Sets an option of the simulator.
std::function<void(double value, Case* trial)> Set(double SimulatorOptions::*option) {
  return [option](double value, Case* trial) { trial->simulator.*option = value; };
}

std::vector<Axis::Value> MotionValues() {
  std::vector<Axis::Value> values;
  for (const Motion motion : {Motion::kTumble, Motion::kHandheld, Motion::kArm, Motion::kDrone})
    values.push_back({ToString(motion), static_cast<double>(motion)});
  return values;
}

std::vector<Axis::Value> EffectValues() {
  SimulatorOptions options;
  std::vector<Axis::Value> values = {{"none", -1.0}};
  for (const Effect& effect : Effects(&options))
    values.push_back(
        {Format("%s %g", effect.name, effect.usual), static_cast<double>(values.size() - 1)});
  return values;
}

std::string FileName(std::string label) {
  for (char& c : label)
    if (c == ' ' || c == '/') c = '_';
  return label.substr(0, label.find("_["));
}

std::vector<Experiment> OfThePaper() {
  const std::vector<Base> both = {Base::kBag, Base::kSimulation};
  const std::vector<double> stds = {0.001, 0.005, 0.01};
  return {
      {"guess",
       "Robustness to the initial guess",
       200,
       Guessed(),
       {{"guess",
         {{"none", 0.0}, {"wrong", 1.0}},
         [](double value, Case* trial) { trial->is_guessed = value > 0.0; }}}},
      {"imu_noise",
       "Noise of the IMU",
       30,
       MotionCapture(),
       {{"accel [m/s^2]", Values({0.001, 0.01, 0.1}),
         [](double value, Case* trial) { trial->imu_noise.accel = value; }},
        {"gyro [rad/s]", Values(stds),
         [](double value, Case* trial) { trial->imu_noise.gyro = value; }}}},
      {"pose_noise",
       "Noise of the poses",
       30,
       MotionCapture(),
       {{"position [m]", Values(stds),
         [](double value, Case* trial) { trial->pose_noise.position = value; }},
        {"rotation [rad]", Values(stds),
         [](double value, Case* trial) { trial->pose_noise.rotation = value; }}}},
      {"repeatability", "Repeatability", 30, OneRig(), {}, both, true},
  };
}

std::vector<Experiment> OfOneAxis() {
  return {
      OneAxis("time_shift", "Time shift",
              {"time shift [s]", Values({0.0, 0.02, 1.5, 3600.0, 1e6}),
               Set(&SimulatorOptions::time_shift_s)}),
      OneAxis("accel_delay", "Delay of the accelerometer",
              {"delay [ms]", Values({-5.0, 0.0, 5.0, 20.0, 45.0}, 1e-3),
               Set(&SimulatorOptions::accel_delay_s)}),
      OneAxis("duration", "Duration",
              {"duration [s]", Values({5.1, 10.0, 20.0, 40.0, 80.0, 120.0}),
               Set(&SimulatorOptions::duration_s)}),
      OneAxis("pose_rate", "Rate of the poses",
              {"rate [Hz]", Values({5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0}),
               Set(&SimulatorOptions::pose_rate_hz)}),
      OneAxis("excitation", "Excitation",
              {"motion", MotionValues(),
               [](double value, Case* trial) {
                 trial->simulator.motion = static_cast<Motion>(value);
               }}),
      OneAxis("lever_arm", "Lever arm",
              {"distance [m]", Values({0.01, 0.03, 0.1, 0.3, 1.0}),
               [](double value, Case* trial) {
                 Eigen::Vector3d& p_MI = trial->simulator.T_MI.p;
                 p_MI = value * p_MI.normalized();
               }}),
      OneAxis("dropouts", "Dropouts of the poses",
              {"lost [%]", Values({0.0, 5.0, 10.0, 30.0, 50.0}),
               [](double value, Case* trial) { trial->lost = value; }}),
      OneAxis("outliers", "Outliers of the poses",
              {"outliers [%]", Values({0.0, 0.1, 1.0, 5.0}),
               [](double value, Case* trial) { trial->outliers = value; }}),
      OneAxis("recordings", "Number of recordings",
              {"recordings", Values({1.0, 2.0, 4.0}),
               [](double value, Case* trial) { trial->recordings = static_cast<size_t>(value); }}),
      OneAxis("effects", "What real recordings have",
              {"effect", EffectValues(),
               [](double value, Case* trial) {
                 if (value < 0.0) return;
                 const Effect effect = Effects(&trial->simulator)[static_cast<size_t>(value)];
                 *effect.strength = effect.usual;
               }}),
  };
}

}  // namespace

std::vector<Experiment> Experiments() {
  std::vector<Experiment> all = OfThePaper();
  for (const Experiment& experiment : OfOneAxis()) all.push_back(experiment);
  return all;
}

std::vector<Cell> Cells(const Experiment& experiment) {
  std::vector<Cell> cells = {{{}, "", experiment.base}};
  for (const Axis& axis : experiment.axes) {
    std::vector<Cell> finer;
    for (const Cell& cell : cells) {
      for (const auto& [label, value] : axis.values) {
        Cell one = cell;
        one.labels.push_back(label);
        one.name += (one.name.empty() ? "" : ",") + FileName(axis.name) + "_" + FileName(label);
        axis.set(value, &one.what);
        finer.push_back(one);
      }
    }
    cells.swap(finer);
  }
  if (cells.size() == 1) cells[0].name = "all";
  return cells;
}

std::vector<Trial> Trials(const Experiment& experiment, Base base, size_t trials) {
  const std::vector<Cell> cells = Cells(experiment);
  std::vector<Trial> all;
  for (const Method method : {Method::kGp, Method::kJoint}) {
    for (size_t c = 0; c < cells.size(); ++c) {
      Case what = cells[c].what;
      what.base = base;
      what.method = method;
      // The same bag gives the same again.
      const bool is_random = base == Base::kSimulation || what.is_guessed || what.outliers > 0.0 ||
                             what.pose_noise.position > 0.0 || what.imu_noise.gyro > 0.0;
      size_t count = std::max<size_t>(1, trials * experiment.trials_of_30 / 30);
      if (experiment.is_compared) count = kCompared;
      if (!is_random) count = 1;
      for (size_t i = 1; i <= count; ++i) {
        what.index = static_cast<uint32_t>(i);
        all.push_back({Format("%s/%s/%s/%s/%03zu", experiment.name.c_str(), ToString(base),
                              cells[c].name.c_str(), ToString(method), i),
                       c, what});
      }
    }
  }
  return all;
}

}  // namespace imu_pose_calib
