#include "host/filter/sight_hint.hpp"

#include <algorithm>
#include <cmath>

namespace groma::filter {

namespace {

constexpr double kMaxUnit = 1e6;

}  // namespace

SightHint::SightHint(const GateConfig& config) noexcept
    : most_(std::max(config.hint_most, 1.0)),
      memory_s_(config.hint_memory_s),
      prior_count_(config.hint_prior_count),
      prior_blocked_share_(config.blocked_share) {}

double SightHint::share(const Counts& counts, const std::array<double, model::kHiddenClasses>& believed,
                        model::PowerClass of) const noexcept {
  const double before = believed[model::hidden_class(of)] / static_cast<double>(model::kStrengthClasses);
  const double prior = prior_count_ * unit_;
  return (counts.of[of] + prior * before) / (counts.all + prior);
}

double SightHint::likelihood_ratio(model::PowerClass of) const noexcept {
  if (of >= model::kNoPowerClass) return 1.0;
  const double ratio =
      share(blocked_, model::kBelievedBlocked, of) / share(in_sight_, model::kBelievedInSight, of);
  return std::clamp(ratio, 1.0 / most_, most_);
}

double SightHint::blocked_share() const noexcept {
  const double prior = prior_count_ * unit_;
  return (blocked_.all + prior * prior_blocked_share_) / (blocked_.all + in_sight_.all + prior);
}

void SightHint::learn(model::PowerClass of, double t_s, double blocked, double in_sight) noexcept {
  if (of >= model::kNoPowerClass) return;
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
