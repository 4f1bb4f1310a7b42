#include "imu_pose_calib/core/calibration/joint_solver.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibration/joint_noise.h"
#include "imu_pose_calib/core/calibration/joint_problem.h"

namespace imu_pose_calib {
namespace {

/// Passes end when nothing would move by so much of its sigma, or with the last of so many.
constexpr double kSettled = 0.05;
constexpr int kMaxPasses = 60;

/// S4 at given knot spacings: trajectories and calibration in passes of least squares, each with
/// the noise and the robust weights that the residuals of the one before show.
class JointSolver {
 public:
  JointSolver(const CalibrationOptions& options, const std::vector<PreparedSession>& limited,
              const std::vector<double>& knot_spacings_s, Estimate* estimate)
      : options_(options), limited_(limited), estimate_(estimate) {
    for (size_t s = 0; s < limited.size(); ++s) {
      splines_.emplace_back(limited[s].data, *estimate, s, knot_spacings_s[s]);
      sessions_.push_back(Thinned(limited[s], knot_spacings_s[s]));
      instants_.push_back(FindInstants(limited[s], estimate->sessions[s], splines_[s]));
    }
    ResampleImus();
    models_ = InitialModels(options, sessions_);
    estimate->peaks = {};
  }

  Solution Solve() {
    Solution solution;
    solution.has_settled = false;
    StepSummary summary;
    SetStartNoise();
    moves_.clear();  // whichever way the start went
    for (int pass = 0; pass < kMaxPasses && !solution.has_settled; ++pass) {
      if (pass > 0) {
        SetNoise();
        MoveTrajectories();
        ResampleImus();
      }
      Build();
      summary = problem_->Step(pass > 0 ? kSettled : 0.0);
      iterations_ += summary.iterations;
      solution.has_settled = pass > 0 && summary.is_whole && summary.moved < kSettled;
      if (solution.has_settled || pass + 1 == kMaxPasses)
        solution.marginals = FindMarginals(problem_.get());
      FindNoise();
    }
    if (!std::isfinite(summary.moved)) ThrowNotConverged(options_);
    solution.statistics = std::move(statistics_);
    solution.residuals = problem_->FindResiduals(limited_);
    problem_.reset();
    solution.models = std::move(models_);
    solution.splines = std::move(splines_);
    solution.iterations = iterations_;
    return solution;
  }
  /// Of a session, moved to the solution.
  std::shared_ptr<const PoseTrajectory> trajectory(size_t session) const {
    return sessions_[session].trajectory;
  }

 private:
  /// With the noise and the weights that are set.
  void Build() {
    problem_.reset();  // never two of them at a time
    problem_ = BuildJointProblem(options_, sessions_, models_, estimate_, &splines_);
  }

  /// What the residuals show where the estimate stands.
  void FindNoise() {
    statistics_ = problem_->FindStatistics();
    FitNoise(*problem_, &statistics_);
  }

  /// To what the residuals show at the start, since S1 does not know how far poses can be believed;
  /// of each session at its own start, where no other session contradicts it.
  void SetStartNoise() {
    if (sessions_.size() == 1) {
      Build();
      FindNoise();
      SetNoise();
      return;
    }
    models_.clear();
    for (size_t s = 0; s < sessions_.size(); ++s) {
      Estimate start(limited_[s], options_.bias_knot_interval_s);
      const std::vector<PreparedSession> alone = {limited_[s]};
      JointSolver solver(options_, alone, {splines_[s].spacing()}, &start);
      solver.SetStartNoise();
      for (SensorModel& model : solver.models_) {
        model.session = s;
        models_.push_back(std::move(model));
      }
      for (const size_t k : {0, 1})
        estimate_->sessions[s].AllErrors()[k]->std = start.sessions[0].AllErrors()[k]->std;
    }
  }

  /// At their instants by the clocks as they stand.
  void ResampleImus() {
    for (size_t s = 0; s < sessions_.size(); ++s)
      Resample(limited_[s], instants_[s], *estimate_, s, splines_[s].spacing(), options_.Threads(),
               &sessions_[s]);
  }

  /// To the solution, as far as they can hold it; the splines keep the rest.
  void MoveTrajectories() {
    for (size_t s = 0; s < sessions_.size(); ++s) {
      std::shared_ptr<const PoseTrajectory>& trajectory = sessions_[s].trajectory;
      const auto before = trajectory;
      trajectory = SmoothTrajectory(*before, splines_[s], options_.Threads());
      splines_[s].Rebase(*before, *trajectory, options_.Threads());
    }
  }

  /// On the way to what the last residuals show.
  void SetNoise() {
    size_t next = 0;
    const auto move = [&](double found, double* noise) {
      if (next == moves_.size()) moves_.emplace_back();
      *noise *= std::exp(moves_[next++].Next(std::log(found / *noise)));
    };
    for (size_t k = 0; k < models_.size(); ++k) {
      SensorModel& model = models_[k];
      move(statistics_[k].noise, &model.noise);
      model.spread = statistics_[k].spread;
      if (!IsOfPoses(model.quantity)) continue;
      const bool is_rotation = model.quantity == Quantity::kRotation;
      move(statistics_[k].slow_std,
           &estimate_->sessions[model.session].AllErrors()[is_rotation]->std);
    }
    UpdateWeights(*problem_, splines_, &models_);
  }

  const CalibrationOptions& options_;
  const std::vector<PreparedSession>& limited_;
  std::vector<PreparedSession> sessions_;           ///< of which samples stand for others
  std::vector<std::vector<ImuInstants>> instants_;  ///< of each session and IMU
  Estimate* const estimate_;
  std::vector<SensorModel> models_;
  std::vector<CorrectionSplines> splines_;
  std::unique_ptr<LeastSquares> problem_;
  std::vector<SensorStatistics> statistics_;  ///< where the estimate stands
  std::vector<NoiseMove> moves_;
  int iterations_ = 0;
};

}  // namespace

Solution SolveJointly(const CalibrationOptions& options, const std::vector<double>& knot_spacings_s,
                      std::vector<PreparedSession>* sessions, Estimate* estimate) {
  for (size_t s = 0; s < sessions->size(); ++s)
    (*sessions)[s] = LimitBand((*sessions)[s], Band(knot_spacings_s[s]), options.Threads());
  JointSolver solver(options, *sessions, knot_spacings_s, estimate);
  Solution solution = solver.Solve();
  for (size_t s = 0; s < sessions->size(); ++s) (*sessions)[s].trajectory = solver.trajectory(s);
  return solution;
}

}  // namespace imu_pose_calib
