#include "host/calibration/power_hints.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numeric>

namespace groma::calibration {
namespace {

// One range tells at most so much.
constexpr double kMost = 10.0;
// Those of so long come by the same walls: one to learn from.
constexpr double kTogether_s = 0.2;
// As many of such is what is believed worth.
constexpr double kBelievedCount = 30.0;
// So large a share of the ranges has at least the strength that those in sight have,
constexpr double kStrongest = 0.2;
// which differs by so much: Laplace.
constexpr double kStrengthScale_db = 3.0;

double sum(const std::array<double, model::kPowerClasses>& counts) noexcept {
  return std::accumulate(counts.begin(), counts.end(), 0.0);
}

}  // namespace

void PowerCounts::add(model::PowerClass of, double in_sight_share) noexcept {
  if (of >= model::kNoPowerClass) return;
  in_sight[of] += in_sight_share;
  blocked[of] += 1.0 - in_sight_share;
}

void PowerCounts::add(const PowerCounts& other, double times) noexcept {
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    in_sight[i] += times * other.in_sight[i];
    blocked[i] += times * other.blocked[i];
  }
}

PowerHints::PowerHints(std::span<const double, model::kPowerClasses> ranges, double interval_s) noexcept
    : share_(std::clamp(interval_s / kTogether_s, 1e-3, 1.0)) {
  constexpr std::size_t kKnown = model::kStrengthClasses - 1;
  std::array<double, kKnown> strengths{};
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    if (i % model::kStrengthClasses < kKnown) strengths[i % model::kStrengthClasses] += ranges[i];
  }
  const double all = std::accumulate(strengths.begin(), strengths.end(), 0.0);
  std::size_t usual = kKnown - 1;
  for (double stronger = strengths[usual]; usual > 0 && stronger < kStrongest * all;) {
    stronger += strengths[--usual];
  }
  std::array<double, kKnown> near_usual{};
  for (std::size_t i = 0; i < kKnown; ++i) {
    const double apart = std::abs(static_cast<double>(i) - static_cast<double>(usual));
    near_usual[i] = std::exp(-apart * model::kStrengthStep_db / kStrengthScale_db);
  }
  const double near_all = std::accumulate(near_usual.begin(), near_usual.end(), 0.0);
  // Of a strength that is not known nothing is believed.
  constexpr double kAnywhere = 1.0 / static_cast<double>(model::kStrengthClasses);
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    const std::size_t hidden = i / model::kStrengthClasses;
    const std::size_t strength = i % model::kStrengthClasses;
    const double in_sight =
        strength < kKnown ? (1.0 - kAnywhere) * near_usual[strength] / near_all : kAnywhere;
    believed_.in_sight[i] = kBelievedCount * model::kBelievedInSight[hidden] * in_sight;
    believed_.blocked[i] = kBelievedCount * model::kBelievedBlocked[hidden] * kAnywhere;
  }
  learn({});
}

void PowerHints::learn(const PowerCounts& counts) noexcept {
  PowerCounts all = believed_;
  all.add(counts, share_);
  const double in_sight = sum(all.in_sight);
  const double blocked = sum(all.blocked);
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    const double ratio = all.blocked[i] / blocked * (in_sight / all.in_sight[i]);
    ratios_[i] = std::clamp(ratio, 1.0 / kMost, kMost);
  }
  ratios_.back() = 1.0;
}

}  // namespace groma::calibration
