#include "imu_pose_calib/simulation/error_bound.h"

#include <Eigen/Cholesky>
#include <Eigen/SparseCholesky>
#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/spline.h"
#include "imu_pose_calib/core/calibration/priors.h"
#include "imu_pose_calib/simulation/true_trajectory.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::MatrixXd;
using Eigen::Vector3d;

// Places of what the recordings share.
constexpr int kTranslation = 0, kRotation = 3, kDelay = 6, kGyroMatrix = 7, kAccelMatrix = 13,
              kAccelSmoothing = 22, kPoseSmoothing = 23, kPositionSmoothing = 24,
              kPositionDelay = 25, kPoseCumulants = 26, kPositionCumulants = 28, kPoseScale = 30,
              kAccelPositions = 31, kShared = 37;
// Places of what a recording has of its own, after these; biases at knots follow.
constexpr int kTimeShift = kShared, kDrift = kShared + 1, kGravity = kShared + 2,
              kMagnitude = kShared + 4, kBiases = kShared + 5;

constexpr double kMagnitudePrior = 0.03;  // [m/s^2] sigma that the solve has by its options
constexpr double kKnown = 1e-12;          // sigma of what is known

constexpr double kBiasKnots = 5.0;  // [s]
constexpr double kStep = 1e-3;      // [s] of differences in time
constexpr int kPoint = 6;           // of a control point: d, then phi
constexpr int kWindow = kSplineOrder * kPoint;

double Seconds(int64_t ns) { return 1e-9 * static_cast<double>(ns); }

/// Derivatives of three measured values by the trajectory's corrections, at one instant, and by the
/// other parameters.
struct Derivatives {
  using Others = Eigen::Matrix<double, 3, kBiases + 2 * 6>;

  Matrix3d d = Matrix3d::Zero(), ddd = Matrix3d::Zero();  ///< by d and d''
  Matrix3d phi = Matrix3d::Zero(), dphi = Matrix3d::Zero(), ddphi = Matrix3d::Zero();
  /// By what has a place; of the biases only by those at two knots, from `bias_knot` on.
  Others others = Others::Zero();
  int bias_knot = 0;
};

/// Information of one recording on everything but its trajectory, which is eliminated.
class RecordingInformation {
 public:
  RecordingInformation(const SimulatorOptions& truth, const SessionData& data, double knots_s)
      : truth_(truth),
        trajectory_(truth),
        bias_knots_(2 + static_cast<int>(truth.duration_s / kBiasKnots)),
        spans_(std::max(1, static_cast<int>(std::ceil(truth.duration_s / knots_s)))),
        spacing_(truth.duration_s / spans_),
        size_(kBiases + 6 * bias_knots_),
        windows_(static_cast<size_t>(spans_), MatrixXd::Zero(kWindow, kWindow)),
        mixed_(MatrixXd::Zero(kPoint * (spans_ + kSplineOrder - 1), size_)),
        others_(MatrixXd::Zero(size_, size_)) {
    R_IM_ = truth.T_MI.q.toRotationMatrix().transpose();
    for (const PoseSample& pose : data.poses) AddPose(Seconds(pose.t_ns - truth.start_ns));
    const int64_t imu_ns = truth.ImuStart();
    for (const ImuSample& gyro : data.imus[0].gyro) AddGyro(Seconds(gyro.t_ns - imu_ns));
    for (const ImuSample& accel : data.imus[0].accel) AddAccel(Seconds(accel.t_ns - imu_ns));
    AddWalks();
  }

  MatrixXd Eliminate() const {
    std::vector<Eigen::Triplet<double>> elements;
    for (int k = 0; k < spans_; ++k)
      for (int i = 0; i < kWindow; ++i)
        for (int j = 0; j < kWindow; ++j)
          elements.emplace_back(kPoint * k + i, kPoint * k + j,
                                windows_[static_cast<size_t>(k)](i, j));
    // Points that no sample sees are held by this.
    for (int i = 0; i < mixed_.rows(); ++i) elements.emplace_back(i, i, 1e-6);
    Eigen::SparseMatrix<double> points(mixed_.rows(), mixed_.rows());
    points.setFromTriplets(elements.begin(), elements.end());
    const Eigen::SimplicialLLT<Eigen::SparseMatrix<double>> factor(points);
    return others_ - mixed_.transpose() * factor.solve(mixed_);
  }

 private:
  void AddPose(double t) {
    const TrueState s = trajectory_.At(t);
    const TrueState before = trajectory_.At(t - kStep), after = trajectory_.At(t + kStep);
    Derivatives position, rotation;
    position.d.setIdentity();
    position.others.col(kPoseSmoothing) = 0.5 * s.a_W;
    position.others.col(kPositionSmoothing) = 0.5 * s.a_W;
    position.others.col(kPositionDelay) = -s.v_W;
    const Vector3d third = (after.a_W - before.a_W) / (2.0 * kStep);
    const Vector3d fourth = (after.a_W - 2.0 * s.a_W + before.a_W) / (kStep * kStep);
    for (const int cumulants : {kPoseCumulants, kPositionCumulants})
      position.others.middleCols<2>(cumulants) << third / -6.0, fourth / 24.0;
    position.others.col(kPoseScale) = s.p_WM;
    rotation.phi.setIdentity();
    rotation.others.col(kPoseSmoothing) = 0.5 * s.alpha_M;
    const Vector3d alpha_rate = (after.alpha_M - before.alpha_M) / (2.0 * kStep);
    const Vector3d alpha_curvature =
        (after.alpha_M - 2.0 * s.alpha_M + before.alpha_M) / (kStep * kStep);
    rotation.others.middleCols<2>(kPoseCumulants)
        << (alpha_rate + 0.5 * s.omega_M.cross(s.alpha_M)) / -6.0,
        (alpha_curvature + s.omega_M.cross(alpha_rate)) / 24.0;
    Add(t, position, truth_.position_std);
    Add(t, rotation, truth_.rotation_std);
  }

  void AddGyro(double t) {
    const TrueState s = trajectory_.At(t);
    const Vector3d omega_I = R_IM_ * s.omega_M, alpha_I = R_IM_ * s.alpha_M;
    Derivatives gyro;
    gyro.phi = R_IM_ * Hat(s.omega_M);
    gyro.dphi = R_IM_;
    gyro.others.middleCols<3>(kRotation) = Hat(omega_I);
    gyro.others.col(kTimeShift) = alpha_I;
    gyro.others.col(kDrift) = (t - 0.5 * truth_.duration_s) * alpha_I;
    for (int row = 0, k = kGyroMatrix; row < 3; ++row)
      for (int column = 0; column <= row; ++column) gyro.others(row, k++) = omega_I[column];
    AddBias(t, 0, &gyro);
    Add(t, gyro, truth_.gyro_std);
  }

  Vector3d ForceI(double t) const {
    const TrueState s = trajectory_.At(t);
    const Vector3d& p = truth_.T_MI.p;
    return R_IM_ * (s.R_WM.transpose() * (s.a_W - truth_.g_W) + s.alpha_M.cross(p) +
                    s.omega_M.cross(s.omega_M.cross(p)));
  }

  void AddAccel(double stamp) {
    const double t = stamp - truth_.accel_delay_s;
    const TrueState s = trajectory_.At(t);
    const Vector3d& p = truth_.T_MI.p;
    const Vector3d force = ForceI(t), after = ForceI(t + kStep), before = ForceI(t - kStep);
    const Vector3d rate = (after - before) / (2.0 * kStep);
    const Matrix3d R_MW = s.R_WM.transpose(), omega = Hat(s.omega_M);
    // By omega_M, of which phi makes [omega] phi + phi', and by alpha_M.
    const Matrix3d by_omega = -Hat<double>(s.omega_M.cross(p)) - omega * Hat(p);
    const Matrix3d by_alpha = -Hat(p);
    Derivatives accel;
    accel.ddd = R_IM_ * R_MW;
    accel.phi = R_IM_ * (Hat<double>(R_MW * (s.a_W - truth_.g_W)) + by_omega * omega +
                         by_alpha * Hat(s.alpha_M));
    accel.dphi = R_IM_ * (by_omega + by_alpha * omega);
    accel.ddphi = R_IM_ * by_alpha;
    const Matrix3d by_place = R_IM_ * (Hat(s.alpha_M) + omega * omega);
    accel.others.middleCols<3>(kTranslation) = by_place;
    accel.others.middleCols<3>(kRotation) = Hat(force);
    accel.others.col(kDelay) = -rate;
    accel.others.col(kTimeShift) = rate;
    accel.others.col(kDrift) = (t - 0.5 * truth_.duration_s) * rate;
    accel.others.col(kAccelSmoothing) = (after - 2.0 * force + before) / (2.0 * kStep * kStep);
    for (int row = 0; row < 3; ++row)
      accel.others.block<1, 3>(row, kAccelMatrix + 3 * row) = force.transpose();
    // Row: axis; column: component of its place in I.
    const Matrix3d by_place_I = by_place * R_IM_.transpose();
    for (int k = 0; k < 6; ++k)
      accel.others.col(kAccelPositions + k) =
          by_place_I.cwiseProduct(AccelPositions(Vector6d::Unit(k)).transpose()).rowwise().sum();
    const Vector3d up = truth_.g_W.normalized(), u = up.unitOrthogonal();
    Matrix3d axes;
    axes << u, up.cross(u), up;
    accel.others.middleCols<3>(kGravity) = -R_IM_ * R_MW * axes;
    AddBias(stamp, 3, &accel);
    Add(t, accel, truth_.accel_std);
  }

  void AddBias(double t, int first, Derivatives* derivatives) const {
    const double place = std::clamp(t / kBiasKnots, 0.0, bias_knots_ - 1.001);
    derivatives->bias_knot = static_cast<int>(place);
    const double share = place - derivatives->bias_knot;
    derivatives->others.middleCols<3>(kBiases + first) = (1.0 - share) * Matrix3d::Identity();
    derivatives->others.middleCols<3>(kBiases + 6 + first) = share * Matrix3d::Identity();
  }

  void AddWalks() {
    for (int i = 0; i < 6 * (bias_knots_ - 1); ++i) {
      const double walk = i % 6 < 3 ? truth_.gyro_bias_walk : truth_.accel_bias_walk;
      const double information = 1.0 / (walk * walk * kBiasKnots);
      const int a = kBiases + i, b = a + 6;
      others_(a, a) += information;
      others_(b, b) += information;
      others_(a, b) -= information;
      others_(b, a) -= information;
    }
  }

  void Add(double t, const Derivatives& by, double sigma) {
    const double place = t / spacing_;
    if (place < 0.0 || place > spans_) return;  // the spline ends with the poses
    const int first = std::min(static_cast<int>(place), spans_ - 1);
    const SplineWeights w = CubicWeights(place - first, spacing_);
    Eigen::Matrix<double, 3, kWindow> window;
    for (int j = 0; j < kSplineOrder; ++j) {
      window.middleCols<3>(kPoint * j) = w(0, j) * by.d + w(2, j) * by.ddd;
      window.middleCols<3>(kPoint * j + 3) =
          w(0, j) * by.phi + w(1, j) * by.dphi + w(2, j) * by.ddphi;
    }
    window /= sigma;
    const auto others = (by.others / sigma).eval();
    windows_[static_cast<size_t>(first)] += window.transpose() * window;
    const auto mixed = (window.transpose() * others).eval();
    const auto rest = (others.transpose() * others).eval();
    const auto place_of = [&](int i) { return i < kBiases ? i : i + 6 * by.bias_knot; };
    for (int i = 0; i < others.cols(); ++i) {
      mixed_.col(place_of(i)).segment<kWindow>(kPoint * first) += mixed.col(i);
      for (int k = 0; k < others.cols(); ++k) others_(place_of(i), place_of(k)) += rest(i, k);
    }
  }

  const SimulatorOptions& truth_;
  const TrueTrajectory trajectory_;
  const int bias_knots_, spans_;
  const double spacing_;
  const int size_;
  Matrix3d R_IM_;
  std::vector<MatrixXd> windows_;  ///< of each span on the control points that act there
  MatrixXd mixed_, others_;
};

/// With what is known beforehand: all of it, or as much as the priors of the joint solve say.
/// `recordings`: place of the own parameters of each.
MatrixXd WithPriors(bool is_known, double accel_delay, const std::vector<int>& recordings,
                    MatrixXd information) {
  const auto add = [&](int place, double sigma) {
    const double used = is_known ? kKnown : sigma;
    information(place, place) += 1.0 / (used * used);
  };
  for (const int own : recordings) {
    add(own + kDrift - kShared, kDriftPrior);
    add(own + kMagnitude - kShared, kMagnitudePrior);
  }
  for (int row = 0, k = kGyroMatrix; row < 3; ++row)
    for (int column = 0; column <= row; ++column)
      add(k++, row == column ? kScalePrior : kAlignmentPrior);
  for (int k = 0; k < 9; ++k) add(kAccelMatrix + k, k % 4 == 0 ? kScalePrior : kAlignmentPrior);
  add(kAccelSmoothing, AccelSmoothingPeak(accel_delay));
  add(kPoseSmoothing, kSmoothingPeak);
  add(kPositionSmoothing, kSmoothingPeak);
  add(kPositionDelay, kPositionDelayPeak);
  for (const int cumulants : {kPoseCumulants, kPositionCumulants}) {
    add(cumulants, kThirdPeak);
    add(cumulants + 1, kFourthPeak);
  }
  add(kPoseScale, kPoseScalePrior);
  for (int k = 0; k < 6; ++k) add(kAccelPositions + k, kSizePrior);
  return information;
}

ErrorNorms BoundOf(const MatrixXd& information) {
  const Eigen::VectorXd variance =
      information.llt()
          .solve(MatrixXd::Identity(information.rows(), information.cols()))
          .diagonal();
  return {std::sqrt(variance.segment<3>(kTranslation).sum()),
          std::sqrt(variance.segment<3>(kRotation).sum()), std::sqrt(variance[kTimeShift]),
          std::sqrt(variance[kDelay])};
}

}  // namespace

ErrorBounds FindErrorBounds(const std::vector<SimulatorOptions>& truths,
                            const std::vector<SessionData>& recordings, double knots_s) {
  MatrixXd information = MatrixXd::Zero(kShared, kShared);
  std::vector<int> places;
  for (size_t s = 0; s < truths.size(); ++s) {
    const MatrixXd one = RecordingInformation(truths[s], recordings[s], knots_s).Eliminate();
    const Eigen::Index own = one.rows() - kShared, before = information.rows();
    information.conservativeResizeLike(MatrixXd::Zero(before + own, before + own));
    information.topLeftCorner<kShared, kShared>() += one.topLeftCorner<kShared, kShared>();
    information.bottomRightCorner(own, own) = one.bottomRightCorner(own, own);
    information.topRightCorner(kShared, own) = one.topRightCorner(kShared, own);
    information.bottomLeftCorner(own, kShared) = one.bottomLeftCorner(own, kShared);
    places.push_back(static_cast<int>(before));
  }
  const double delay = truths[0].accel_delay_s;
  return {BoundOf(WithPriors(true, delay, places, information)),
          BoundOf(WithPriors(false, delay, places, information))};
}

}  // namespace imu_pose_calib
