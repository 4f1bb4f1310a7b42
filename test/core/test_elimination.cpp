#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <memory>
#include <random>
#include <stdexcept>
#include <utility>
#include <vector>

#include "eliminate_all.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/solver/elimination.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Normal equations like those of a calibration: per session cubic splines of `points` control
/// points, slow knots beside them, and a border that acts nearly everywhere; dense and as panels.
struct RandomEquations {
  int border_columns = 0;
  std::vector<int> sizes, first;  ///< of the blocks, first column
  size_t border = 3;
  std::vector<std::vector<int>> residuals;
  std::vector<size_t> first_of_window;  ///< a third of a session each
  MatrixXd H;                           ///< of all
  MatrixXd B;  ///< right-hand sides, one a session and a last one that has it all
  std::unique_ptr<Elimination> elimination;
  std::vector<Panels> windows;
  Panels shared;

  RandomEquations(int session_count, int points, uint32_t seed) {
    std::mt19937 random(seed);
    std::normal_distribution<double> normal;
    sizes = {3, 1, 2};
    const int knot_spans = 10;
    const int knots = points / knot_spans + 2;
    for (int s = 0; s < session_count; ++s) {
      for (int k = 0; k < knots; ++k) sizes.push_back(3);
      for (int k = 0; k < points + 3; ++k) sizes.push_back(k % 7 == 0 ? 2 : 3);
    }
    int columns = 0;
    for (const int size : sizes) {
      first.push_back(columns);
      columns += size;
    }
    border_columns = first[border];
    std::vector<int> session_of;
    for (int s = 0; s < session_count; ++s) {
      for (const int third : {0, 1, 2})
        first_of_window.push_back(residuals.size() + static_cast<size_t>(third * points / 3));
      const int own = static_cast<int>(border) + s * (knots + points + 3);
      for (int k = 0; k < points; ++k) {
        std::vector<int> blocks = {k % 3, own + k / knot_spans, own + k / knot_spans + 1};
        for (int j = 0; j < 4; ++j) blocks.push_back(own + knots + k + j);
        std::swap(blocks[0], blocks[3]);  // in no order
        residuals.push_back(blocks);
        session_of.push_back(s);
      }
    }
    elimination = std::make_unique<Elimination>(sizes, border, residuals, first_of_window);
    windows.resize(first_of_window.size());
    H = MatrixXd::Zero(columns, columns);
    B = MatrixXd::Zero(columns, session_count + 1);
    for (size_t r = 0; r < residuals.size(); ++r) {
      std::vector<int> places, at;
      std::vector<int> blocks = residuals[r];
      std::sort(blocks.begin(), blocks.end(),
                [this](int a, int b) { return elimination->place(a) < elimination->place(b); });
      for (const int block : blocks) {
        places.push_back(elimination->place(block));
        for (int k = 0; k < sizes[static_cast<size_t>(block)]; ++k)
          at.push_back(first[static_cast<size_t>(block)] + k);
      }
      const auto size = static_cast<Eigen::Index>(at.size());
      const MatrixXd J = MatrixXd::NullaryExpr(6, size, [&] { return normal(random); });
      const VectorXd score = VectorXd::NullaryExpr(size, [&] { return normal(random); });
      const MatrixXd product = J.transpose() * J;
      const auto next = std::upper_bound(first_of_window.begin(), first_of_window.end(), r);
      Panels* own = &windows[static_cast<size_t>(next - first_of_window.begin()) - 1];
      elimination->Add(places, product, own);
      elimination->AddRhs(places, session_of[r], score, own);
      elimination->AddRhs(places, session_count, 2.0 * score, own);
      for (Eigen::Index i = 0; i < size; ++i) {
        for (Eigen::Index j = 0; j < size; ++j)
          H(at[static_cast<size_t>(i)], at[static_cast<size_t>(j)]) += product(i, j);
        B(at[static_cast<size_t>(i)], session_of[r]) += score[i];
        B(at[static_cast<size_t>(i)], session_count) += 2.0 * score[i];
      }
    }
  }
};

class EliminationTest : public testing::TestWithParam<int> {
 protected:
  RandomEquations equations_{GetParam(), 57, 7};
};

TEST_P(EliminationTest, ReducesToTheSchurComplement) {
  RandomEquations& e = equations_;
  const Eigen::Index border = e.border_columns, inner = e.H.rows() - border;
  const Reduced reduced =
      EliminateAll(*e.elimination, VectorXd::Ones(e.B.cols()), false, &e.windows, &e.shared);
  const MatrixXd D = e.H.bottomRightCorner(inner, inner), C = e.H.bottomLeftCorner(inner, border);
  const Eigen::LLT<MatrixXd> llt(D);
  const MatrixXd H = e.H.topLeftCorner(border, border) - C.transpose() * llt.solve(C);
  const MatrixXd B = e.B.topRows(border) - C.transpose() * llt.solve(e.B.bottomRows(inner));
  EXPECT_LT((reduced.H - H).norm(), 1e-10 * H.norm());
  EXPECT_LT((reduced.B - B).norm(), 1e-10 * B.norm());
  const MatrixXd products = e.B.transpose() * e.H.llt().solve(e.B);
  EXPECT_LT((reduced.Products() - products).norm(), 1e-10 * products.norm());
}

TEST_P(EliminationTest, SubstitutesBack) {
  RandomEquations& e = equations_;
  const VectorXd weights = VectorXd::LinSpaced(e.B.cols(), -1.0, 2.0);
  const Reduced reduced = EliminateAll(*e.elimination, weights, true, &e.windows, &e.shared);
  VectorXd x = VectorXd::Zero(e.H.rows());
  x.head(e.border_columns) = -reduced.H.llt().solve(reduced.B * weights);
  e.elimination->SubstituteBack(e.shared, &x);
  for (const Panels& own : e.windows) e.elimination->SubstituteBack(own, &x);
  const VectorXd expected = -e.H.llt().solve(e.B * weights);
  EXPECT_LT((x - expected).norm(), 1e-10 * expected.norm());
}

TEST_P(EliminationTest, InvertsAtItsPlaces) {
  RandomEquations& e = equations_;
  const Reduced reduced =
      EliminateAll(*e.elimination, VectorXd::Ones(e.B.cols()), true, &e.windows, &e.shared);
  for (Panels& own : e.windows) e.shared.merge(own);
  const Eigen::Index border = e.border_columns;
  e.elimination->Invert(reduced.H.llt().solve(MatrixXd::Identity(border, border)), 2, &e.shared);
  const MatrixXd expected = e.H.llt().solve(MatrixXd::Identity(e.H.rows(), e.H.rows()));
  for (Eigen::Index i = 0; i < e.H.rows(); ++i)
    for (Eigen::Index j = 0; j < e.H.rows(); ++j)
      if (e.H(i, j) != 0.0) {
        ASSERT_NEAR(e.elimination->At(e.shared, static_cast<int>(i), static_cast<int>(j)),
                    expected(i, j), 1e-10 * std::sqrt(expected(i, i) * expected(j, j)))
            << i << " " << j;
      }
}

INSTANTIATE_TEST_SUITE_P(Sessions, EliminationTest, testing::Values(1, 3));

TEST(Elimination, OfAPartLeavesOutWhatActsElsewhere) {
  RandomEquations e(1, 60, 3);
  // Only the last third of the residuals, of which the first points are not.
  std::vector<Panels> windows(3);
  Panels shared;
  MatrixXd H = MatrixXd::Zero(e.H.rows(), e.H.rows());
  std::mt19937 random(1);
  for (size_t r = 40; r < e.residuals.size(); ++r) {
    std::vector<int> blocks = e.residuals[r], places, at;
    std::sort(blocks.begin(), blocks.end(),
              [&](int a, int b) { return e.elimination->place(a) < e.elimination->place(b); });
    for (const int block : blocks) {
      places.push_back(e.elimination->place(block));
      for (int k = 0; k < e.sizes[static_cast<size_t>(block)]; ++k)
        at.push_back(e.first[static_cast<size_t>(block)] + k);
    }
    std::normal_distribution<double> normal;
    const auto size = static_cast<Eigen::Index>(at.size());
    const MatrixXd J = MatrixXd::NullaryExpr(9, size, [&] { return normal(random); });
    e.elimination->Add(places, J.transpose() * J, &windows.back());
    for (Eigen::Index i = 0; i < size; ++i)
      for (Eigen::Index j = 0; j < size; ++j)
        H(at[static_cast<size_t>(i)], at[static_cast<size_t>(j)]) += J.col(i).dot(J.col(j));
  }
  const Reduced reduced = EliminateAll(*e.elimination, VectorXd::Ones(1), false, &windows, &shared);
  for (Eigen::Index i = 0; i < H.rows(); ++i)
    if (H(i, i) == 0.0) H(i, i) = 1.0;
  const MatrixXd expected =
      H.llt().solve(MatrixXd::Identity(H.rows(), H.rows())).topLeftCorner(6, 6).inverse();
  EXPECT_LT((reduced.H - expected).norm(), 1e-9 * expected.norm());
}

/// A half of a recording sees of what it shares with the other one what its last sample does.
TEST(Elimination, OfAPartToldTooLittleTellsNothing) {
  for (uint32_t seed = 10; seed < 30; ++seed) {
    RandomEquations e(1, 60, seed);
    std::vector<Panels> windows(3);
    Panels shared;
    std::mt19937 random(seed);
    std::normal_distribution<double> normal;
    std::vector<int> places;
    Eigen::Index size = 0;
    for (const int block : e.residuals[40]) {
      places.push_back(e.elimination->place(block));
      size += e.sizes[static_cast<size_t>(block)];
    }
    std::sort(places.begin(), places.end());
    const MatrixXd J = MatrixXd::NullaryExpr(5, size, [&] { return normal(random); });
    e.elimination->Add(places, J.transpose() * J, &windows.back());
    const Reduced reduced =
        EliminateAll(*e.elimination, VectorXd::Ones(1), false, &windows, &shared);
    EXPECT_LT(reduced.H.cwiseAbs().maxCoeff(), 1e-9) << seed;
  }
}

TEST(Elimination, OfSingularEquationsIsNotFinite) {
  RandomEquations e(1, 20, 5);
  // A block that acts as if its information were negative.
  e.elimination->VisitDiagonal(
      [](int block, auto diagonal) {
        if (block == 12) diagonal.array() -= 1e3;
      },
      &e.windows[0]);
  const Reduced reduced =
      EliminateAll(*e.elimination, VectorXd::Ones(2), true, &e.windows, &e.shared);
  EXPECT_FALSE(reduced.H.allFinite());
  EXPECT_FALSE(reduced.Products().allFinite());
}

TEST(Elimination, MergedPanelsAreTheSum) {
  RandomEquations a(1, 37, 8), b(1, 37, 9);
  const MatrixXd H = a.H + b.H, B = a.B + b.B;
  for (size_t w = 0; w < a.windows.size(); ++w) Elimination::Merge(b.windows[w], &a.windows[w]);
  const Reduced reduced =
      EliminateAll(*a.elimination, VectorXd::Ones(2), false, &a.windows, &a.shared);
  const MatrixXd products = B.transpose() * H.llt().solve(B);
  EXPECT_LT((reduced.Products() - products).norm(), 1e-10 * products.norm());
}

TEST(InParallel, CallsEachOnceAndThrowsOn) {
  std::vector<int> calls(100, 0);
  InParallel(4, calls.size(), [&calls](size_t k) { ++calls[k]; });
  EXPECT_EQ(calls, std::vector<int>(100, 1));
  EXPECT_THROW(InParallel(4, calls.size(),
                          [](size_t k) {
                            if (k == 57) throw std::runtime_error("57");
                          }),
               std::runtime_error);
}

}  // namespace
}  // namespace imu_pose_calib
