#include <ceres/jet.h>
#include <gtest/gtest.h>

#include <Eigen/LU>
#include <random>
#include <unsupported/Eigen/MatrixFunctions>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr int kAxes = 50;  // random ones, at each angle
const double kAngles[] = {
    0.0, 1e-12, 1e-5,        0.999e-4, 1.001e-4,   1e-3, 0.0999,           0.1001, 1.0,
    2.0, 3.0,   M_PI - 1e-6, M_PI,     M_PI + 0.1, 4.0,  2.0 * M_PI - 0.1, 7.0};

/// Calls check(r) at every angle about many axes.
template <typename Check>
void ForEachVector(uint32_t seed, const Check& check) {
  std::mt19937 random(seed);
  for (const double angle : kAngles) {
    SCOPED_TRACE("angle " + std::to_string(angle));
    for (int i = 0; i < kAxes; ++i) check(Vector3d(angle * RandomAxis(&random)));
  }
}

/// Right Jacobian: Exp(r + d) = Exp(r) Exp(J_r(r) d) to first order in d. For R = Exp(r) the body
/// rate is omega = J_r(r) r'.
template <typename T>
Eigen::Matrix<T, 3, 3> RightJacobian(const Eigen::Matrix<T, 3, 1>& r) {
  const internal::JacobianTerms<T> j(r.squaredNorm());
  const Eigen::Matrix<T, 3, 3> H = Hat(r);
  return Eigen::Matrix<T, 3, 3>::Identity() - j.b * H + j.c * H * H;
}

/// Time derivative of RightJacobian(r) when r changes at the rate r_dot. For R = Exp(r) the body
/// angular acceleration is alpha = J_r(r) r'' + (d/dt J_r(r)) r'.
template <typename T>
Eigen::Matrix<T, 3, 3> RightJacobianRate(const Eigen::Matrix<T, 3, 1>& r,
                                         const Eigen::Matrix<T, 3, 1>& r_dot) {
  const internal::JacobianTerms<T> j(r.squaredNorm());
  const T s_dot = T(2) * r.dot(r_dot);
  const Eigen::Matrix<T, 3, 3> H = Hat(r);
  const Eigen::Matrix<T, 3, 3> D = Hat(r_dot);
  return -s_dot * j.db * H - j.b * D + s_dot * j.dc * H * H + j.c * (D * H + H * D);
}

TEST(Hat, IsTheCrossProduct) {
  std::mt19937 random(1);
  for (int i = 0; i < kAxes; ++i) {
    const Vector3d a = 3.0 * RandomAxis(&random), b = 2.0 * RandomAxis(&random);
    EXPECT_LT((Hat(a) * b - a.cross(b)).norm(), 1e-14);
    EXPECT_EQ(Hat(a), -Hat(a).transpose());
  }
}

TEST(Exp, IsTheMatrixExponentialOfHat) {
  ForEachVector(2, [](const Vector3d& r) {
    const Matrix3d R = Hat(r).exp();
    EXPECT_NEAR(Exp(r).norm(), 1.0, 1e-14);
    EXPECT_LT((Exp(r).toRotationMatrix() - R).norm(), 1e-13);
    EXPECT_LT((Exp(Vector3d(-r)).toRotationMatrix() - R.transpose()).norm(), 1e-13);
  });
}

TEST(Exp, MultipliesAsMatricesDo) {
  std::mt19937 random(3);
  ForEachVector(3, [&random](const Vector3d& a) {
    const Vector3d b = 1.3 * RandomAxis(&random);
    const Matrix3d product = Hat(a).exp() * Hat(b).exp();
    EXPECT_LT(((Exp(a) * Exp(b)).toRotationMatrix() - product).norm(), 1e-13);
    const Matrix3d whole = Exp(a).toRotationMatrix();
    const Quaterniond parts = Exp(Vector3d(0.3 * a)) * Exp(Vector3d(0.7 * a));
    EXPECT_LT((parts.toRotationMatrix() - whole).norm(), 1e-13);
  });
}

TEST(Log, UndoesExpBelowPi) {
  ForEachVector(4, [](const Vector3d& r) {
    if (r.norm() >= M_PI) return;
    EXPECT_LE((Log(Exp(r)) - r).norm(), 1e-13 * r.norm()) << r.transpose();
  });
}

TEST(Log, IsTheShortestRotationOfEveryUnitQuaternion) {
  ForEachVector(5, [](const Vector3d& r) {
    for (const double sign : {1.0, -1.0}) {
      const Quaterniond q(sign * Exp(r).coeffs());
      const Vector3d shortest = Log(q);
      EXPECT_LE(shortest.norm(), M_PI + 1e-14);
      EXPECT_LT((Exp(shortest).toRotationMatrix() - q.toRotationMatrix()).norm(), 1e-13);
    }
  });
}

TEST(Log, IsTheSameForBothSignsOfTheQuaternion) {
  ForEachVector(6, [](const Vector3d& r) {
    if (std::abs(r.norm() - M_PI) < 1e-9) return;  // both r and -r are right there
    const Quaterniond q = Exp(r);
    EXPECT_EQ(Log(q), Log(Quaterniond(-q.coeffs())));
  });
}

TEST(RightJacobian, IsTheSlopeOfExp) {
  ForEachVector(7, [](const Vector3d& r) {
    const auto moved = [&r](const Vector3d& d) {
      return Log(Quaterniond(Exp(r).conjugate() * Exp(Vector3d(r + d))));
    };
    const Matrix3d numeric = NumericJacobian(moved, Vector3d::Zero(), 1e-3);
    EXPECT_LT((RightJacobian(r) - numeric).norm(), 1e-10);
  });
}

TEST(RightJacobianRate, IsTheSlopeOfTheRightJacobianAlongACurve) {
  std::mt19937 random(8);
  ForEachVector(8, [&random](const Vector3d& r) {
    const Vector3d r_dot = 2.0 * RandomAxis(&random), r_ddot = 5.0 * RandomAxis(&random);
    const auto along = [&](double t) {
      return RightJacobian(Vector3d(r + r_dot * t + 0.5 * r_ddot * t * t));
    };
    const Eigen::VectorXd numeric = NumericRate(along, 0.0, 1e-3);
    const Matrix3d rate = RightJacobianRate(r, r_dot);
    EXPECT_LT((rate - Eigen::Map<const Matrix3d>(numeric.data())).norm(), 1e-9);
  });
}

TEST(So3, IsContinuousWhereTheTaylorSeriesTakesOver) {
  std::mt19937 random(9);
  for (int i = 0; i < kAxes; ++i) {
    const Vector3d axis = RandomAxis(&random), r_dot = 2.0 * RandomAxis(&random);
    // Exp and Log switch at |r| = 1e-4 and |q.vec| = 1e-4, the Jacobians at |r| = 0.1. A relative
    // step of 1e-12 moves the functions themselves by 1e-13 at most.
    for (const double angle : {1e-4, 2e-4, 0.1}) {
      const Vector3d below = (1.0 - 1e-12) * angle * axis, above = (1.0 + 1e-12) * angle * axis;
      EXPECT_LT((Exp(below).coeffs() - Exp(above).coeffs()).norm(), 2e-12 * angle);
      EXPECT_LT((Log(Exp(below)) - Log(Exp(above))).norm(), 4e-12 * angle);
      EXPECT_LT((RightJacobian(below) - RightJacobian(above)).norm(), 1e-12);
      EXPECT_LT((RightJacobianRate(below, r_dot) - RightJacobianRate(above, r_dot)).norm(), 1e-10);
    }
  }
}

// --- The same with Jets ---

using Jet = ceres::Jet<double, 3>;
using Jet3 = Eigen::Matrix<Jet, 3, 1>;

/// x with the identity as its derivative.
Jet3 Seed(const Vector3d& x) {
  Jet3 jets;
  for (int i = 0; i < 3; ++i) jets[i] = Jet(x[i], i);
  return jets;
}

/// Values and derivatives of any matrix of Jets, one row per coefficient.
template <typename Derived>
void Split(const Eigen::DenseBase<Derived>& jets, Eigen::VectorXd* value,
           Eigen::MatrixXd* derivative) {
  value->resize(jets.size());
  derivative->resize(jets.size(), 3);
  for (Eigen::Index i = 0; i < jets.size(); ++i) {
    const Jet& jet = jets.derived().data()[i];
    (*value)[i] = jet.a;
    derivative->row(i) = jet.v.transpose();
  }
}

/// Expects value and derivative of a function of Jets to be those of the function of doubles.
template <typename OfJets, typename OfDoubles>
void ExpectSameDerivative(const OfJets& jets, const OfDoubles& doubles, const Vector3d& x,
                          double tolerance) {
  Eigen::VectorXd value;
  Eigen::MatrixXd derivative;
  Split(jets(Seed(x)), &value, &derivative);
  EXPECT_LT((value - doubles(x)).norm(), 1e-14);
  EXPECT_LT((derivative - NumericJacobian(doubles, x, 1e-3)).norm(), tolerance) << x.transpose();
}

Eigen::VectorXd Flat(const Matrix3d& m) { return Eigen::Map<const Eigen::VectorXd>(m.data(), 9); }

TEST(So3OfJets, ExpHasTheSlopeOfItsValues) {
  ForEachVector(10, [](const Vector3d& r) {
    ExpectSameDerivative(
        [](const Jet3& x) { return Exp(x).coeffs(); },
        [](const Eigen::VectorXd& x) -> Eigen::VectorXd { return Exp(Vector3d(x)).coeffs(); }, r,
        1e-10);
  });
}

TEST(CorrectionRate, IsTheRateOfTheExponentialAndItsDerivative) {
  std::mt19937 random(13);
  ForEachVector(13, [&random](const Vector3d& r) {
    const Vector3d r_dot = 2.0 * RandomAxis(&random), r_ddot = 5.0 * RandomAxis(&random);
    Vector3d u, u_dot;
    CorrectionRate(r, r_dot, r_ddot, &u, &u_dot);
    EXPECT_LT((u - RightJacobian(r) * r_dot).norm(), 1e-12);
    const Vector3d expected = RightJacobian(r) * r_ddot + RightJacobianRate(r, r_dot) * r_dot;
    EXPECT_LT((u_dot - expected).norm(), 1e-11);
  });
}

TEST(So3OfJets, LogTurnsStepsByTheInverseRightJacobian) {
  // Log(Exp(r) Exp(d)) = r + J_r(r)^-1 d to first order.
  ForEachVector(11, [](const Vector3d& r) {
    if (r.norm() >= M_PI) return;
    const Eigen::Quaternion<Jet> q = Exp(r).cast<Jet>() * Exp(Seed(Vector3d::Zero()));
    Eigen::VectorXd value;
    Eigen::MatrixXd derivative;
    Split(Log(q), &value, &derivative);
    EXPECT_LE((value - r).norm(), 1e-13 * r.norm());
    EXPECT_LT((derivative - RightJacobian(r).inverse()).norm(), 1e-9) << r.transpose();
  });
}

TEST(So3OfJets, TermsOfTheJacobianHaveTheSlopesTheyState) {
  using Jet1 = ceres::Jet<double, 1>;
  for (const double s : {0.0, 1e-4, 9.9e-3, 1.01e-2, 0.1, 1.0, 4.0, 9.0}) {
    const internal::JacobianTerms<Jet1> of_jet(Jet1(s, 0));
    const internal::JacobianTerms<double> terms(s);
    EXPECT_NEAR(terms.db, of_jet.b.v[0], 1e-9) << s;
    EXPECT_NEAR(terms.dc, of_jet.c.v[0], 1e-9) << s;
  }
}

TEST(So3OfJets, RightJacobianAndItsRateHaveTheSlopeOfTheirValues) {
  std::mt19937 random(12);
  ForEachVector(12, [&random](const Vector3d& r) {
    ExpectSameDerivative([](const Jet3& x) { return RightJacobian(x); },
                         [](const Vector3d& x) { return Flat(RightJacobian(x)); }, r, 1e-9);
    const Vector3d r_dot = 2.0 * RandomAxis(&random);
    ExpectSameDerivative(
        [&](const Jet3& x) { return RightJacobianRate(x, Jet3(r_dot.cast<Jet>())); },
        [&](const Vector3d& x) { return Flat(RightJacobianRate(x, r_dot)); }, r, 1e-7);
  });
}

}  // namespace
}  // namespace imu_pose_calib
