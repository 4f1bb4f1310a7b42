#include "imu_pose_calib/simulation/true_trajectory.h"

#include <algorithm>
#include <cmath>
#include <random>
#include <tuple>
#include <utility>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/simulation/real_effects.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double kTwoPi = 2.0 * M_PI;
constexpr int kSinesPerAxis = 5;

constexpr double kLowestShake = 20.0, kHighestShake = 80.0;  // [Hz]
constexpr int kShakeLines = 12;                              // per axis
constexpr double kShakeLever = 0.2;   // [m] from what turns to what that accelerates as much
constexpr double kShockTime = 5e-3;   // [s]
constexpr double kShockPeriod = 2.0;  // [s] from one to the next, on average
constexpr double kMargin = 1.0;       // [s] that filters and clocks may need beyond the poses

Vector3d UniformVector(std::mt19937* random, double size) {
  return Vector3d::NullaryExpr([&](Eigen::Index) { return Uniform(random, -size, size); });
}

/// x(t) = sum_k amplitude_k sin(frequency_k t + phase_k), per axis.
struct Sines {
  Eigen::Matrix3Xd amplitude, frequency, phase;

  explicit Sines(int lines) : amplitude(3, lines), frequency(3, lines), phase(3, lines) {}
  Vector3d operator()(double t, int derivative) const {
    // d^n/dt^n sin(w t + p) = w^n sin(w t + p + n pi/2)
    const double quarter_turns = derivative * M_PI / 2.0;
    return (amplitude.array() * frequency.array().pow(derivative) *
            (frequency.array() * t + phase.array() + quarter_turns).sin())
        .rowwise()
        .sum();
  }
};

/// Sines of random phases; `draw(k)` gives amplitude and frequency [rad/s] of line k of an axis.
template <typename Draw>
Sines DrawSines(int lines, std::mt19937* random, Draw draw) {
  Sines sines(lines);
  for (int axis = 0; axis < 3; ++axis) {
    for (int k = 0; k < lines; ++k) {
      std::tie(sines.amplitude(axis, k), sines.frequency(axis, k)) = draw(k);
      sines.phase(axis, k) = Uniform(random, 0.0, kTwoPi);
    }
  }
  return sines;
}

/// Lines within 0.25 Hz from `first_hz`, from `step_hz` above that, and so on; the higher the
/// smaller.
Sines Swings(double amplitude, double first_hz, double step_hz, std::mt19937* random) {
  return DrawSines(kSinesPerAxis, random, [=](int k) {
    const double hz = Uniform(random, first_hz + step_hz * k, first_hz + 0.25 + step_hz * k);
    return std::pair(amplitude * Uniform(random, 0.6, 1.2) / (1.0 + 2.0 * hz * hz), kTwoPi * hz);
  });
}

/// Lines all over the band of shakes; `rms` per axis is that of the derivative.
Sines Shaking(double rms, int derivative, std::mt19937* random) {
  return DrawSines(kShakeLines, random, [=](int k) {
    const double place = (k + Uniform(random, 0.0, 1.0)) / kShakeLines;
    const double w = kTwoPi * (kLowestShake + place * (kHighestShake - kLowestShake));
    return std::pair(rms * std::sqrt(2.0 / kShakeLines) / std::pow(w, derivative), w);
  });
}

/// From place to place, each move in its time, with rests between: x = from + (to - from) s(u).
struct Moves {
  std::vector<double> start, duration;  ///< [s]
  std::vector<Vector3d> places;         ///< one more

  Vector3d operator()(double t, int derivative) const {
    const auto next = std::upper_bound(start.begin() + 1, start.end(), t);
    const auto k = static_cast<size_t>(next - start.begin()) - 1;
    const double u = std::clamp((t - start[k]) / duration[k], 0.0, 1.0), v = 1.0 - u;
    const double s[] = {u * u * u * (10.0 - 15.0 * u + 6.0 * u * u), 30.0 * u * u * v * v,
                        60.0 * u * v * (v - u)};
    const Vector3d move =
        s[derivative] / std::pow(duration[k], derivative) * (places[k + 1] - places[k]);
    return derivative == 0 ? Vector3d(places[k] + move) : move;
  }
};

/// Jolts at random times; each adds peak T^2 u^3 exp(-u) along its direction, u = (t - t_k) / T,
/// so that neither speed nor displacement remains.
struct Jolts {
  std::vector<double> times;  ///< [s]
  std::vector<Vector3d> directions;
  double peak;  ///< of the second derivative

  Vector3d operator()(double t, int derivative) const {
    constexpr double kLasts = 40.0 * kShockTime;
    Vector3d sum = Vector3d::Zero();
    for (auto it = std::lower_bound(times.begin(), times.end(), t - kLasts);
         it != times.end() && *it < t; ++it) {
      const double u = (t - *it) / kShockTime;
      const double d[] = {u * u * u, u * u * (3.0 - u), u * (6.0 - 6.0 * u + u * u)};
      sum += peak * std::pow(kShockTime, 2 - derivative) * d[derivative] * std::exp(-u) *
             directions[static_cast<size_t>(it - times.begin())];
    }
    return sum;
  }
};

/// Velocity and acceleration in W of a point of the body, and its place, as seen from M's origin.
struct PointMotion {
  Vector3d p, v, a;

  PointMotion(const TrueState& s, const Vector3d& point_M)
      : p(s.R_WM * point_M),
        v(s.R_WM * s.omega_M.cross(point_M)),
        a(s.R_WM * (s.alpha_M.cross(point_M) + s.omega_M.cross(s.omega_M.cross(point_M)))) {}
};

/// R_WM S for a rotation S with the body rate u and its derivative; the position stays.
TrueState Turned(const TrueState& state, const Matrix3d& S, const Vector3d& u, const Vector3d& du) {
  TrueState turned = state;
  turned.R_WM = state.R_WM * S;
  turned.omega_M = S.transpose() * state.omega_M + u;
  turned.alpha_M = S.transpose() * state.alpha_M - u.cross(S.transpose() * state.omega_M) + du;
  return turned;
}

/// Body rate of Exp(r) and its derivative, from those of r.
struct BodyRate {
  Vector3d u, du;

  BodyRate(const Vector3d& r, const Vector3d& dr, const Vector3d& ddr) {
    CorrectionRate(r, dr, ddr, &u, &du);
  }
};

}  // namespace

TrueTrajectory::TrueTrajectory(const SimulatorOptions& options) {
  std::mt19937 random(options.seed);
  Sines position = Swings(0.15, 0.15, 0.25, &random);
  Sines rotation = Swings(0.40, 0.15, 0.25, &random);
  q_WB_ = Exp<double>(Gaussian(&random, 1.0));

  switch (options.motion) {
    case Motion::kHandheld:
      break;
    case Motion::kTumble:
      spin_ = 4.0 * Vector3d(Uniform(&random, -1, 1), Uniform(&random, -1, 1), 1).normalized();
      break;
    case Motion::kArm: {
      Moves moves, turns;
      for (double t = -kMargin; t < options.duration_s + kMargin;) {
        moves.start.push_back(t);
        moves.duration.push_back(Uniform(&random, 1.5, 3.0));
        t += moves.duration.back() + Uniform(&random, 0.2, 1.0);
      }
      turns = moves;
      for (size_t k = 0; k <= moves.start.size(); ++k) {
        moves.places.push_back(UniformVector(&random, 0.3));
        turns.places.push_back(UniformVector(&random, 0.9));
      }
      position_ = moves;
      rotation_ = turns;
      break;
    }
    case Motion::kDrone: {
      rotation = Swings(0.25, 0.5, 0.5, &random);
      rotation.amplitude.row(2).setZero();
      // The thrust is along z and carries the weight: a = g tan(tilt), to first order in the tilt.
      position.frequency.topRows<2>() = rotation.frequency.topRows<2>().colwise().reverse();
      position.phase.topRows<2>() = rotation.phase.topRows<2>().colwise().reverse();
      position.amplitude.topRows<2>() =
          -options.g_W.norm() * rotation.amplitude.topRows<2>().colwise().reverse().array() /
          position.frequency.topRows<2>().array().square();
      position.amplitude.row(1) *= -1.0;
      q_WB_.setIdentity();
      spin_ = Vector3d(0, 0, Uniform(&random, 0.1, 0.3));
      break;
    }
    case Motion::kPlanar:
      position.amplitude.row(2).setZero();
      rotation.amplitude.topRows<2>().setZero();
      q_WB_ = Exp<double>(Vector3d(0, 0, Uniform(&random, -1, 1)));
      break;
    case Motion::kHinge:
      position.amplitude.setZero();
      rotation.amplitude.bottomRows<2>().setZero();
      break;
    case Motion::kStatic:
      position.amplitude.setZero();
      rotation.amplitude.setZero();
      break;
  }
  if (!position_) position_ = position;
  if (!rotation_) rotation_ = rotation;
  AddShakes(options);
}

void TrueTrajectory::AddShakes(const SimulatorOptions& options) {
  const RealEffects& effects = options.effects;
  if (effects.vibration > 0.0) {
    std::mt19937 random = RandomOf(RandomEffect::kVibration, options.seed);
    const Sines shift = Shaking(effects.vibration, 2, &random);
    shakes_.push_back(
        {shift, Shaking(effects.vibration / kShakeLever, 2, &random), Vector3d::Zero()});
  }
  if (effects.rocking > 0.0) {
    std::mt19937 random = RandomOf(RandomEffect::kRocking, options.seed);
    const Vector3d pivot_M = kShakeLever * RandomDirection(&random);
    shakes_.push_back({Sines(0), Shaking(effects.rocking, 1, &random), pivot_M});
  }
  if (effects.shocks > 0.0) {
    std::mt19937 random = RandomOf(RandomEffect::kShocks, options.seed);
    std::exponential_distribution<double> wait(1.0 / kShockPeriod);
    Jolts shift{{}, {}, effects.shocks}, turn{{}, {}, effects.shocks / kShakeLever};
    for (double t = -kMargin; t < options.duration_s + kMargin; t += wait(random)) {
      for (Jolts* jolts : {&shift, &turn}) {
        jolts->times.push_back(t);
        jolts->directions.push_back(RandomDirection(&random));
      }
    }
    shakes_.push_back({shift, turn, Vector3d::Zero()});
  }
}

TrueState TrueTrajectory::At(double t) const {
  const Vector3d r = rotation_(t, 0);
  const BodyRate rate(r, rotation_(t, 1), rotation_(t, 2));
  TrueState state;
  state.R_WM = (q_WB_ * Exp(r)).toRotationMatrix();
  state.omega_M = rate.u;
  state.alpha_M = rate.du;
  state.p_WM = position_(t, 0);
  state.v_W = position_(t, 1);
  state.a_W = position_(t, 2);
  state = Turned(state, Exp<double>(spin_ * t).toRotationMatrix(), spin_, Vector3d::Zero());

  for (const Shake& shake : shakes_) {
    const Vector3d turn = shake.turn_M(t, 0);
    const BodyRate shaken(turn, shake.turn_M(t, 1), shake.turn_M(t, 2));
    const PointMotion before(state, shake.pivot_M);
    state = Turned(state, Exp(turn).toRotationMatrix(), shaken.u, shaken.du);
    const PointMotion after(state, shake.pivot_M);
    state.p_WM += shake.shift_W(t, 0) + before.p - after.p;
    state.v_W += shake.shift_W(t, 1) + before.v - after.v;
    state.a_W += shake.shift_W(t, 2) + before.a - after.a;
  }
  return state;
}

}  // namespace imu_pose_calib
