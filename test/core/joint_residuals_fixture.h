#pragma once

#include <ceres/gradient_checker.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/joint_residuals.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {

using Eigen::Vector3d;

/// Random blocks of a residual: control points of a lively correction, then the given parameters.
class JointResiduals : public ::testing::Test {
 protected:
  JointResiduals() {
    for (auto& point : d_) point = Random(0.01);
    for (auto& point : phi_) point = Random(0.3);
    at_.gp.q_WM = Exp<double>(Random(1.0));
    at_.gp.omega_M = Random(2.0);
    at_.gp.alpha_M = Random(8.0);
    at_.gp.p_WM = Random(1.0);
    at_.gp.v_W = Random(1.0);
    at_.gp.a_W = Random(5.0);
    at_.place = {0, 0.4, 0.03};
  }

  Vector3d Random(double scale) {
    std::uniform_real_distribution<double> uniform(-scale, scale);
    return {uniform(random_), uniform(random_), uniform(random_)};
  }

  std::vector<double*> Points(std::vector<std::vector<Vector3d>*> splines) {
    std::vector<double*> blocks;
    for (auto* points : splines)
      for (Vector3d& point : *points) blocks.push_back(point.data());
    return blocks;
  }

  /// [m/s^3, m/s^4], [rad/s^3, rad/s^4]
  static inline const Eigen::Matrix<double, 3, 2> kHigher =
      (Eigen::Matrix<double, 3, 2>() << 5.0, 20.0, -3.0, 30.0, 7.0, -10.0).finished();

  /// Where a sample lies on the trajectory.
  struct TrajectoryPoint {
    MarkerState<double> gp;
    SplinePlace place;
  };
  static JointPoseSample Position(const TrajectoryPoint& at, const Vector3d& p_WM, double sigma) {
    return {{at.place}, 0.6, sigma, p_WM - at.gp.p_WM, at.gp.v_W, at.gp.a_W, kHigher};
  }
  static JointPoseSample Rotation(const TrajectoryPoint& at, const Vector3d& error, double sigma) {
    return {{at.place}, 0.35, sigma, error, Vector3d::Zero(), at.gp.alpha_M, kHigher};
  }
  static JointAccelSample Imu(const TrajectoryPoint& at, const Vector3d& value, double bias_u,
                              double own_time, double sigma) {
    const MarkerState<double>& gp = at.gp;
    return {{{at.place, own_time}, gp.omega_M, gp.alpha_M, value, bias_u, sigma}, gp.q_WM, gp.a_W};
  }

  /// Of two poses of one span, close to the trajectory.
  std::vector<JointPoseSample> Positions() {
    const JointPoseSample sample = Position(at_, at_.gp.p_WM + Random(0.01), 0.01);
    JointPoseSample next = Position(at_, at_.gp.p_WM + Random(0.01), 0.03);
    next.place.u += 0.3;
    return {sample, next};
  }
  std::vector<JointPoseSample> Rotations() {
    const JointPoseSample sample = Rotation(at_, Random(0.5), 0.02);
    JointPoseSample next = Rotation(at_, Random(0.5), 0.01);
    next.place.u += 0.3;
    return {sample, next};
  }

  /// Two IMU samples of one span.
  std::vector<JointAccelSample> Imu() {
    const JointAccelSample sample = Imu(at_, Random(3.0), 0.3, 2.4, 0.05);
    JointAccelSample next = Imu(at_, Random(3.0), 0.4, 2.5, 0.03);
    next.place.u += 0.2;
    next.omega_M += Random(0.1);
    return {sample, next};
  }
  /// Derivatives of the GP's motion, as JointAccelSample has them.
  struct MarkerJerk {
    Vector3d alpha_rate, jerk_W, curvature = Vector3d::Zero(), f_swing = Vector3d::Zero(),
                                 cone = Vector3d::Zero(), averaged = Vector3d::Zero();
  };
  std::vector<MarkerJerk> Jerks() {
    return {
        {Random(40.0), Random(30.0), Random(300.0), Random(300.0), Random(100.0), Random(300.0)},
        {Random(40.0), Random(30.0), Random(300.0), Random(300.0), Random(100.0), Random(300.0)}};
  }

  static std::vector<JointImuSample> Gyro(const std::vector<JointAccelSample>& samples) {
    return {samples.begin(), samples.end()};
  }
  static std::vector<JointAccelSample> With(std::vector<JointAccelSample> samples,
                                            const std::vector<MarkerJerk>& jerks) {
    for (size_t i = 0; i < samples.size(); ++i) {
      samples[i].alpha_rate = jerks[i].alpha_rate;
      samples[i].jerk_W = jerks[i].jerk_W;
      samples[i].curvature = jerks[i].curvature;
      samples[i].f_swing = jerks[i].f_swing;
      samples[i].cone = jerks[i].cone;
      samples[i].averaged = jerks[i].averaged;
    }
    return samples;
  }

  /// The clock parameters that move a sensor, as the joint solve hands them over.
  struct Clock {
    double* parameter;
    ClockMotion motion;
  };
  std::vector<Clock> GyroClocks() {
    return {{&time_shift_, {0.0213, 1.0, ClockMotion::kOne}},
            {&clock_drift_, {1e-6, 1.0, ClockMotion::kOwnTime}}};
  }
  std::vector<Clock> AccelClocks() {
    std::vector<Clock> clocks = GyroClocks();
    clocks.push_back({&accel_delay_, {0.0008, -1.0, ClockMotion::kOne}});
    return clocks;
  }
  static ClockMotions Motions(const std::vector<Clock>& clocks) {
    auto motions = std::make_shared<std::vector<ClockMotion>>();
    for (const Clock& clock : clocks) motions->push_back(clock.motion);
    return motions;
  }
  static std::vector<double*> With(std::vector<double*> blocks, const std::vector<Clock>& clocks) {
    for (const Clock& clock : clocks) blocks.push_back(clock.parameter);
    return blocks;
  }

  std::vector<Clock> PositionClocks() {
    return {{&position_delay_, {0.002, -1.0, ClockMotion::kOne}}};
  }

  std::vector<double*> PositionBlocks(const std::vector<Clock>& clocks) {
    std::vector<double*> blocks = Points({&d_});
    for (double* block :
         {error_0_.data(), error_1_.data(), &pose_smoothing_, &position_smoothing_,
          &trajectory_accel_smoothing_, pose_cumulants_.data(), position_cumulants_.data()})
      blocks.push_back(block);
    return With(blocks, clocks);
  }
  std::vector<double*> RotationBlocks() {
    std::vector<double*> blocks = Points({&phi_});
    blocks.insert(blocks.end(),
                  {error_0_.data(), error_1_.data(), &pose_smoothing_, pose_cumulants_.data()});
    return blocks;
  }

  std::vector<double*> GyroBlocks(const std::vector<Clock>& clocks) {
    std::vector<double*> blocks = Points({&phi_});
    for (double* block : {knot_0_.data(), knot_1_.data(), q_MI_.coeffs().data(),
                          gyro_intrinsics_.data(), &gyro_smoothing_, &trajectory_smoothing_})
      blocks.push_back(block);
    return With(blocks, clocks);
  }

  std::vector<double*> AccelBlocks(const std::vector<Clock>& clocks) {
    std::vector<double*> blocks = Points({&d_, &phi_});
    for (double* block : {knot_0_.data(), knot_1_.data(), q_MI_.coeffs().data(),
                          accel_intrinsics_.data(), p_MI_.data(), g_W_.data(), &accel_smoothing_,
                          &mount_compliance_, &pose_scale_, accel_positions_.data(),
                          &gyro_smoothing_, &trajectory_smoothing_, &trajectory_accel_smoothing_})
      blocks.push_back(block);
    return With(blocks, clocks);
  }

  /// Of samples that were made while the IMU was calibrated as it is.
  std::unique_ptr<SampledCost> GyroCost(const std::vector<JointImuSample>& samples,
                                        const std::vector<Clock>& clocks) {
    return CreateJointGyroResidual(samples, &GyroBlocks(clocks)[kSplineOrder + 2], Motions(clocks));
  }
  std::unique_ptr<SampledCost> AccelCost(const std::vector<JointAccelSample>& samples,
                                         const std::vector<Clock>& clocks) {
    return CreateJointAccelResidual(samples, &AccelBlocks(clocks)[2 * kSplineOrder + 2],
                                    Motions(clocks));
  }
  /// By as much as a pass may.
  void MoveCalibration() {
    q_MI_ = q_MI_ * Exp<double>(Random(0.02));
    p_MI_ += Random(0.02);
    g_W_ += Random(0.02);
    gyro_intrinsics_ *= 1.1;
    accel_intrinsics_ *= 0.9;
    accel_positions_ *= 1.1;
    pose_scale_ += 0.01;
  }

  /// Moves all clocks by about `scale`: [s], drifts [s/s].
  void MoveClocks(double scale) {
    time_shift_ = 0.0213 + 0.7 * scale;
    clock_drift_ = 1e-6 + 0.9 * scale;
    accel_delay_ = 0.0008 - 0.4 * scale;
  }
  /// How far samples have moved then [s].
  static double GyroMove(double scale, double own_time) { return scale * (0.7 + 0.9 * own_time); }
  static double AccelMove(double scale, double own_time) {
    return GyroMove(scale, own_time) + 0.4 * scale;
  }

  /// A motion that agrees with its derivatives, in place of the GP's.
  TrajectoryPoint PointAt(double t) const {
    const TrueState s = true_.At(t);
    const Eigen::Quaterniond q_WM(s.R_WM);
    return {{q_WM, s.omega_M, s.alpha_M, s.p_WM, s.v_W, s.a_W}, {0, (t - kSpan) / 0.03, 0.03}};
  }
  MarkerJerk JerkAt(double t) const {
    return {NumericRate([&](double at) { return true_.At(at).alpha_M; }, t, 1e-3),
            NumericRate([&](double at) { return true_.At(at).a_W; }, t, 1e-3)};
  }
  /// The same with the corrections.
  template <typename Points>
  static Vector3d Correction(const Points& points, double t, int derivative = 0) {
    const SplineWeights w = CubicWeights((t - kSpan) / 0.03, 0.03);
    Vector3d x = Vector3d::Zero();
    for (int j = 0; j < kSplineOrder; ++j) x += w(derivative, j) * points[static_cast<size_t>(j)];
    return x;
  }
  Eigen::Matrix3d RotationAt(double t) const {
    return true_.At(t).R_WM * Exp<double>(Correction(phi_, t)).toRotationMatrix();
  }

  struct Evaluated {
    Eigen::VectorXd residuals;
    std::vector<Eigen::MatrixXd> jacobians;  ///< of each block
  };
  static Evaluated Evaluate(const std::unique_ptr<SampledCost>& cost,
                            const std::vector<double*>& blocks) {
    using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
    Evaluated out;
    out.residuals.resize(cost->num_residuals());
    std::vector<std::vector<double>> values;
    std::vector<double*> pointers;
    for (const int size : cost->parameter_block_sizes())
      values.emplace_back(static_cast<size_t>(size * cost->num_residuals()));
    for (auto& block : values) pointers.push_back(block.data());
    EXPECT_EQ(values.size(), blocks.size());
    EXPECT_TRUE(cost->Evaluate(blocks.data(), out.residuals.data(), pointers.data()));
    for (size_t k = 0; k < values.size(); ++k) {
      Eigen::MatrixXd J = Eigen::Map<const RowMajor>(values[k].data(), cost->num_residuals(),
                                                     cost->parameter_block_sizes()[k]);
      if (J.cols() == 4) J = (J * PlusJacobian(blocks[k])).eval();  // in its tangent space
      out.jacobians.push_back(J);
    }
    return out;
  }

  /// Of samples that the clocks move, and of samples that are where they move to.
  struct MovedAndPlaced {
    Evaluated moved, placed;
  };
  /// `evaluate(scale)` with all clocks moved by about `scale`. Expects both to be the same at 0 and
  /// their difference to vanish with the move to the `order`, for the residuals, and to those of
  /// the Jacobians of each block.
  static void ExpectOrder(const std::function<MovedAndPlaced(double)>& evaluate, int order,
                          const std::function<int(size_t)>& jacobian_order) {
    const MovedAndPlaced zero = evaluate(0.0);
    EXPECT_LT((zero.moved.residuals - zero.placed.residuals).norm(), 1e-12);
    const MovedAndPlaced whole = evaluate(2e-4), half = evaluate(1e-4);
    // Within a quarter of the power of two; what vanishes altogether is left to rounding.
    const auto expect = [](const auto& at_whole, const auto& at_half, double size, int power) {
      EXPECT_LT(at_half.norm(), 1.25 * std::pow(0.5, power) * at_whole.norm() + 1e-13 * size);
    };
    EXPECT_GT((whole.moved.residuals - zero.moved.residuals).norm(), 1e-3);
    expect(whole.moved.residuals - whole.placed.residuals,
           half.moved.residuals - half.placed.residuals, whole.moved.residuals.norm(), order);
    for (size_t k = 0; k < zero.moved.jacobians.size(); ++k) {
      SCOPED_TRACE("block " + std::to_string(k));
      EXPECT_LT((zero.moved.jacobians[k] - zero.placed.jacobians[k]).norm(), 1e-12);
      if (whole.moved.jacobians[k].norm() == 0.0) continue;
      expect(whole.moved.jacobians[k] - whole.placed.jacobians[k],
             half.moved.jacobians[k] - half.placed.jacobians[k], whole.moved.jacobians[k].norm(),
             jacobian_order(k));
    }
  }

  /// Samples of the true motion from kSpan on, which clocks move by `move(scale, own time)`.
  template <typename Create>
  void ExpectImuOrder(const std::vector<double*>& blocks, double (*move)(double, double), int order,
                      const std::function<int(size_t)>& jacobian_order, const Create& create) {
    d_.assign(kSplineOrder, Vector3d::Zero());  // corrections stay where they are
    phi_.assign(kSplineOrder, Vector3d::Zero());
    const Vector3d value = Random(3.0);
    const auto evaluate = [&](double scale) {
      std::vector<JointAccelSample> samples, placed;
      std::vector<MarkerJerk> jerks, placed_jerks;
      for (const double own : {2.4, 2.5}) {
        const double t = kSpan + 0.012 + 0.03 * (own - 2.4);
        const double moved = t + move(scale, own);
        samples.push_back(Imu(PointAt(t), value, 0.3, own, 0.05));
        placed.push_back(Imu(PointAt(moved), value, 0.3, own, 0.05));
        jerks.push_back(JerkAt(t));
        placed_jerks.push_back(JerkAt(moved));
      }
      MoveClocks(0.0);
      MovedAndPlaced both;
      both.placed = Evaluate(create(placed, placed_jerks), blocks);
      MoveClocks(scale);
      both.moved = Evaluate(create(samples, jerks), blocks);
      return both;
    };
    ExpectOrder(evaluate, order, jacobian_order);
  }

  /// Analytic Jacobians against numeric ones, in the tangent space.
  static void ExpectJacobiansMatch(const std::unique_ptr<SampledCost>& cost,
                                   const std::vector<double*>& blocks) {
    ASSERT_EQ(cost->parameter_block_sizes().size(), blocks.size());
    QuaternionManifold manifold;
    std::vector<const Manifold*> manifolds;
    for (const int size : cost->parameter_block_sizes())
      manifolds.push_back(size == 4 ? &manifold : nullptr);
    ceres::NumericDiffOptions options;
    options.ridders_relative_initial_step_size = 1e-4;  // times 32 at first: stays near the span
    const ceres::GradientChecker checker(cost.get(), &manifolds, options);
    ceres::GradientChecker::ProbeResults results;
    checker.Probe(blocks.data(), 1e-6, &results);  // its verdict calls 1e-15 different from 0
    ASSERT_TRUE(results.return_value) << results.error_log;
    for (size_t k = 0; k < blocks.size(); ++k) {
      const auto& J = results.local_jacobians[k];
      EXPECT_LT((J - results.local_numeric_jacobians[k]).norm(), 1e-6 * std::max(1.0, J.norm()))
          << "block " << k << "\n"
          << J << "\nnumeric\n"
          << results.local_numeric_jacobians[k];
    }
  }

  static constexpr double kSpan = 3.1;  ///< [s] where the span of the corrections begins
  const TrueTrajectory true_{SimulatorOptions()};
  std::mt19937 random_{17};
  std::vector<Vector3d> d_ = std::vector<Vector3d>(kSplineOrder);
  std::vector<Vector3d> phi_ = std::vector<Vector3d>(kSplineOrder);
  TrajectoryPoint at_;
  Eigen::Quaterniond q_MI_ = Exp<double>(Vector3d(0.3, -1.2, 0.8));
  Vector3d p_MI_{0.1, -0.05, 0.2}, g_W_{0.3, -0.2, -9.8};
  Vector3d knot_0_{0.01, 0.02, -0.01}, knot_1_{-0.02, 0.01, 0.03};
  Vector6d gyro_intrinsics_ = (Vector6d() << 0.02, -0.01, 0.03, 0.01, 0.02, -0.02).finished();
  Vector9d accel_intrinsics_ =
      (Vector9d() << 0.01, 0.02, -0.03, 0.01, -0.02, 0.02, 0.03, -0.01, 0.02).finished();
  double time_shift_ = 0.0213, accel_delay_ = 0.0008, clock_drift_ = 1e-6;
  double pose_smoothing_ = 3e-4, position_smoothing_ = -1e-4, accel_smoothing_ = 4e-4,
         gyro_smoothing_ = 2e-4, trajectory_smoothing_ = 3e-4, trajectory_accel_smoothing_ = -5e-5;
  Eigen::Vector2d pose_cumulants_{2e-5, -3e-6}, position_cumulants_{-1e-5, 2e-6};
  double position_delay_ = 0.003;
  double mount_compliance_ = 2e-4;
  double pose_scale_ = 1.03;
  /// More than any IMU has.
  Vector3d error_0_{1e-3, -2e-3, 3e-3}, error_1_{2e-3, 1e-3, -1e-3};
  Vector6d accel_positions_ = (Vector6d() << 0.05, -0.03, 0.02, 0.04, -0.05, 0.03).finished();
};

}  // namespace imu_pose_calib
