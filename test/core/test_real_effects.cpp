#include <gtest/gtest.h>

#include <Eigen/QR>
#include <cmath>
#include <map>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::MatrixXd;
using Eigen::Quaterniond;
using Eigen::Vector3d;

SimulatorOptions Recording(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  options.seed = 31;
  return options;
}

SimulatorOptions Clean(double duration_s) {
  SimulatorOptions options = WithoutNoise(Recording(duration_s));
  options.position_std = options.rotation_std = 0.0;
  return options;
}

MatrixXd Values(const std::vector<ImuSample>& samples) {
  MatrixXd values(3, samples.size());
  for (size_t k = 0; k < samples.size(); ++k)
    values.col(static_cast<Eigen::Index>(k)) = samples[k].value;
  return values;
}

double Rms(const MatrixXd& x) { return std::sqrt(x.squaredNorm() / static_cast<double>(x.size())); }

/// M of y = M x for columns y and x, and what it leaves [rms].
MatrixXd Regress(const MatrixXd& y, const MatrixXd& x, double* rest) {
  const MatrixXd M = x.transpose().colPivHouseholderQr().solve(y.transpose()).transpose();
  *rest = Rms(y - M * x);
  return M;
}

// --- What an effect touches ---

TEST(RealEffects, AreOffByDefault) {
  // As if there were none: truth, and one generator for poses, gyroscope and accelerometer.
  SimulatorOptions options = Recording(2.0);
  const SessionData data = Simulate(options);
  const TrueTrajectory truth(options);
  std::mt19937 random(options.seed + 1000003u);
  const auto noise = [&](double sigma) {
    std::normal_distribution<double> normal(0.0, sigma);
    Vector3d v;
    for (int i = 0; i < 3; ++i) v[i] = normal(random);
    return v;
  };
  ASSERT_EQ(data.poses.size(), 200u);
  for (size_t k = 0; k < data.poses.size(); ++k) {
    const TrueState s = truth.At(0.01 * static_cast<double>(k));
    const Quaterniond q = Quaterniond(s.R_WM) * Exp<double>(noise(options.rotation_std));
    const Vector3d p = s.p_WM + noise(options.position_std);
    EXPECT_EQ(data.poses[k].t_ns, options.start_ns + 10'000'000 * static_cast<int64_t>(k));
    EXPECT_LT((data.poses[k].q_WM.coeffs() - q.coeffs()).norm(), 1e-14);
    EXPECT_LT((data.poses[k].p_WM - p).norm(), 1e-14);
  }
  Vector3d bias = options.gyro_bias;
  ASSERT_EQ(data.imus[0].gyro.size(), 400u);
  for (size_t k = 0; k < data.imus[0].gyro.size(); ++k) {
    const Vector3d omega_M = truth.At(0.005 * static_cast<double>(k)).omega_M;
    const Vector3d w = options.T_MI.q.conjugate() * omega_M + bias + noise(options.gyro_std);
    bias += noise(options.gyro_bias_walk / std::sqrt(200.0));
    EXPECT_LT((data.imus[0].gyro[k].value - w).norm(), 1e-13);
  }
  const TrueClock clock(options);
  EXPECT_EQ(clock.time_shift_s, options.time_shift_s);
  EXPECT_EQ(clock.accel_delay_s, options.accel_delay_s);
}

TEST(RealEffects, EachChangesWhatItSaysAndNothingElse) {
  // p: values of poses, P: their stamps, g, a: values of the sensors, I: stamps, -: fewer samples
  const std::map<std::string, std::vector<std::string>> kEffects = {
      {"pga", {"vibration", "rocking", "shocks"}},
      {"g", {"gyro-filter", "g-sensitivity"}},
      {"a", {"accel-filter", "size-effect", "gravity", "soft-mount"}},
      {"ga", {"scale-misalignment", "temperature-drift", "clock-drift"}},
      {"p",
       {"pose-exposure", "pose-scale", "slow-errors", "marker-offset", "fused-poses",
        "pose-updates", "pose-drift"}},
      {"P", {"pose-jitter", "pose-latency", "pose-burst", "pose-stamp-step", "pose-clock-step"}},
      {"I",
       {"imu-jitter", "imu-latency", "imu-burst", "imu-stamp-step", "imu-wander",
        "imu-clock-step"}},
      {"P-", {"pose-drops"}},
      {"I-", {"imu-drops"}}};
  std::map<std::string, std::string> touched_by;
  for (const auto& [touched, names] : kEffects)
    for (const std::string& name : names) touched_by[name] = touched;
  const SessionData plain = Simulate(Recording(4.0));
  SimulatorOptions options = Recording(4.0);
  ASSERT_EQ(Effects(&options).size(), touched_by.size());
  for (const Effect& effect : Effects(&options)) {
    SCOPED_TRACE(effect.name);
    EXPECT_EQ(*effect.strength, 0.0);
    *effect.strength = effect.usual;
    const SessionData data = Simulate(options);
    *effect.strength = 0.0;
    const std::string& touched = touched_by.at(effect.name);
    const auto is = [&](char what) { return touched.find(what) != std::string::npos; };
    const auto expect = [&](const auto& with, const auto& without, char value, char stamp,
                            const auto& same) {
      if (is(stamp) && is('-')) {
        EXPECT_LT(with.size(), without.size());
        return;
      }
      ASSERT_EQ(with.size(), without.size());
      bool same_values = true, same_stamps = true;
      for (size_t k = 0; k < with.size(); ++k) {
        same_values &= same(with[k], without[k]);
        same_stamps &= with[k].t_ns == without[k].t_ns;
      }
      EXPECT_EQ(same_values, !is(value)) << value;
      EXPECT_EQ(same_stamps, !is(stamp)) << stamp;
    };
    const auto same_pose = [](const PoseSample& a, const PoseSample& b) {
      return a.p_WM == b.p_WM && a.q_WM.coeffs() == b.q_WM.coeffs();
    };
    const auto same_sample = [](const ImuSample& a, const ImuSample& b) {
      return a.value == b.value;
    };
    expect(data.poses, plain.poses, 'p', 'P', same_pose);
    expect(data.imus[0].gyro, plain.imus[0].gyro, 'g', 'I', same_sample);
    expect(data.imus[0].accel, plain.imus[0].accel, 'a', 'I', same_sample);
    // One message holds both.
    ASSERT_EQ(data.imus[0].gyro.size(), data.imus[0].accel.size());
    for (size_t k = 0; k < data.imus[0].gyro.size(); ++k)
      ASSERT_EQ(data.imus[0].gyro[k].t_ns, data.imus[0].accel[k].t_ns);
  }
}

// --- Motion of the body ---

TEST(Shakes, DerivativesOfTheBodyAreExact) {
  for (const char* name : {"vibration", "rocking", "shocks"}) {
    SCOPED_TRACE(name);
    SimulatorOptions options = Recording(20.0);
    options.motion = Motion::kTumble;
    for (const Effect& effect : Effects(&options))
      if (effect.name == std::string(name)) *effect.strength = effect.usual;
    const TrueTrajectory trajectory(options);
    for (double t = 0.1; t < 20.0; t += 0.0737) {
      const auto rate = [&](Vector3d TrueState::*member) {
        return Vector3d(NumericRate([&](double at) { return trajectory.At(at).*member; }, t, 1e-4));
      };
      const TrueState at = trajectory.At(t);
      EXPECT_LT((at.v_W - rate(&TrueState::p_WM)).norm(), 1e-5) << t;
      EXPECT_LT((at.a_W - rate(&TrueState::v_W)).norm(), 1e-3) << t;
      EXPECT_LT((at.alpha_M - rate(&TrueState::omega_M)).norm(), 1e-2) << t;
      const auto turned = [&](double h) {
        return Log(Quaterniond(Matrix3d(at.R_WM.transpose() * trajectory.At(t + h).R_WM)));
      };
      EXPECT_LT((at.omega_M - NumericRate(turned, 0.0, 1e-4)).norm(), 1e-5) << t;
    }
  }
}

/// Position, velocity, ... of the body with an effect less without, columns over time.
MatrixXd Added(const SimulatorOptions& options, Vector3d TrueState::*member, double step = 2e-3) {
  SimulatorOptions calm = options;
  calm.effects = {};
  const TrueTrajectory with(options), without(calm);
  MatrixXd added(3, static_cast<Eigen::Index>(options.duration_s / step));
  for (Eigen::Index k = 0; k < added.cols(); ++k) {
    const double t = step * static_cast<double>(k);
    added.col(k) = with.At(t).*member - without.At(t).*member;
  }
  return added;
}

TEST(Vibration, HasItsStrengthInItsBandAlone) {
  SimulatorOptions options = Recording(5.0);
  options.motion = Motion::kStatic;
  options.effects.vibration = 3.0;
  const MatrixXd a = Added(options, &TrueState::a_W);
  EXPECT_NEAR(Rms(a), 3.0, 0.1);
  EXPECT_NEAR(Rms(Added(options, &TrueState::alpha_M)), 15.0, 0.5);
  const auto power = [&](double hz) {  // [(m/s^2)^2 / Hz], all axes
    Vector3d re = Vector3d::Zero(), im = re;
    for (Eigen::Index k = 0; k < a.cols(); ++k) {
      const double x = static_cast<double>(k) / static_cast<double>(a.cols());
      const double window = 1.0 - std::cos(2.0 * M_PI * x);
      re += window * std::cos(2.0 * M_PI * hz * options.duration_s * x) * a.col(k);
      im += window * std::sin(2.0 * M_PI * hz * options.duration_s * x) * a.col(k);
    }
    return re.squaredNorm() + im.squaredNorm();
  };
  double in_band = 0.0, outside = 0.0;
  for (double hz = 1.0; hz < 18.0; hz += 1.7) outside += power(hz) + power(hz + 81.0);
  for (double hz = 20.0; hz < 80.0; hz += 0.2) in_band += power(hz);
  EXPECT_LT(outside, 1e-4 * in_band);
}

TEST(Rocking, IsAboutAPointOfTheBody) {
  SimulatorOptions options = Recording(5.0);
  options.effects.rocking = 0.2;
  EXPECT_NEAR(Rms(Added(options, &TrueState::omega_M)), 0.2, 0.02);
  SimulatorOptions calm = options;
  calm.effects = {};
  const TrueTrajectory with(options), without(calm);
  // (R' - R) pivot = p - p'
  MatrixXd A(300, 3), b(300, 1);
  for (int k = 0; k < 100; ++k) {
    const TrueState rocked = with.At(0.05 * k), still = without.At(0.05 * k);
    A.middleRows<3>(3 * k) = rocked.R_WM - still.R_WM;
    b.middleRows<3>(3 * k) = still.p_WM - rocked.p_WM;
  }
  const Vector3d pivot = A.colPivHouseholderQr().solve(b);
  EXPECT_NEAR(pivot.norm(), 0.2, 1e-9);
  EXPECT_LT((A * pivot - b).norm(), 1e-12);
  EXPECT_GT(b.cwiseAbs().maxCoeff(), 1e-4);
}

TEST(Shocks, AreShortAndLeaveNothingBehind) {
  SimulatorOptions options = Recording(40.0);
  options.motion = Motion::kStatic;
  options.effects.shocks = 30.0;
  const MatrixXd a = Added(options, &TrueState::a_W), p = Added(options, &TrueState::p_WM);
  int shocks = 0, shaken = 0;
  for (Eigen::Index k = 1; k < a.cols(); ++k) {
    shocks += a.col(k).norm() > 15.0 && a.col(k - 1).norm() <= 15.0 ? 1 : 0;
    shaken += a.col(k).norm() > 1.0 ? 1 : 0;
  }
  EXPECT_GT(shocks, 12);
  EXPECT_LT(shocks, 45);           // the swing back may count again
  EXPECT_LT(shaken, 30 * shocks);  // 60 ms each
  EXPECT_NEAR(a.colwise().norm().maxCoeff(), 30.0, 3.0);
  EXPECT_LT(p.colwise().norm().maxCoeff(), 3e-3);
  double least = 1.0;
  for (Eigen::Index k = 0; k < p.cols(); ++k) least = std::min(least, p.col(k).norm());
  EXPECT_LT(least, 1e-6);
}

TEST(TrueTrajectory, ArmRestsBetweenItsMoves) {
  SimulatorOptions options = Recording(60.0);
  options.motion = Motion::kArm;
  const TrueTrajectory trajectory(options);
  int resting = 0, stops = 0;
  double fastest = 0.0, farthest = 0.0;
  bool was_resting = false;
  for (int k = 0; k < 6000; ++k) {
    const TrueState s = trajectory.At(0.01 * k);
    const bool rests = s.omega_M.norm() == 0.0 && s.v_W.norm() == 0.0;
    resting += rests ? 1 : 0;
    stops += rests && !was_resting ? 1 : 0;
    was_resting = rests;
    fastest = std::max(fastest, s.omega_M.norm());
    farthest =
        std::max(farthest, Eigen::AngleAxisd(trajectory.At(0.0).R_WM.transpose() * s.R_WM).angle());
  }
  EXPECT_GT(resting, 600);
  EXPECT_LT(resting, 2400);
  EXPECT_GT(stops, 13);
  EXPECT_LT(stops, 40);
  EXPECT_GT(fastest, 0.7);
  EXPECT_LT(fastest, 3.0);
  EXPECT_GT(farthest, 0.8);
}

TEST(TrueTrajectory, DroneIsPushedAsideByItsTilt) {
  SimulatorOptions options = Recording(40.0);
  options.motion = Motion::kDrone;
  const TrueTrajectory trajectory(options);
  double largest = 0.0;
  MatrixXd aside(2, 4000), tilt(2, 4000);
  for (int k = 0; k < 4000; ++k) {
    const TrueState s = trajectory.At(0.01 * k);
    const Vector3d up = s.R_WM.col(2);
    tilt.col(k) = up.head<2>() / up.z();
    aside.col(k) = s.a_W.head<2>();
    largest = std::max(largest, std::acos(up.z()));
  }
  EXPECT_GT(largest, 0.1);
  EXPECT_LT(largest, 0.3);
  EXPECT_LT(Rms(aside - 9.80665 * tilt), 0.02 * Rms(aside));
  EXPECT_GT(Rms(aside), 0.3);
}

// --- IMU ---

TEST(Filter, DelaysAndAttenuatesASine) {
  const double cutoff = 30.0, rate = 400.0;
  for (const double hz : {2.0, 10.0, 30.0, 90.0}) {
    SCOPED_TRACE(hz);
    const double w = 2.0 * M_PI * hz, ratio = hz / cutoff;
    const auto sine = [&](double t) { return Vector3d(std::sin(w * t), 1.0, -std::cos(w * t)); };
    const std::vector<Vector3d> samples = Sampled(sine, rate, 400, cutoff);
    const double gain = 1.0 / std::sqrt(1.0 + ratio * ratio), delay = std::atan(ratio) / w;
    for (size_t k = 0; k < samples.size(); k += 7) {
      const Vector3d late = sine(static_cast<double>(k) / rate - delay);
      EXPECT_NEAR(samples[k].x(), gain * late.x(), 4e-3);
      EXPECT_NEAR(samples[k].y(), 1.0, 1e-12);
      EXPECT_NEAR(samples[k].z(), gain * late.z(), 4e-3);
    }
  }
  EXPECT_NEAR(FilterDelay(cutoff), 1.0 / (2.0 * M_PI * cutoff), 1e-15);
}

TEST(Filter, MovesTheTrueClockByItsDelay) {
  SimulatorOptions options = Clean(10.0);
  options.effects.gyro_filter_hz = 40.0;
  options.effects.accel_filter_hz = 15.0;
  options.clock_drift = 1e-4;
  const TrueClock clock(options);
  const double tau_g = FilterDelay(40.0), tau_a = FilterDelay(15.0);
  EXPECT_NEAR(clock.time_shift_s, options.time_shift_s - tau_g, 1e-15);
  EXPECT_NEAR(clock.accel_delay_s, tau_a - tau_g, 1e-15);
  SimulatorOptions moved = options;
  moved.effects = {};
  moved.time_shift_s = clock.time_shift_s;
  moved.accel_delay_s = clock.accel_delay_s;
  // The same motion under stamps that differ by tau_g: 4 ms, of 500 Hz.
  options.gyro_rate_hz = options.accel_rate_hz = moved.gyro_rate_hz = moved.accel_rate_hz = 500.0;
  const SessionData filtered = Simulate(options), late = Simulate(moved), now = [&] {
    SimulatorOptions plain = options;
    plain.effects = {};
    return Simulate(plain);
  }();
  const auto compare = [&](std::vector<ImuSample> ImuData::*sensor, double left) {
    MatrixXd at_stamps = Values(late.imus[0].*sensor);  // interpolated to the stamps of `filtered`
    const MatrixXd f = Values(filtered.imus[0].*sensor), n = Values(now.imus[0].*sensor);
    const double steps = 500.0 * (clock.time_shift_s - options.time_shift_s);  // negative
    const Eigen::Index whole = static_cast<Eigen::Index>(std::floor(steps));
    const double part = steps - std::floor(steps);
    double off = 0.0, plain_off = 0.0;
    for (Eigen::Index k = 10; k + 10 < f.cols(); ++k) {
      const Vector3d at =
          (1.0 - part) * at_stamps.col(k + whole) + part * at_stamps.col(k + whole + 1);
      off += (f.col(k) - at).squaredNorm();
      plain_off += (f.col(k) - n.col(k)).squaredNorm();
    }
    EXPECT_LT(std::sqrt(off / plain_off), left);
  };
  compare(&ImuData::gyro, 0.1);
  compare(&ImuData::accel, 0.15);
}

TEST(ScaleMisalignment, IsAMatrixOfEachSensor) {
  SimulatorOptions options = Clean(5.0);
  const SessionData exact = Simulate(options);
  options.effects.scale_misalignment = 0.01;
  double squares = 0.0;
  for (uint32_t seed = 1; seed <= 20; ++seed) {
    options.noise_seed = seed;
    const SessionData data = Simulate(options);
    double rest = 0.0;
    const MatrixXd gyro = Regress(Values(data.imus[0].gyro), Values(exact.imus[0].gyro), &rest);
    EXPECT_LT(rest, 1e-12);
    EXPECT_LT(std::abs(gyro(0, 1)) + std::abs(gyro(0, 2)) + std::abs(gyro(1, 2)), 1e-12);
    const MatrixXd accel = Regress(Values(data.imus[0].accel), Values(exact.imus[0].accel), &rest);
    EXPECT_LT(rest, 1e-12);
    squares += (gyro - Matrix3d::Identity()).squaredNorm() / 6.0 / 40.0 +
               (accel - Matrix3d::Identity()).squaredNorm() / 9.0 / 40.0;
  }
  EXPECT_NEAR(std::sqrt(squares), 0.01, 0.001);
}

TEST(SizeEffect, MovesEachAxisOfTheAccelerometer) {
  SimulatorOptions options = Clean(5.0);
  const MatrixXd exact = Values(Simulate(options).imus[0].accel);
  options.effects.size_effect = 0.02;
  const MatrixXd off = Values(Simulate(options).imus[0].accel) - exact;
  const TrueTrajectory truth(options);
  const Matrix3d R_IM = options.T_MI.q.toRotationMatrix().transpose();
  Matrix3d axes;  // columns, in I
  for (int axis = 0; axis < 3; ++axis) {
    // off_i = e_i^T R_IM (hat(alpha) + hat(omega)^2) R_MI r_i
    MatrixXd x(3, off.cols());
    for (Eigen::Index k = 0; k < off.cols(); ++k) {
      const TrueState s = truth.At(0.005 * static_cast<double>(k));
      const Matrix3d W = Hat(s.omega_M);
      x.col(k) = (R_IM.row(axis) * (Hat(s.alpha_M) + W * W) * R_IM.transpose()).transpose();
    }
    double rest = 0.0;
    axes.col(axis) = Regress(off.row(axis), x, &rest).transpose();
    EXPECT_LT(rest, 1e-10);
  }
  for (int i = 0; i < 3; ++i) {
    const double distance = axes.row(i).maxCoeff() - axes.row(i).minCoeff();
    EXPECT_GT(distance, 1e-3);
    EXPECT_LT(distance, 0.02);
    EXPECT_NEAR(axes.row(i).sum() - axes(i, i), 0.0, 1e-9);
  }
}

TEST(GSensitivity, AddsToTheGyroscopeByTheSpecificForce) {
  SimulatorOptions options = Clean(5.0);
  const SessionData exact = Simulate(options);
  options.effects.g_sensitivity = 1e-3;
  double rest = 0.0;
  const MatrixXd added = Values(Simulate(options).imus[0].gyro) - Values(exact.imus[0].gyro);
  const MatrixXd G = Regress(added, Values(exact.imus[0].accel), &rest);
  EXPECT_LT(rest, 1e-12);
  EXPECT_GT(Rms(G), 0.5e-3);
  EXPECT_LT(Rms(G), 2e-3);
}

TEST(TemperatureDrift, ApproachesItsEndWithinMinutes) {
  SimulatorOptions options = Clean(240.0);
  options.motion = Motion::kStatic;
  options.gyro_rate_hz = options.accel_rate_hz = 10.0;
  options.pose_rate_hz = 1.0;
  const SessionData exact = Simulate(options);
  options.effects.temperature_drift = 0.01;
  const SessionData data = Simulate(options);
  const MatrixXd gyro = Values(data.imus[0].gyro) - Values(exact.imus[0].gyro);
  const MatrixXd accel = Values(data.imus[0].accel) - Values(exact.imus[0].accel);
  EXPECT_EQ(gyro.col(0).norm(), 0.0);
  EXPECT_NEAR(gyro.col(1200).norm(), 0.01 * (1.0 - std::exp(-1.0)), 1e-9);
  EXPECT_NEAR(accel.col(1200).norm(), 0.1 * (1.0 - std::exp(-1.0)), 1e-9);
  EXPECT_NEAR(gyro.col(2399).norm(), 0.01 * (1.0 - std::exp(-2.0)), 1e-5);
}
}  // namespace
}  // namespace imu_pose_calib
