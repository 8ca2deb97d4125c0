// The parameters of one anchor: its position, then the terms of the range model for each tag. Calibration,
// filter, smoother, files and reports share this layout and loop over kPairTerms, so that a term is declared
// here alone: CONTRIBUTING.md has the steps.
#pragma once

#include <array>
#include <cstddef>

#include <Eigen/Core>

#include "host/model/types.hpp"

namespace groma::model {

// Priors of z = gamma d + beta + noise: the same for each pair, independent between pairs.
// Defaults as in docs/reference/files.md, by hand. No narrower than what the calibration's campaigns
// simulate: biases of 0.3 m and 0.005. The estimators find sigma_m from the ranges.
struct RangePriors {
  double sigma_m = 0.1;
  ScalarPrior beta_m{0.0, 0.5};
  ScalarPrior gamma{1.0, 0.005};
};

// Constant and range-dependent bias of one tag and anchor, with marginal sigmas.
struct PairBias {
  NodeId tag_id = 0;
  double beta_m = 0.0;
  double beta_sigma_m = 0.0;
  double gamma = 1.0;
  double gamma_sigma = 0.0;
};

// A term of the range model: one parameter of each pair.
struct PairTerm {
  double PairBias::*value;
  double PairBias::*sigma;
  ScalarPrior RangePriors::*prior;
  double neutral;  // value without a bias, as in equation (4); a term whose neutral value is 1 is positive
  double moved_sigma;  // of its change if the anchor moves. By hand; the Moved tests hold with it
  // In data sets, calibration files and JSON.
  struct {
    const char* value;
    const char* sigma;
    const char* variance;
  } key;
  // In texts; column of a report, with the format of its numbers; format of a difference and its sigma.
  struct {
    const char* name;
    const char* title;
    const char* number;
    const char* change;
  } text;
};

// In the order of the terms in an anchor's parameters.
enum : std::size_t { kBeta, kGamma };
inline constexpr std::array kPairTerms{
    PairTerm{.value = &PairBias::beta_m,
             .sigma = &PairBias::beta_sigma_m,
             .prior = &RangePriors::beta_m,
             .neutral = 0.0,
             .moved_sigma = 0.02,
             .key = {"beta_m", "beta_sigma_m", "beta_variance_m2"},
             .text = {"beta", "β m", "{:.3f}", "beta {:+.3f} m (sigma {:.3f})"}},
    PairTerm{.value = &PairBias::gamma,
             .sigma = &PairBias::gamma_sigma,
             .prior = &RangePriors::gamma,
             .neutral = 1.0,
             .moved_sigma = 5e-4,
             .key = {"gamma", "gamma_sigma", "gamma_variance"},
             .text = {"gamma", "γ", "{:.4f}", "gamma {:+.5f} ({:.5f})"}},
};
inline constexpr int kPairTermCount = static_cast<int>(kPairTerms.size());
static_assert(sizeof(RangePriors) == sizeof(double) + kPairTerms.size() * sizeof(ScalarPrior),
              "each prior is that of a term");

// One number for each term.
using TermVector = Eigen::Matrix<double, kPairTermCount, 1>;
template <class Of>
[[nodiscard]] TermVector each_term(const Of& of) noexcept {
  TermVector out;
  for (std::size_t i = 0; i < kPairTerms.size(); ++i) out(static_cast<Eigen::Index>(i)) = of(kPairTerms[i]);
  return out;
}
[[nodiscard]] inline TermVector values_of(const PairBias& pair) noexcept {
  return each_term([&](const PairTerm& term) { return pair.*term.value; });
}
[[nodiscard]] inline TermVector means_of(const RangePriors& priors) noexcept {
  return each_term([&](const PairTerm& term) { return (priors.*term.prior).mean; });
}
[[nodiscard]] inline TermVector sigmas_of(const RangePriors& priors) noexcept {
  return each_term([&](const PairTerm& term) { return (priors.*term.prior).sigma; });
}

// Derivative of the range by each term: the range is the sum of these times the terms. Each is constant or
// proportional to the distance. `direction`: unit vector from the anchor to the antenna, map frame; zero:
// unknown. Value is a double or several side by side; `one` is 1.
template <class Value, class Direction>
void by_terms(const Value& one, const Value& distance_m, const Direction& /*direction*/,
              Value* out) noexcept {
  out[kBeta] = one;
  out[kGamma] = distance_m;
}
[[nodiscard]] inline TermVector by_terms(
    double distance_m, const Eigen::Vector3d& direction = Eigen::Vector3d::Zero()) noexcept {
  TermVector out;
  by_terms(1.0, distance_m, direction, out.data());
  return out;
}
// Derivative of the range by the distance. That of the terms by the direction is neglected.
[[nodiscard]] inline double scale_of(const TermVector& terms) noexcept {
  return terms.dot(by_terms(1.0) - by_terms(0.0));
}
// Range at distance zero.
[[nodiscard]] inline double offset_m(const TermVector& terms,
                                     const Eigen::Vector3d& direction = Eigen::Vector3d::Zero()) noexcept {
  return terms.dot(by_terms(0.0, direction));
}

// Number of parameters of an anchor, 3 + kPairTermCount T: position, then the first term of each tag, the
// second of each tag, and so on. Int: the type of the numbers of tags.
template <class Int>
[[nodiscard]] constexpr Int anchor_size(Int tags) noexcept {
  return 3 + kPairTermCount * tags;
}
template <class Int>
[[nodiscard]] constexpr Int term_index(std::size_t term, Int tag, Int tags) noexcept {
  return 3 + static_cast<Int>(term) * tags + tag;
}
// Those of one pair's range: position and terms.
inline constexpr int kPairSize = 3 + kPairTermCount;
template <class Int>
[[nodiscard]] constexpr std::array<Int, kPairSize> pair_indices(Int tag, Int tags) noexcept {
  std::array<Int, kPairSize> out{0, 1, 2};
  for (std::size_t term = 0; term < kPairTerms.size(); ++term) out[3 + term] = term_index(term, tag, tags);
  return out;
}

// The terms of one pair among an anchor's parameters.
template <class Vector>
[[nodiscard]] TermVector terms_of(const Vector& anchor, Eigen::Index tag, Eigen::Index tags) noexcept {
  return TermVector::NullaryExpr(
      [&](Eigen::Index term) { return anchor(term_index(static_cast<std::size_t>(term), tag, tags)); });
}
// The same number for each tag, as behind the position.
[[nodiscard]] inline Eigen::VectorXd per_tag(const TermVector& terms, Eigen::Index tags) {
  return terms.transpose().replicate(tags, 1).reshaped();
}
// An anchor at this position, with its terms at their prior means.
[[nodiscard]] inline Eigen::VectorXd anchor_at(const Eigen::Vector3d& position_m, std::size_t tag_count,
                                               const RangePriors& priors) {
  const auto tags = static_cast<Eigen::Index>(tag_count);
  Eigen::VectorXd out(anchor_size(tags));
  out << position_m, per_tag(means_of(priors), tags);
  return out;
}

}  // namespace groma::model
