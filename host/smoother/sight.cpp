#include "host/smoother/sight.hpp"

#include <array>
#include <cmath>
#include <cstddef>

#include "host/filter/gate.hpp"
#include "host/model/ablation.hpp"

namespace groma::smoother {
namespace {

// In sight, blocked.
using States = std::array<double, 2>;

// One likelihood of each state, and how much of that in sight is not garbage.
struct Likelihood {
  States of{};
  double true_share = 0.0;
};

Likelihood likelihood(const Residual& residual, const filter::GateConfig& config) {
  const filter::RangeDensities density = filter::range_densities(residual.error_m, residual.sigma_m, config);
  const double in_sight = (1.0 - config.garbage_share) * density.in_sight;
  const double blocked = (1.0 - config.garbage_share) * density.blocked;
  return {.of = {in_sight + density.garbage, blocked + density.garbage},
          .true_share = in_sight / (in_sight + density.garbage)};
}

// Of going from one state to the other within a time.
struct Change {
  double into_blocked = 0.0;
  double out_of_blocked = 0.0;
};

Change change(double dt_s, const filter::GateConfig& config) {
  const double forgotten =
      model::is_ablated(model::Mechanism::kSmootherNlos) ? 1.0 : 1.0 - std::exp(-dt_s / config.sticky_s);
  return {.into_blocked = config.blocked_share * forgotten,
          .out_of_blocked = (1.0 - config.blocked_share) * forgotten};
}

States normalised(const States& states) {
  const double sum = states[0] + states[1];
  return {states[0] / sum, states[1] / sum};
}

}  // namespace

std::vector<double> in_sight(std::span<const Residual> pair, const filter::GateConfig& config) {
  std::vector<Likelihood> seen;
  std::vector<States> forward;
  seen.reserve(pair.size());
  forward.reserve(pair.size());
  States now{1.0 - config.blocked_share, config.blocked_share};
  for (std::size_t i = 0; i < pair.size(); ++i) {
    if (i > 0) {
      const Change step = change(pair[i].t_s - pair[i - 1].t_s, config);
      now = {now[0] * (1.0 - step.into_blocked) + now[1] * step.out_of_blocked,
             now[0] * step.into_blocked + now[1] * (1.0 - step.out_of_blocked)};
    }
    seen.push_back(likelihood(pair[i], config));
    now = normalised({now[0] * seen[i].of[0], now[1] * seen[i].of[1]});
    forward.push_back(now);
  }
  std::vector<double> out(pair.size());
  States after{1.0, 1.0};  // likelihood of all later ones
  for (std::size_t i = pair.size(); i-- > 0;) {
    out[i] = normalised({forward[i][0] * after[0], forward[i][1] * after[1]})[0] * seen[i].true_share;
    if (i == 0) break;
    const Change step = change(pair[i].t_s - pair[i - 1].t_s, config);
    const States here{after[0] * seen[i].of[0], after[1] * seen[i].of[1]};
    after = normalised({(1.0 - step.into_blocked) * here[0] + step.into_blocked * here[1],
                        step.out_of_blocked * here[0] + (1.0 - step.out_of_blocked) * here[1]});
  }
  return out;
}

}  // namespace groma::smoother
