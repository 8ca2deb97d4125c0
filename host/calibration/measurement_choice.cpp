#include "host/calibration/measurement_choice.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <queue>
#include <utility>

namespace groma::calibration {
namespace {

// One part in kTimeShare of the budget is spread over time. By hand: MeasurementChoice.KeepsTheDrive...
// leaves no gap of 10 s with it.
constexpr std::size_t kTimeShare = 4;
constexpr double kBareSigma_m = 100.0;  // without ranges: by hand, so large that any range adds more
// Ranges of one tag are of one kind if their directions, and the logarithms of their distances, differ by no
// more than this: then it hardly matters which of them are taken. By hand, against time: 3 degrees, 5 %.
constexpr double kKindSize = 0.05;
// Selected ranges are exchanged with others only if that takes no more trials: a bound on time, by hand.
constexpr std::size_t kMostTrials = 100'000;
constexpr int kChoiceSweeps = 3;
// A range is taken if its gain is at least this share of the best possible. By hand, against time:
// MeasurementChoice.IsNearlyAsGoodAsTheBestOfAllSubsets holds with it (within 25 % of the best).
constexpr double kNearlyBest = 0.97;

using model::square;

// Covariance of position, each tag's terms, and the share of the mirror position: a range of distance d is
// modelled as (1 - share) d + share mirrored.
class Dilution {
 public:
  explicit Dilution(const AnchorGeometry& anchor)
      : tags_(static_cast<Eigen::Index>(anchor.tag_count)),
        offset_square_m2_(square(anchor.mirror_offset_m)) {
    covariance_.setZero(side() + 1, side() + 1);
    covariance_.diagonal() << Eigen::Vector3d::Constant(square(kBareSigma_m)),
        model::per_tag(model::sigmas_of(anchor.priors).cwiseAbs2(), tags_), 1.0;
  }

  [[nodiscard]] double gain(const RangeGeometry& range) const {
    const Row row = row_of(range);
    Figures response{};
    for (std::size_t i = 0; i < kFigures; ++i) {
      for (std::size_t k = 0; k < kFigures; ++k) {
        response[i] += covariance_(row.index[i], row.index[k]) * row.derivative[k];
      }
    }
    double own = 0.0;
    for (std::size_t i = 0; i < kFigures; ++i) own += row.derivative[i] * response[i];
    return (square(response[0]) + square(response[1]) + square(response[2]) +
            offset_square_m2_ * square(response[kFigures - 1])) /
           (square(range.sigma_m) + own);
  }
  // sign 1 adds a range, -1 removes one that was added.
  void change(const RangeGeometry& range, double sign) {
    const Row row = row_of(range);
    response_.setZero(covariance_.rows());
    for (std::size_t k = 0; k < kFigures; ++k) response_ += row.derivative[k] * covariance_.col(row.index[k]);
    double own = 0.0;
    for (std::size_t k = 0; k < kFigures; ++k) own += row.derivative[k] * response_(row.index[k]);
    covariance_.noalias() -= response_ * response_.transpose() / (sign * square(range.sigma_m) + own);
  }

 private:
  // Of position, one tag's terms, and the side.
  static constexpr std::size_t kFigures = model::kPairSize + 1;
  using Figures = std::array<double, kFigures>;
  struct Row {
    Figures derivative;
    std::array<Eigen::Index, kFigures> index;
  };

  [[nodiscard]] Eigen::Index side() const noexcept { return model::anchor_size(tags_); }
  [[nodiscard]] Row row_of(const RangeGeometry& range) const noexcept {
    Row out{.derivative = {-range.direction.x(), -range.direction.y(), -range.direction.z()}, .index = {}};
    model::by_terms(1.0, range.distance_m, range.direction, &out.derivative[3]);
    out.derivative.back() = range.mirrored_m - range.distance_m;
    const auto pair = model::pair_indices(static_cast<Eigen::Index>(range.tag), tags_);
    *std::copy(pair.begin(), pair.end(), out.index.begin()) = side();
    return out;
  }

  Eigen::Index tags_;
  double offset_square_m2_;
  Eigen::MatrixXd covariance_;
  Eigen::VectorXd response_;
};

// Order in which every prefix is spread over the whole: bit-reversed positions.
std::vector<std::size_t> spread(const std::vector<std::size_t>& ranges) {
  std::size_t bits = 0;
  while ((std::size_t{1} << bits) < ranges.size()) ++bits;
  std::vector<std::size_t> out;
  out.reserve(ranges.size());
  for (std::size_t i = 0; i < std::size_t{1} << bits; ++i) {
    std::size_t reversed = 0;
    for (std::size_t bit = 0; bit < bits; ++bit) reversed |= ((i >> bit) & 1U) << (bits - 1 - bit);
    if (reversed < ranges.size()) out.push_back(ranges[reversed]);
  }
  return out;
}

// Indices of the ranges by kind, each kind in the order in which its ranges are to be taken.
std::vector<std::vector<std::size_t>> kinds_of(std::span<const RangeGeometry> ranges) {
  using Key = std::array<std::int64_t, 5>;
  const auto cell = [](double x) { return static_cast<std::int64_t>(std::floor(x / kKindSize)); };
  std::vector<std::pair<Key, std::size_t>> keyed;
  keyed.reserve(ranges.size());
  for (std::size_t i = 0; i < ranges.size(); ++i) {
    const RangeGeometry& range = ranges[i];
    keyed.push_back(
        {{static_cast<std::int64_t>(range.tag), cell(range.direction.x()), cell(range.direction.y()),
          cell(range.direction.z()), cell(std::log(std::max(range.distance_m, kKindSize)))},
         i});
  }
  std::sort(keyed.begin(), keyed.end());
  std::vector<std::vector<std::size_t>> out;
  for (std::size_t i = 0; i < keyed.size(); ++i) {
    if (i == 0 || keyed[i].first != keyed[i - 1].first) out.emplace_back();
    out.back().push_back(keyed[i].second);
  }
  for (std::vector<std::size_t>& kind : out) kind = spread(kind);
  return out;
}

class Choice {
 public:
  explicit Choice(const AnchorGeometry& anchor)
      : anchor_(anchor), dilution_(anchor), is_taken_(anchor.ranges.size(), false) {}

  void spread_over_time(std::size_t count) {
    std::vector<std::vector<std::size_t>> of_tag(anchor_.tag_count);
    for (std::size_t i = 0; i < anchor_.ranges.size(); ++i) of_tag[anchor_.ranges[i].tag].push_back(i);
    for (std::size_t tag = 0; tag < of_tag.size(); ++tag) {
      const std::vector<std::size_t>& own = of_tag[tag];
      const std::size_t share = count / of_tag.size() + (tag < count % of_tag.size() ? 1 : 0);
      if (own.empty() || share == 0) continue;
      const double begin_s = anchor_.ranges[own.front()].t_s;
      const double step_s = (anchor_.ranges[own.back()].t_s - begin_s) / static_cast<double>(share);
      for (std::size_t k = 0; k < share; ++k) {
        const double t_s = begin_s + (static_cast<double>(k) + 0.5) * step_s;
        const auto at = std::lower_bound(own.begin(), own.end(), t_s, [&](std::size_t i, double instant_s) {
          return anchor_.ranges[i].t_s < instant_s;
        });
        if (at != own.end() && !is_taken_[*at]) take(*at);
      }
    }
    of_time_ = taken_.size();
  }

  // Takes the ranges that lower the dilution most, up to `budget` in all.
  void lower_dilution(std::size_t budget) {
    const std::vector<std::vector<std::size_t>> kinds = kinds_of(anchor_.ranges);
    std::vector<std::size_t> next(kinds.size(), 0);
    const auto skip_taken = [&](std::size_t kind) {
      while (next[kind] < kinds[kind].size() && is_taken_[kinds[kind][next[kind]]]) ++next[kind];
      return next[kind] < kinds[kind].size();
    };
    // The gain of a range before others were taken is almost an upper bound of its gain now.
    std::priority_queue<std::pair<double, std::size_t>> by_gain;
    for (std::size_t kind = 0; kind < kinds.size(); ++kind) {
      if (skip_taken(kind)) by_gain.emplace(gain(kinds[kind][next[kind]]), kind);
    }
    while (taken_.size() < budget && !by_gain.empty()) {
      const std::size_t kind = by_gain.top().second;
      by_gain.pop();
      const std::size_t range = kinds[kind][next[kind]];
      const double now = gain(range);
      if (!by_gain.empty() && now < kNearlyBest * by_gain.top().first) {
        by_gain.emplace(now, kind);
        continue;
      }
      take(range);
      if (skip_taken(kind)) by_gain.emplace(gain(kinds[kind][next[kind]]), kind);
    }
  }

  // Exchanges selected ranges for others as long as that lowers the dilution, if there are few.
  void exchange() {
    if (taken_.size() * anchor_.ranges.size() > kMostTrials) return;
    bool changed = true;
    for (int sweep = 0; sweep < kChoiceSweeps && changed; ++sweep) {
      changed = false;
      for (std::size_t place = of_time_; place < taken_.size(); ++place) {
        const std::size_t before = taken_[place];
        dilution_.change(anchor_.ranges[before], -1.0);
        std::size_t best = before;
        double most = gain(before) * (1.0 + 1e-9);
        for (std::size_t i = 0; i < anchor_.ranges.size(); ++i) {
          if (is_taken_[i]) continue;
          const double found = gain(i);
          if (found <= most) continue;
          most = found;
          best = i;
        }
        is_taken_[before] = false;
        is_taken_[best] = true;
        taken_[place] = best;
        dilution_.change(anchor_.ranges[best], 1.0);
        changed = changed || best != before;
      }
    }
  }

  [[nodiscard]] std::vector<std::size_t> ascending() && {
    std::sort(taken_.begin(), taken_.end());
    return std::move(taken_);
  }

 private:
  [[nodiscard]] double gain(std::size_t range) { return dilution_.gain(anchor_.ranges[range]); }
  void take(std::size_t range) {
    is_taken_[range] = true;
    taken_.push_back(range);
    dilution_.change(anchor_.ranges[range], 1.0);
  }

  const AnchorGeometry& anchor_;
  Dilution dilution_;
  std::vector<bool> is_taken_;
  std::vector<std::size_t> taken_;
  std::size_t of_time_ = 0;
};

}  // namespace

std::vector<std::size_t> choose_measurements(const AnchorGeometry& anchor, std::size_t budget) {
  if (anchor.ranges.size() <= budget) {
    std::vector<std::size_t> all(anchor.ranges.size());
    std::iota(all.begin(), all.end(), std::size_t{0});
    return all;
  }
  Choice choice(anchor);
  choice.spread_over_time(budget / kTimeShare);
  choice.lower_dilution(budget);
  choice.exchange();
  return std::move(choice).ascending();
}

}  // namespace groma::calibration
