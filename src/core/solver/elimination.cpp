#include "imu_pose_calib/core/solver/elimination.h"

#include <algorithm>
#include <limits>
#include <numeric>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/parallel.h"

namespace imu_pose_calib {
namespace {

/// Columns of a panel: about as many as a control point acts together with, so that the dense
/// products pay.
constexpr int kPanelColumns = 24;
/// Relative information that is added to each column: what part of the residuals tells of columns
/// that it shares with others may be singular, and rounding must not make it less than that.
constexpr double kRounding = 1e-12;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

size_t Index(int k) { return static_cast<size_t>(k); }

}  // namespace

Eigen::MatrixXd Reduced::Products() const {
  Eigen::MatrixXd L = H, y_T = B.transpose(), products = inner;
  if (!H.allFinite() || !Factor(L, y_T)) return Eigen::MatrixXd::Constant(B.cols(), B.cols(), kNan);
  AddProduct(1.0, y_T, y_T, false, products);
  return products;
}

Elimination::Elimination(const std::vector<int>& sizes, size_t border,
                         const std::vector<std::vector<int>>& residuals,
                         const std::vector<size_t>& first_of_window)
    : place_(sizes.size()) {
  std::vector<int> order(sizes.size());
  const std::vector<int> window = OrderBlocks(border, residuals, first_of_window, &order);
  FormPanels(sizes, border, order, window, static_cast<int>(first_of_window.size()));
  FindRows(residuals);
}

std::vector<int> Elimination::OrderBlocks(size_t border,
                                          const std::vector<std::vector<int>>& residuals,
                                          const std::vector<size_t>& first_of_window,
                                          std::vector<int>* order) {
  // Blocks by window and the last residual that has them; what none has stays beside its neighbour.
  const auto windows = static_cast<int>(first_of_window.size());
  std::vector<size_t> last(order->size(), 0);
  std::vector<int> window(order->size(), -1);
  for (size_t r = 0, w = 0; r < residuals.size(); ++r) {
    while (w + 1 < first_of_window.size() && r >= first_of_window[w + 1]) ++w;
    for (const int block : residuals[r]) {
      last[Index(block)] = r;
      int& own = window[Index(block)];
      own = own < 0 || own == static_cast<int>(w) ? static_cast<int>(w) : windows;
    }
  }
  for (size_t b = border; b < order->size(); ++b) {
    if (window[b] >= 0) continue;
    window[b] = b > border ? window[b - 1] : 0;
    last[b] = b > border ? last[b - 1] : 0;
  }
  std::iota(order->begin(), order->end(), 0);
  std::rotate(order->begin(), order->begin() + static_cast<ptrdiff_t>(border), order->end());
  std::stable_sort(order->begin(), order->end() - static_cast<ptrdiff_t>(border),
                   [&](int a, int b) {
                     return std::make_pair(window[Index(a)], last[Index(a)]) <
                            std::make_pair(window[Index(b)], last[Index(b)]);
                   });
  return window;
}

void Elimination::FormPanels(const std::vector<int>& sizes, size_t border,
                             const std::vector<int>& order, const std::vector<int>& window,
                             int windows) {
  const size_t inner = sizes.size() - border;
  for (size_t k = 0; k < sizes.size(); ++k) {
    const int block = order[k];
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
    blocks_.push_back({block, sizes[Index(block)], border_panel(), shape.columns});
    shape.columns += blocks_.back().size;
    shape.end = static_cast<int>(k) + 1;
  }
  first_panel_.resize(Index(windows) + 1, static_cast<int>(shapes_.size()));
  if (border == 0) {  // the last panel is it all the same
    shapes_.emplace_back();
    shapes_.back().first = shapes_.back().end = static_cast<int>(inner);
  }
  for (size_t b = 0; b < sizes.size(); ++b) {
    blocks_[Index(place_[b])].column = columns();
    for (int k = 0; k < sizes[b]; ++k) place_of_column_.emplace_back(place_[b], k);
  }
}

void Elimination::FindRows(const std::vector<std::vector<int>>& residuals) {
  std::vector<int> places, seen_by(place_.size(), -1);  // panel that had it last
  for (const std::vector<int>& blocks : residuals) {
    if (blocks.empty()) continue;
    places.clear();
    for (const int block : blocks) places.push_back(place(block));
    const int panel = At(*std::min_element(places.begin(), places.end())).panel;
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
      shape.height += At(k).size;
    }
    if (rows.empty()) continue;
    // Eliminated, they act on each other.
    Shape& next = shapes_[Index(At(rows.front()).panel)];
    std::copy_if(rows.begin(), rows.end(), std::back_inserter(next.rows),
                 [&next](int k) { return k >= next.end; });
  }
}

double Elimination::factor_mb() const {
  double elements = 0.0;
  for (const Shape& shape : shapes_) elements += static_cast<double>(shape.height * shape.columns);
  return 1e-6 * sizeof(double) * elements;
}

int Elimination::Offset(int place, int panel) const {
  if (At(place).panel == panel) return At(place).offset;
  const Shape& shape = shapes_[Index(panel)];
  const auto found = std::lower_bound(shape.rows.begin(), shape.rows.end(), place);
  if (found == shape.rows.end() || *found != place) return -1;
  return shape.row_offset[static_cast<size_t>(found - shape.rows.begin())];
}

Panel* Elimination::Find(int panel, bool creates, Panels* panels) const {
  auto place = panels->find(panel);
  if (place == panels->end()) {
    if (!creates) return nullptr;
    const Shape& shape = shapes_[Index(panel)];
    place =
        panels->emplace(panel, Panel{Eigen::MatrixXd::Zero(shape.height, shape.columns), {}}).first;
  }
  return &place->second;
}

void Elimination::Add(const std::vector<int>& places,
                      const Eigen::Ref<const Eigen::MatrixXd>& product, Panels* panels,
                      bool creates) const {
  struct Run {
    int from, to, count;  // rows of the product and of the panel
  };
  thread_local std::vector<Run> runs;
  int column = 0;
  for (size_t begin = 0, end = 0; begin < places.size(); begin = end) {
    const int p = At(places[begin]).panel;
    int row = column, columns = 0;
    runs.clear();
    for (size_t i = begin; i < places.size(); ++i) {
      const Block& block = At(places[i]);
      const int to = Offset(places[i], p);
      if (!runs.empty() && runs.back().to + runs.back().count == to)
        runs.back().count += block.size;
      else
        runs.push_back({row, to, block.size});
      row += block.size;
      if (block.panel != p) continue;
      end = i + 1;
      columns += block.size;
    }
    Panel* const panel = Find(p, creates, panels);
    for (size_t first = 0; first < runs.size() && panel != nullptr; ++first) {
      const Run& own = runs[first];
      if (own.from >= column + columns) break;
      for (int j = 0; j < std::min(own.count, column + columns - own.from); ++j) {
        const double* const from = product.data() + (own.from + j) * product.outerStride();
        double* const to = &panel->H(0, own.to + j);
        for (int i = j; i < own.count; ++i) to[own.to + i] += from[own.from + i];
        for (size_t r = first + 1; r < runs.size(); ++r)
          for (int i = 0; i < runs[r].count; ++i) to[runs[r].to + i] += from[runs[r].from + i];
      }
    }
    column += columns;
  }
}

void Elimination::AddRhs(const std::vector<int>& places, int number,
                         const Eigen::Ref<const Eigen::VectorXd>& rhs, Panels* panels,
                         bool creates) const {
  Eigen::Index row = 0;
  int p = -1;
  Eigen::VectorXd* own = nullptr;
  for (const int place : places) {
    const Block& block = At(place);
    if (std::exchange(p, block.panel) != block.panel) {
      Panel* const panel = Find(p, creates, panels);
      own = panel == nullptr ? nullptr : &panel->rhs[number];
      if (own != nullptr && own->size() == 0) *own = Eigen::VectorXd::Zero(panel->H.cols());
    }
    if (own != nullptr) own->segment(block.offset, block.size) += rhs.segment(row, block.size);
    row += block.size;
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

void Elimination::EliminatePanels(int begin, int end, const Eigen::VectorXd& weights, bool keeps,
                                  Panels* panels, Rest* rest) const {
  const auto last = panels->lower_bound(end);
  for (auto entry = panels->lower_bound(begin); entry != last; ++entry) {
    Panel& panel = entry->second;
    const Shape& shape = shapes_[Index(entry->first)];
    const int below = shape.height - shape.columns;
    Eigen::Ref<Eigen::MatrixXd> own = panel.H.topRows(shape.columns);
    for (int j = 0; j < shape.columns; ++j)
      if (own(j, j) == 0.0) own(j, j) = 1.0;
    auto L = panel.H.bottomRows(below);
    if (!Factor(own, L)) {
      rest->is_singular = true;
      return;
    }
    Eigen::MatrixXd update = Eigen::MatrixXd::Zero(below, below);
    AddProduct(-1.0, L, L, true, update);
    Add(shape.rows, update, panels, false);

    Eigen::MatrixXd y(shape.columns, static_cast<Eigen::Index>(panel.rhs.size()));
    Eigen::VectorXd combined = Eigen::VectorXd::Zero(shape.columns);
    std::vector<Eigen::Index> at;  // of the right-hand sides among those of the rest
    for (const auto& [number, rhs] : panel.rhs) {
      auto column = y.col(static_cast<Eigen::Index>(at.size()));
      column = own.triangularView<Eigen::Lower>().solve(rhs);
      combined += weights[number] * column;
      AddRhs(shape.rows, number, -(L * column), panels, false);
      const auto found = std::find(rest->numbers.begin(), rest->numbers.end(), number);
      at.push_back(found - rest->numbers.begin());
      if (found == rest->numbers.end()) rest->numbers.push_back(number);
    }
    const auto count = static_cast<Eigen::Index>(rest->numbers.size());
    rest->inner.conservativeResizeLike(Eigen::MatrixXd::Zero(count, count));
    const Eigen::MatrixXd products = Product(y.transpose(), y);
    for (size_t j = 0; j < at.size(); ++j)
      for (size_t i = 0; i < at.size(); ++i)
        rest->inner(at[i], at[j]) +=
            products(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
    if (keeps) panel.rhs = {{0, combined}};
  }
}

Rest Elimination::EliminateWindow(int window, const Eigen::VectorXd& weights, bool keeps,
                                  Panels* panels) const {
  Find(border_panel(), true, panels);
  for (auto& [p, panel] : *panels)
    if (p != border_panel()) panel.H.diagonal() *= 1.0 + kRounding;
  Rest rest;
  EliminatePanels(first_panel_[Index(window)], first_panel_[Index(window) + 1], weights, keeps,
                  panels, &rest);
  while (!panels->empty() && panels->rbegin()->first >= first_panel_.back())
    rest.shared.insert(panels->extract(std::prev(panels->end())));
  return rest;
}

Reduced Elimination::Reduce(const std::vector<const Rest*>& windows, const Eigen::VectorXd& weights,
                            bool keeps, Panels* shared) const {
  const Eigen::Index count = weights.size();
  Reduced reduced{
      {}, Eigen::MatrixXd::Zero(border_columns(), count), Eigen::MatrixXd::Zero(count, count)};
  bool is_singular = false;
  const auto add_inner = [&](const Rest& rest) {
    for (Eigen::Index j = 0; j < rest.inner.cols(); ++j)
      for (Eigen::Index i = 0; i < rest.inner.rows(); ++i)
        reduced.inner(rest.numbers[Index(static_cast<int>(i))],
                      rest.numbers[Index(static_cast<int>(j))]) += rest.inner(i, j);
    is_singular = is_singular || rest.is_singular;
  };
  for (const Rest* window : windows) {
    Merge(window->shared, shared);
    add_inner(*window);
  }
  const Panel& border = *Find(border_panel(), true, shared);
  Rest rest;
  EliminatePanels(first_panel_.back(), border_panel(), weights, keeps, shared, &rest);
  add_inner(rest);
  reduced.H = border.H.selfadjointView<Eigen::Lower>();
  for (const auto& [number, rhs] : border.rhs) reduced.B.col(number) = rhs;
  if (is_singular) reduced.H.setConstant(kNan);
  return reduced;
}

int Elimination::WindowOf(int block) const {
  const auto next =
      std::upper_bound(first_panel_.begin(), first_panel_.end(), At(place(block)).panel);
  return static_cast<int>(next - first_panel_.begin()) - 1;
}

void Elimination::SubstituteBack(const Panels& panels, Eigen::VectorXd* x) const {
  for (auto entry = panels.rbegin(); entry != panels.rend(); ++entry) {
    if (entry->first == border_panel()) continue;
    const Shape& shape = shapes_[Index(entry->first)];
    const Eigen::MatrixXd& L = entry->second.H;
    Eigen::VectorXd below(shape.height - shape.columns);
    for (size_t r = 0; r < shape.rows.size(); ++r) {
      const Block& row = At(shape.rows[r]);
      below.segment(shape.row_offset[r] - shape.columns, row.size) =
          x->segment(row.column, row.size);
    }
    Eigen::VectorXd own = -entry->second.rhs.at(0);
    own -= L.bottomRows(below.size()).transpose().lazyProduct(below);
    L.topRows(shape.columns).triangularView<Eigen::Lower>().transpose().solveInPlace(own);
    for (int k = shape.first; k < shape.end; ++k)
      x->segment(At(k).column, At(k).size) = own.segment(At(k).offset, At(k).size);
  }
}

void Elimination::Invert(const Eigen::MatrixXd& border, int threads, Panels* panels) const {
  (*panels)[border_panel()].H = border;
  InvertPanels(first_panel_.back(), border_panel(), panels);
  InParallel(threads, Index(windows()),
             [&](size_t w) { InvertPanels(first_panel_[w], first_panel_[w + 1], panels); });
}

void Elimination::InvertPanels(int begin, int end, Panels* panels) const {
  const auto first = panels->lower_bound(begin);
  for (auto entry = panels->lower_bound(end); entry != first;) {
    --entry;
    Eigen::MatrixXd& Z = entry->second.H;
    const Shape& shape = shapes_[Index(entry->first)];
    const int below = shape.height - shape.columns;
    Eigen::MatrixXd later = Eigen::MatrixXd::Zero(below, below);  // lower triangle
    for (size_t c = 0; c < shape.rows.size(); ++c) {
      const Block& column = At(shape.rows[c]);
      const auto source = panels->find(column.panel);
      if (source == panels->end()) continue;
      for (size_t r = c; r < shape.rows.size(); ++r)
        later.block(shape.row_offset[r] - shape.columns, shape.row_offset[c] - shape.columns,
                    At(shape.rows[r]).size, column.size) =
            source->second.H.block(Offset(shape.rows[r], source->first), column.offset,
                                   At(shape.rows[r]).size, column.size);
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
  const auto panel = panels.find(At(l).panel);
  if (panel == panels.end()) return 0.0;
  const int first = Offset(k, panel->first);
  return first < 0 ? 0.0 : panel->second.H(first + i, At(l).offset + j);
}

}  // namespace imu_pose_calib
