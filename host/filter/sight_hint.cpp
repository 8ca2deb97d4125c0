#include "host/filter/sight_hint.hpp"

#include <algorithm>
#include <cmath>

#include "firmware/core/dw1000/receive_quality.hpp"

namespace groma::filter {

namespace {

// Likely in sight, uncertain, unlikely.
using Believed = std::array<double, SightHint::kHiddenClasses>;
constexpr Believed kBelievedInSight{0.8, 0.15, 0.05};
constexpr Believed kBelievedBlocked{0.4, 0.3, 0.3};

// The first path's power, brought to a length of 1 m as in free space, in steps from the weakest on.
constexpr double kWeakest_dbm = -99.0;
constexpr double kStep_db = 3.0;

constexpr double kMaxUnit = 1e6;

}  // namespace

SightHint::SightHint(const GateConfig& config) noexcept
    : most_(config.hint_most),
      memory_s_(config.hint_memory_s),
      prior_count_(config.hint_prior_count),
      prior_blocked_share_(config.blocked_share) {}

SightHint::Class SightHint::class_of(const model::RangeSample& range) noexcept {
  const auto first_path_dbm = static_cast<double>(range.first_path_power_dbm);
  const double hidden_cdb = 100.0 * (static_cast<double>(range.receive_power_dbm) - first_path_dbm);
  std::size_t hidden = 0;
  if (std::isfinite(hidden_cdb)) {
    hidden = hidden_cdb < dw1000::kLikelyHidden_cdb ? 0 : hidden_cdb <= dw1000::kUnlikelyHidden_cdb ? 1 : 2;
  } else if (range.line_of_sight != model::LineOfSight::kNotKnown) {
    hidden = static_cast<std::size_t>(range.line_of_sight) - 1;
  } else {
    return kNoClass;
  }
  const double strength_dbm = first_path_dbm + 20.0 * std::log10(range.range_m);
  std::size_t strength = kStrengthClasses - 1;
  if (std::isfinite(strength_dbm)) {
    constexpr double kLast = static_cast<double>(kStrengthClasses - 2);
    strength = static_cast<std::size_t>(std::clamp((strength_dbm - kWeakest_dbm) / kStep_db, 0.0, kLast));
  }
  return hidden * kStrengthClasses + strength;
}

double SightHint::share(const Counts& counts, const Believed& believed, Class of) const noexcept {
  const double before = believed[of / kStrengthClasses] / static_cast<double>(kStrengthClasses);
  const double prior = prior_count_ * unit_;
  return (counts.of[of] + prior * before) / (counts.all + prior);
}

double SightHint::likelihood_ratio(Class of) const noexcept {
  if (of >= kNoClass) return 1.0;
  const double ratio = share(blocked_, kBelievedBlocked, of) / share(in_sight_, kBelievedInSight, of);
  return std::clamp(ratio, 1.0 / most_, most_);
}

double SightHint::blocked_share() const noexcept {
  const double prior = prior_count_ * unit_;
  return (blocked_.all + prior * prior_blocked_share_) / (blocked_.all + in_sight_.all + prior);
}

void SightHint::learn(Class of, double t_s, double blocked, double in_sight) noexcept {
  if (of >= kNoClass) return;
  const double passed_s = std::clamp(t_s - t_s_, 0.0, memory_s_);
  unit_ *= std::exp(passed_s / memory_s_);
  t_s_ = t_s;
  blocked_.of[of] += blocked * unit_;
  blocked_.all += blocked * unit_;
  in_sight_.of[of] += in_sight * unit_;
  in_sight_.all += in_sight * unit_;
  if (unit_ < kMaxUnit) return;
  for (Counts* counts : {&blocked_, &in_sight_}) {
    for (double& count : counts->of) count /= unit_;
    counts->all /= unit_;
  }
  unit_ = 1.0;
}

}  // namespace groma::filter
