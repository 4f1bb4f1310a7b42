#include "imu_pose_calib/core/least_squares.h"

#include <ceres/normal_prior.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <string>
#include <thread>
#include <utility>

#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/core/residuals.h"

namespace imu_pose_calib {
namespace {

/// Sigma of the delays of ordinary IMUs.
constexpr double kDelayPrior = 0.02;  // [s]
/// Samples closer than this to the end of a segment are left out, so that the time shift can move.
constexpr double kEdge = 0.02;  // [s]
/// Residuals of a sensor that the trajectory follows more closely say little about its noise.
constexpr double kLeastRedundancy = 0.1;

/// Share of the diagonal of H that is added to it after a step that does not reduce the cost by a
/// share kLeastGain of what it should (Levenberg-Marquardt); less than this is none.
constexpr double kLeastDamping = 1e-8, kLeastGain = 1e-3;
/// Relative to the parameters.
constexpr double kLeastStep = 1e-8;

struct GaussNewtonStep {
  Eigen::VectorXd x;  ///< of the blocks
  double decrease;    ///< of the cost, if the residuals were linear; NaN when there is no step
};

GaussNewtonStep FindStep(const NormalEquations& equations,
                         size_t sessions,
                         double damping,
                         int threads) {
  const Elimination& elimination = *equations.elimination();
  std::vector<Panels> panels = equations.Assemble(static_cast<int>(sessions), {});
  const auto damp = [damping](int, auto diagonal) { diagonal *= 1.0 + damping; };
  for (Panels& own : panels) elimination.VisitDiagonal(damp, &own);
  const Eigen::VectorXd weights = Eigen::VectorXd::Ones(static_cast<Eigen::Index>(sessions));
  Reduced reduced = EliminateAll(elimination, weights, true, threads, &panels);
  for (Eigen::Index k = 0; k < reduced.H.rows(); ++k)
    if (reduced.H(k, k) == 0.0) reduced.H(k, k) = 1.0;  // nothing acts on it: it stays
  GaussNewtonStep step{Eigen::VectorXd::Zero(elimination.columns()), std::nan("")};
  const Eigen::LLT<Eigen::MatrixXd> llt(reduced.H);
  if (!reduced.H.allFinite() || llt.info() != Eigen::Success) return step;
  const Eigen::VectorXd b = reduced.B * weights;
  step.x.head(b.size()) = -llt.solve(b);
  step.decrease = 0.5 * (reduced.inner.sum() - b.dot(step.x.head(b.size())));
  for (const Panels& own : panels) elimination.SubstituteBack(own, &step.x);
  return step;
}

}  // namespace

std::vector<SensorModel> InitialModels(const CalibrationOptions& options,
                                       const std::vector<PreparedSession>& sessions) {
  std::vector<SensorModel> models;
  for (size_t s = 0; s < sessions.size(); ++s) {
    const ConditionedData& data = sessions[s].data;
    const auto add = [&](Quantity quantity, size_t imu, double rate_hz, double noise, size_t size) {
      models.push_back({quantity, s, imu, rate_hz, noise, noise, std::vector<double>(size, 1.0)});
    };
    const double rate_hz = data.pose_report.rate_hz;
    const size_t poses = data.poses.size();
    add(Quantity::kPosition, 0, rate_hz, sessions[s].pose_noise.position, poses);
    add(Quantity::kRotation, 0, rate_hz, sessions[s].pose_noise.rotation, poses);
    for (size_t i = 0; i < data.imus.size(); ++i) {
      const ConditionedImu& imu = data.imus[i];
      if (!imu.IsPresent()) continue;
      const auto add_imu = [&](Quantity quantity, double density, double rate, size_t size) {
        add(quantity, i, rate, density * std::sqrt(rate), size);
      };
      add_imu(
          Quantity::kGyro, options.gyro_noise_density, imu.gyro_report.rate_hz, imu.gyro.size());
      add_imu(Quantity::kAccel,
              options.accel_noise_density,
              imu.accel_report.rate_hz,
              imu.accel.size());
    }
  }
  return models;
}

void SensorBlocks::Add(ceres::ResidualBlockId block,
                       const std::vector<ProblemSample>& block_samples) {
  blocks.push_back(block);
  block_t.push_back(block_samples.front().t);
  samples.insert(samples.end(), block_samples.begin(), block_samples.end());
}

LeastSquares::LeastSquares(const CalibrationOptions& options,
                           const std::vector<PreparedSession>& sessions,
                           const std::vector<SensorModel>& models,
                           Estimate* estimate)
    : options(options),
      sessions(sessions),
      estimate(estimate),
      feigned_information(estimate->imus.size(), 0.0) {
  for (const SensorModel& model : models) {
    sensors.emplace_back();
    sensors.back().model = &model;
  }
}

SensorBlocks* LeastSquares::Find(Quantity quantity, size_t session, size_t imu) {
  for (SensorBlocks& sensor : sensors)
    if (sensor.model->quantity == quantity && sensor.model->session == session &&
        sensor.model->imu == imu)
      return &sensor;
  return nullptr;
}

void LeastSquares::AddGyroParameters() {
  for (const Parameter& p : CalibrationParameters(estimate)) {
    if (p.kind != ParameterKind::kRotation && p.kind != ParameterKind::kTimeShift) continue;
    const bool is_rotation = p.kind == ParameterKind::kRotation;
    problem.AddParameterBlock(p.data, is_rotation ? 4 : 1);
    if (is_rotation) SetUnitQuaternion(p.data, &problem);
    if (!IsEstimated(options, p.kind)) problem.SetParameterBlockConstant(p.data);
  }
}

void LeastSquares::AddAccelParameters() {
  for (const Parameter& p : CalibrationParameters(estimate)) {
    if (p.kind != ParameterKind::kTranslation) continue;
    problem.AddParameterBlock(p.data, p.size);
    if (!IsEstimated(options, p.kind)) problem.SetParameterBlockConstant(p.data);
  }
  AddOptional(
      ParameterKind::kAccelDelay, Eigen::VectorXd::Constant(1, kDelayPrior), options.accel_delay);
  for (SessionEstimate& session : estimate->sessions) {
    problem.AddParameterBlock(session.g_W.data(), 3);
    SetSphere(session.g_W.data(), &problem);
    if (!options.estimate_gravity) problem.SetParameterBlockConstant(session.g_W.data());
  }
}

void LeastSquares::AddBiasWalk(double walk, size_t session, size_t imu, BiasKnots* knots) {
  const ImuSessionEstimate& clock = estimate->sessions[session].imus[imu];
  for (size_t k = 0; k + 1 < knots->t.size(); ++k) {
    const double sigma = walk * std::sqrt(knots->t[k + 1] - knots->t[k]);
    priors.push_back({problem.AddResidualBlock(BiasWalkResidual{sigma}.Create(),
                                               nullptr,
                                               knots->values[k].data(),
                                               knots->values[k + 1].data()),
                      session,
                      clock.PoseTime(knots->t[k])});
  }
}

void LeastSquares::AddOptional(ParameterKind kind,
                               const Eigen::VectorXd& sigmas,
                               double expected,
                               std::optional<size_t> imu) {
  for (const Parameter& p : CalibrationParameters(estimate)) {
    if (p.kind != kind || (imu && p.imu != *imu)) continue;
    problem.AddParameterBlock(p.data, p.size);
    if (!IsEstimated(options, kind)) {
      problem.SetParameterBlockConstant(p.data);
      continue;
    }
    auto* prior = new ceres::NormalPrior(sigmas.cwiseInverse().asDiagonal(),
                                         Eigen::VectorXd::Constant(p.size, expected));
    const SessionEstimate& session = estimate->sessions[p.session];
    const ImuSessionEstimate& clock = session.imus[session.FirstImu()];
    priors.push_back({problem.AddResidualBlock(prior, nullptr, p.data),
                      p.session,
                      clock.PoseTime(clock.clock_reference)});
  }
}

int LeastSquares::Threads() const {
  return options.num_threads > 0
             ? options.num_threads
             : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

std::vector<double*> LeastSquares::BiasBlocks() const {
  std::vector<double*> blocks;
  for (SessionEstimate& session : estimate->sessions)
    for (ImuSessionEstimate& imu : session.imus)
      for (BiasKnots* knots : {&imu.gyro_bias, &imu.accel_bias})
        for (Eigen::Vector3d& value : knots->values)
          if (problem.HasParameterBlock(value.data())) blocks.push_back(value.data());
  return blocks;
}

std::vector<Equation> LeastSquares::Equations() const {
  std::vector<Equation> equations;
  for (const SensorBlocks& sensor : sensors)
    for (size_t i = 0; i < sensor.blocks.size(); ++i)
      equations.push_back({sensor.blocks[i], sensor.model->session, sensor.block_t[i]});
  for (const PriorBlock& prior : priors) equations.push_back({prior.block, prior.session, prior.t});
  return equations;
}

int LeastSquares::Solve(double function_tolerance) {
  std::vector<double*> border, inner = BiasBlocks();
  const auto add_border = [&](double* block) {
    if (problem.HasParameterBlock(block) && !problem.IsParameterBlockConstant(block))
      border.push_back(block);
  };
  for (const Parameter& p : CalibrationParameters(estimate)) add_border(p.data);
  for (SessionEstimate& session : estimate->sessions) add_border(session.g_W.data());
  inner.insert(inner.end(), trajectory_blocks.begin(), trajectory_blocks.end());
  std::vector<Equation> all = Equations();
  for (Equation& equation : all) equation.cluster = static_cast<int>(equation.session);
  const NormalEquations equations(problem, border, inner, std::move(all), Threads());

  ceres::Problem::EvaluateOptions evaluate;
  evaluate.num_threads = Threads();
  const auto find_cost = [&] {
    double cost = 0.0;
    return problem.Evaluate(evaluate, &cost, nullptr, nullptr, nullptr) ? cost : std::nan("");
  };
  double cost = find_cost(), damping = 0.0, growth = 2.0;
  if (!std::isfinite(cost))
    throw DataError("the residuals cannot be evaluated where the solve starts");
  for (int iteration = 1; iteration <= options.max_iterations; ++iteration) {
    const GaussNewtonStep step = FindStep(equations, sessions.size(), damping, Threads());
    const Eigen::VectorXd before = MoveBlocks(problem, equations.blocks(), step.x);
    const double found = find_cost(), change = cost - found;
    const bool is_accepted = change > kLeastGain * step.decrease;
    if (!is_accepted) RestoreBlocks(problem, equations.blocks(), before);
    // No change to speak of; or all of what the linear model foresaw, at its minimum.
    const bool is_full = damping == 0.0;
    if (std::isfinite(step.decrease) && (is_accepted || is_full) &&
        (std::abs(change) <= function_tolerance * cost ||
         step.x.norm() <= kLeastStep * (before.norm() + kLeastStep) ||
         (is_accepted && is_full &&
          std::abs(change - step.decrease) <= function_tolerance * found)))
      return iteration;
    if (is_accepted) {
      damping = damping / 3.0 < kLeastDamping ? 0.0 : damping / 3.0;
      growth = 2.0;
      cost = found;
    } else {
      damping = std::max(kLeastDamping, damping * growth);
      growth *= 2.0;
    }
  }
  throw DataError("the solve did not converge within max_iterations = " +
                  std::to_string(options.max_iterations));
}

std::vector<SensorStatistics> LeastSquares::FindStatistics() {
  std::vector<SensorStatistics> statistics;
  for (SensorBlocks& sensor : sensors) {
    if (sensor.samples.empty()) {
      statistics.push_back({sensor.model->noise, 0.0});
      continue;
    }
    ceres::Problem::EvaluateOptions evaluate;
    evaluate.apply_loss_function = false;
    evaluate.num_threads = Threads();
    evaluate.residual_blocks = sensor.blocks;
    std::vector<double> residuals;
    if (!problem.Evaluate(evaluate, nullptr, &residuals, nullptr, nullptr))
      throw DataError("the residuals cannot be evaluated where the solve ended");
    std::vector<double> magnitudes, variances;
    double sum2 = 0.0;
    sensor.residuals.clear();
    for (size_t i = 0; i < sensor.samples.size(); ++i) {
      const ProblemSample& sample = sensor.samples[i];
      const Eigen::Vector3d r =
          (sample.sigma * Eigen::Map<const Eigen::Vector3d>(&residuals[3 * i]) + sample.rest) /
          sample.scale;
      for (int k = 0; k < 3; ++k) magnitudes.push_back(std::abs(r[k]));
      variances.push_back(sample.trajectory_variance);
      sensor.residuals.push_back(r);
      sum2 += sample.scale * sample.scale * r.squaredNorm();
    }
    const double redundancy = std::max(kLeastRedundancy, 1.0 - sensor.fitted);
    const double spread2 = std::pow(kMadToSigma * Median(magnitudes), 2) / redundancy;
    // The trajectory's share is known only roughly: it never explains the residuals alone.
    statistics.push_back({std::sqrt(std::max({spread2 - Median(variances), 0.01 * spread2, 1e-18})),
                          std::sqrt(sum2 / static_cast<double>(residuals.size()))});
  }
  return statistics;
}

std::vector<SensorResiduals> LeastSquares::TakeResiduals() {
  FindStatistics();
  std::vector<SensorResiduals> all;
  for (SensorBlocks& sensor : sensors) {
    const SensorModel& model = *sensor.model;
    SensorResiduals own{model.quantity, model.session, model.imu, model.noise, {}, {}, {}};
    for (size_t i = 0; i < sensor.samples.size(); ++i) {
      own.t.push_back(sensor.samples[i].t);
      own.residual.push_back(sensor.samples[i].scale * sensor.residuals[i]);
      own.weight.push_back(model.weights[sensor.samples[i].index]);
    }
    all.push_back(std::move(own));
  }
  return all;
}

bool IsOnTrajectory(const PoseTrajectory& trajectory, double t_M) {
  return trajectory.Covers(t_M - kEdge, t_M + kEdge);
}

}  // namespace imu_pose_calib
