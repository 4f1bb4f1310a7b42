#include "imu_pose_calib/core/solver/elimination.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <limits>
#include <numeric>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"

namespace imu_pose_calib {
namespace {

/// Columns of a panel: about as many as a control point acts together with, so that the dense
/// products pay.
constexpr int kPanelColumns = 24;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

size_t Index(int k) { return static_cast<size_t>(k); }

}  // namespace

Eigen::MatrixXd Reduced::Products() const {
  const Eigen::LLT<Eigen::MatrixXd> llt(H);
  if (!H.allFinite() || llt.info() != Eigen::Success)
    return Eigen::MatrixXd::Constant(B.cols(), B.cols(), kNan);
  const Eigen::MatrixXd y = llt.matrixL().solve(B);
  return inner + y.transpose() * y;
}

Elimination::Elimination(const std::vector<int>& sizes, size_t border,
                         const std::vector<std::vector<int>>& residuals,
                         const std::vector<size_t>& first_of_window)
    : place_(sizes.size()), block_at_(sizes.size()) {
  const std::vector<int> window = OrderBlocks(border, residuals, first_of_window);
  FormPanels(sizes, border, window, static_cast<int>(first_of_window.size()));
  FindRows(residuals);
}

std::vector<int> Elimination::OrderBlocks(size_t border,
                                          const std::vector<std::vector<int>>& residuals,
                                          const std::vector<size_t>& first_of_window) {
  // Blocks by window and the last residual that has them; what none has stays beside its neighbour.
  const auto windows = static_cast<int>(first_of_window.size());
  std::vector<size_t> last(place_.size(), 0);
  std::vector<int> window(place_.size(), -1);
  for (size_t r = 0, w = 0; r < residuals.size(); ++r) {
    while (w + 1 < first_of_window.size() && r >= first_of_window[w + 1]) ++w;
    for (const int block : residuals[r]) {
      last[Index(block)] = r;
      int& own = window[Index(block)];
      own = own < 0 || own == static_cast<int>(w) ? static_cast<int>(w) : windows;
    }
  }
  for (size_t b = border; b < place_.size(); ++b) {
    if (window[b] >= 0) continue;
    window[b] = b > border ? window[b - 1] : 0;
    last[b] = b > border ? last[b - 1] : 0;
  }
  std::iota(block_at_.begin(), block_at_.end(), 0);
  std::rotate(block_at_.begin(), block_at_.begin() + static_cast<ptrdiff_t>(border),
              block_at_.end());
  const auto inner_end = block_at_.end() - static_cast<ptrdiff_t>(border);
  std::stable_sort(block_at_.begin(), inner_end, [&](int a, int b) {
    return std::make_pair(window[Index(a)], last[Index(a)]) <
           std::make_pair(window[Index(b)], last[Index(b)]);
  });
  return window;
}

void Elimination::FormPanels(const std::vector<int>& sizes, size_t border,
                             const std::vector<int>& window, int windows) {
  const size_t inner = sizes.size() - border;
  for (size_t k = 0; k < sizes.size(); ++k) {
    const int block = block_at_[k];
    place_[Index(block)] = static_cast<int>(k);
    const bool is_full = k > 0 && shapes_.back().columns >= kPanelColumns && k < inner;
    const int own = k < inner ? window[Index(block)] : windows;
    if (k == 0 || k == inner || is_full || own >= static_cast<int>(first_panel_.size())) {
      first_panel_.resize(std::max(first_panel_.size(), Index(own) + 1),
                          static_cast<int>(shapes_.size()));
      shapes_.emplace_back();
      shapes_.back().first = static_cast<int>(k);
    }
    Shape& shape = shapes_.back();
    panel_.push_back(border_panel());
    offset_.push_back(shape.columns);
    size_.push_back(sizes[Index(block)]);
    shape.columns += size_.back();
    shape.end = static_cast<int>(k) + 1;
  }
  first_panel_.resize(Index(windows) + 1, static_cast<int>(shapes_.size()));
  if (border == 0) {  // the last panel is it all the same
    shapes_.emplace_back();
    shapes_.back().first = shapes_.back().end = static_cast<int>(inner);
  }
  first_column_.resize(sizes.size());
  for (size_t b = 0; b < sizes.size(); ++b) {
    first_column_[Index(place_[b])] = columns_;
    for (int k = 0; k < sizes[b]; ++k) place_of_column_.emplace_back(place_[b], k);
    columns_ += sizes[b];
  }
}

void Elimination::FindRows(const std::vector<std::vector<int>>& residuals) {
  std::vector<int> places, seen_by(place_.size(), -1);  // panel that had it last
  for (const std::vector<int>& blocks : residuals) {
    if (blocks.empty()) continue;
    places.clear();
    for (const int block : blocks) places.push_back(place(block));
    const int panel = panel_[Index(*std::min_element(places.begin(), places.end()))];
    Shape& shape = shapes_[Index(panel)];
    for (const int k : places)
      if (k >= shape.end && std::exchange(seen_by[Index(k)], panel) != panel)
        shape.rows.push_back(k);
  }
  for (Shape& shape : shapes_) {
    std::vector<int>& rows = shape.rows;
    std::sort(rows.begin(), rows.end());
    rows.erase(std::unique(rows.begin(), rows.end()), rows.end());
    shape.height = shape.columns;
    for (const int k : rows) {
      shape.row_offset.push_back(shape.height);
      shape.height += size_[Index(k)];
    }
    if (rows.empty()) continue;
    // Eliminated, they act on each other.
    Shape& next = shapes_[Index(panel_[Index(rows.front())])];
    std::copy_if(rows.begin(), rows.end(), std::back_inserter(next.rows),
                 [&next](int k) { return k >= next.end; });
  }
}

double Elimination::factor_mb() const {
  double elements = 0.0;
  for (const Shape& shape : shapes_) elements += static_cast<double>(shape.height * shape.columns);
  return 1e-6 * sizeof(double) * elements;
}

int Elimination::Offset(int block, int panel) const {
  if (panel_[Index(block)] == panel) return offset_[Index(block)];
  const Shape& shape = shapes_[Index(panel)];
  const auto found = std::lower_bound(shape.rows.begin(), shape.rows.end(), block);
  if (found == shape.rows.end() || *found != block) return -1;
  return shape.row_offset[static_cast<size_t>(found - shape.rows.begin())];
}

Panel* Elimination::Touch(int panel, Panels* panels) const {
  const auto [place, is_new] = panels->try_emplace(panel);
  const Shape& shape = shapes_[Index(panel)];
  if (is_new) place->second.H = Eigen::MatrixXd::Zero(shape.height, shape.columns);
  return &place->second;
}

void Elimination::Add(const std::vector<int>& places,
                      const Eigen::Ref<const Eigen::MatrixXd>& product, Panels* panels) const {
  struct Run {
    int from, to, count;  // rows of the product and of the panel
  };
  thread_local std::vector<Run> runs;
  int column = 0;
  for (size_t begin = 0, end = 0; begin < places.size(); begin = end) {
    const int panel = panel_[Index(places[begin])];
    const std::vector<int>& rows = shapes_[Index(panel)].rows;
    auto below = rows.begin();
    int row = column, count = 0;
    runs.clear();
    for (size_t i = begin; i < places.size(); ++i) {
      const size_t k = Index(places[i]);
      int to = offset_[k];
      if (panel_[k] == panel) {
        end = i + 1;
        count += size_[k];
      } else {
        if (*below != places[i]) below = std::lower_bound(below, rows.end(), places[i]);
        to = shapes_[Index(panel)].row_offset[static_cast<size_t>(below++ - rows.begin())];
      }
      if (!runs.empty() && runs.back().to + runs.back().count == to)
        runs.back().count += size_[k];
      else
        runs.push_back({row, to, size_[k]});
      row += size_[k];
    }
    Eigen::MatrixXd& H = Touch(panel, panels)->H;
    for (size_t first = 0; count > 0; ++first) {
      const Run run = runs[first];
      for (int j = 0; j < std::min(run.count, count); ++j) {
        const double* const from = product.data() + (run.from + j) * product.outerStride();
        double* const to = &H(0, run.to + j);
        for (int i = j; i < run.count; ++i) to[run.to + i] += from[run.from + i];
        for (size_t r = first + 1; r < runs.size(); ++r)
          for (int i = 0; i < runs[r].count; ++i) to[runs[r].to + i] += from[runs[r].from + i];
      }
      count -= run.count;
      column += run.count;
    }
    column += count;  // rows below came in the same run
  }
}

void Elimination::AddRhs(const std::vector<int>& places, int number,
                         const Eigen::Ref<const Eigen::VectorXd>& rhs, Panels* panels) const {
  Eigen::Index row = 0;
  int panel = -1;
  Eigen::VectorXd* own = nullptr;
  for (const int place : places) {
    const size_t k = Index(place);
    if (own == nullptr || panel_[k] != panel) {
      panel = panel_[k];
      Panel* const touched = Touch(panel, panels);
      own = &touched->rhs[number];
      if (own->size() == 0) *own = Eigen::VectorXd::Zero(touched->H.cols());
    }
    own->segment(offset_[k], size_[k]) += rhs.segment(row, size_[k]);
    row += size_[k];
  }
}

void Elimination::Merge(const Panels& from, Panels* to) {
  for (const auto& [p, panel] : from) {
    const auto [place, is_new] = to->try_emplace(p, panel);
    if (is_new) continue;
    place->second.H += panel.H;
    for (const auto& [number, rhs] : panel.rhs) {
      Eigen::VectorXd& own = place->second.rhs[number];
      own = own.size() == 0 ? rhs : (own + rhs).eval();
    }
  }
}

void Elimination::Gather(int p, const Panel& own, Rest* rest, Eigen::MatrixXd* H,
                         Eigen::MatrixXd* B) const {
  const Shape& shape = shapes_[Index(p)];
  const auto waiting = rest->waiting.find(p);
  // Right-hand sides in the order in which they are met: those to come are 0 so far.
  std::vector<int>& met = rest->numbers;
  const auto column = [&met](int number) {
    const auto found = std::find(met.begin(), met.end(), number);
    if (found == met.end()) met.push_back(number);
    return found - met.begin();
  };
  for (const auto& [number, unused] : own.rhs) column(number);
  if (waiting != rest->waiting.end())
    for (const auto& update : waiting->second)
      for (const int number : update->numbers) column(number);
  *H = Eigen::MatrixXd::Zero(shape.height, shape.height);
  *B = Eigen::MatrixXd::Zero(shape.height, static_cast<Eigen::Index>(met.size()));
  H->leftCols(shape.columns) = own.H;
  for (const auto& [number, rhs] : own.rhs) B->col(column(number)).head(shape.columns) = rhs;
  if (waiting == rest->waiting.end()) return;
  for (const auto& update : waiting->second) {
    std::vector<int> rows;  // of the panel
    for (const int k : update->rows) {
      const int first = Offset(k, p);
      for (int i = 0; i < size_[Index(k)]; ++i) rows.push_back(first + i);
    }
    for (size_t j = 0; j < rows.size(); ++j)
      for (size_t i = j; i < rows.size(); ++i)
        (*H)(rows[i], rows[j]) +=
            update->H(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
    for (Eigen::Index k = 0; k < update->B.cols(); ++k) {
      const Eigen::Index at = column(update->numbers[Index(static_cast<int>(k))]);
      for (size_t i = 0; i < rows.size(); ++i)
        (*B)(rows[i], at) += update->B(static_cast<Eigen::Index>(i), k);
    }
  }
}

void Elimination::EliminatePanels(int begin, int end, const Eigen::VectorXd& weights, bool keeps,
                                  Panels* panels, Rest* rest) const {
  Eigen::MatrixXd F, B;
  const auto last = panels->lower_bound(end);
  for (auto entry = panels->lower_bound(begin); entry != last; ++entry) {
    auto& [p, panel] = *entry;
    const Shape& shape = shapes_[Index(p)];
    Gather(p, panel, rest, &F, &B);
    const std::vector<int>& numbers = rest->numbers;
    const Eigen::Index known = B.cols();
    const int below = shape.height - shape.columns;
    for (int j = 0; j < shape.columns; ++j)
      if (F(j, j) == 0.0) F(j, j) = 1.0;
    Eigen::Ref<Eigen::MatrixXd> own = F.topLeftCorner(shape.columns, shape.columns);
    const Eigen::LLT<Eigen::Ref<Eigen::MatrixXd>> llt(own);
    if (llt.info() != Eigen::Success) {
      rest->is_singular = true;
      return;
    }
    auto L = F.bottomLeftCorner(below, shape.columns);
    if (below > 0) llt.matrixL().transpose().solveInPlace<Eigen::OnTheRight>(L);
    auto y = B.topRows(shape.columns);
    if (known > 0) llt.matrixL().solveInPlace(y);
    rest->inner.conservativeResizeLike(Eigen::MatrixXd::Zero(known, known));
    rest->inner.noalias() += y.transpose() * y;
    AddProduct(-1.0, L, L, true, F.bottomRightCorner(below, below));
    B.bottomRows(below).noalias() -= L * y;
    // What no residual here has is not there.
    auto update = std::make_shared<Update>();
    update->numbers = numbers;
    std::vector<int> kept;
    for (size_t r = 0; r < shape.rows.size(); ++r) {
      const int k = shape.rows[r];
      if (panels->count(panel_[Index(k)]) == 0) continue;
      update->rows.push_back(k);
      for (int i = 0; i < size_[Index(k)]; ++i) kept.push_back(shape.row_offset[r] + i);
    }
    const auto size = static_cast<Eigen::Index>(kept.size());
    update->H.resize(size, size);
    update->B.resize(size, known);
    for (Eigen::Index j = 0; j < size; ++j)
      for (Eigen::Index i = j; i < size; ++i)
        update->H(i, j) = F(kept[Index(static_cast<int>(i))], kept[Index(static_cast<int>(j))]);
    for (Eigen::Index i = 0; i < size; ++i)
      update->B.row(i) = B.row(kept[Index(static_cast<int>(i))]);
    if (keeps) {
      panel.H = F.leftCols(shape.columns);
      Eigen::VectorXd combined = Eigen::VectorXd::Zero(shape.columns);
      for (Eigen::Index j = 0; j < known; ++j)
        combined += weights[numbers[Index(static_cast<int>(j))]] * y.col(j);
      panel.rhs.clear();
      panel.rhs.emplace(0, std::move(combined));
    }
    rest->waiting.erase(p);
    if (size == 0) continue;
    const int next = panel_[Index(update->rows.front())];
    rest->waiting[next].push_back(std::move(update));
  }
}

Rest Elimination::EliminateWindow(int window, const Eigen::VectorXd& weights, bool keeps,
                                  Panels* panels) const {
  Touch(border_panel(), panels);
  Rest rest;
  EliminatePanels(first_panel_[Index(window)], first_panel_[Index(window) + 1], weights, keeps,
                  panels, &rest);
  return rest;
}

Panels Elimination::TakeShared(Panels* window) const {
  Panels shared;
  while (!window->empty() && window->rbegin()->first >= first_panel_.back())
    shared.insert(window->extract(std::prev(window->end())));
  return shared;
}

Reduced Elimination::Reduce(const std::vector<const Rest*>& windows, const Eigen::VectorXd& weights,
                            bool keeps, Panels* shared) const {
  const Eigen::Index count = weights.size();
  Reduced reduced{{}, Eigen::MatrixXd::Zero(border_columns(), count), {}};
  reduced.inner = Eigen::MatrixXd::Zero(count, count);
  const auto add_inner = [&reduced](const Rest& rest) {
    for (Eigen::Index j = 0; j < rest.inner.cols(); ++j)
      for (Eigen::Index i = 0; i < rest.inner.rows(); ++i)
        reduced.inner(rest.numbers[Index(static_cast<int>(i))],
                      rest.numbers[Index(static_cast<int>(j))]) += rest.inner(i, j);
  };
  Rest rest;
  for (const Rest* window : windows) {
    for (const auto& [p, updates] : window->waiting)
      rest.waiting[p].insert(rest.waiting[p].end(), updates.begin(), updates.end());
    add_inner(*window);
    rest.is_singular = rest.is_singular || window->is_singular;
  }
  const Panel& border = *Touch(border_panel(), shared);
  EliminatePanels(first_panel_.back(), border_panel(), weights, keeps, shared, &rest);
  add_inner(rest);
  Eigen::MatrixXd B;
  Gather(border_panel(), border, &rest, &reduced.H, &B);
  for (size_t j = 0; j < rest.numbers.size(); ++j)
    reduced.B.col(rest.numbers[j]) = B.col(static_cast<Eigen::Index>(j));
  reduced.H = Eigen::MatrixXd(reduced.H.selfadjointView<Eigen::Lower>());
  if (rest.is_singular) reduced.H.setConstant(kNan);
  return reduced;
}

int Elimination::WindowOf(int block) const {
  const int panel = panel_[Index(place(block))];
  const auto next = std::upper_bound(first_panel_.begin(), first_panel_.end(), panel);
  return static_cast<int>(next - first_panel_.begin()) - 1;
}

void Elimination::SubstituteBack(const Panels& panels, Eigen::VectorXd* x) const {
  for (auto entry = panels.rbegin(); entry != panels.rend(); ++entry) {
    if (entry->first == border_panel()) continue;
    const Shape& shape = shapes_[Index(entry->first)];
    const Eigen::MatrixXd& L = entry->second.H;
    Eigen::VectorXd own = -entry->second.rhs.at(0);
    for (size_t r = 0; r < shape.rows.size(); ++r) {
      const size_t k = Index(shape.rows[r]);
      own -= L.middleRows(shape.row_offset[r], size_[k]).transpose() *
             x->segment(first_column_[k], size_[k]);
    }
    L.topRows(shape.columns).triangularView<Eigen::Lower>().transpose().solveInPlace(own);
    for (int k = shape.first; k < shape.end; ++k)
      x->segment(first_column_[Index(k)], size_[Index(k)]) =
          own.segment(offset_[Index(k)], size_[Index(k)]);
  }
}

void Elimination::Invert(const Eigen::MatrixXd& border, Panels* panels) const {
  for (auto entry = panels->rbegin(); entry != panels->rend(); ++entry) {
    Eigen::MatrixXd& Z = entry->second.H;
    if (entry->first == border_panel()) {
      Z = border;
      continue;
    }
    const Shape& shape = shapes_[Index(entry->first)];
    const int below = shape.height - shape.columns;
    Eigen::MatrixXd later = Eigen::MatrixXd::Zero(below, below);  // lower triangle
    for (size_t c = 0; c < shape.rows.size(); ++c) {
      const size_t column = Index(shape.rows[c]);
      const auto source = panels->find(panel_[column]);
      if (source == panels->end()) continue;
      for (size_t r = c; r < shape.rows.size(); ++r) {
        const size_t row = Index(shape.rows[r]);
        later.block(shape.row_offset[r] - shape.columns, shape.row_offset[c] - shape.columns,
                    size_[row], size_[column]) =
            source->second.H.block(Offset(shape.rows[r], source->first), offset_[column],
                                   size_[row], size_[column]);
      }
    }
    const auto L = Z.topRows(shape.columns).triangularView<Eigen::Lower>();
    Eigen::MatrixXd M = Z.bottomRows(below);
    if (below > 0) L.solveInPlace<Eigen::OnTheRight>(M);
    Eigen::MatrixXd own = L.solve(Eigen::MatrixXd::Identity(shape.columns, shape.columns));
    own = (own.transpose() * own).eval();
    if (below > 0) Z.bottomRows(below).noalias() = -(later.selfadjointView<Eigen::Lower>() * M);
    Z.topRows(shape.columns) = own - M.transpose() * Z.bottomRows(below);
  }
}

double Elimination::At(const Panels& panels, int row, int column) const {
  auto [k, i] = place_of_column_[Index(row)];
  auto [l, j] = place_of_column_[Index(column)];
  if (k < l) {
    std::swap(k, l);
    std::swap(i, j);
  }
  const auto panel = panels.find(panel_[Index(l)]);
  if (panel == panels.end()) return 0.0;
  const int first = Offset(k, panel->first);
  return first < 0 ? 0.0 : panel->second.H(first + i, offset_[Index(l)] + j);
}

}  // namespace imu_pose_calib
