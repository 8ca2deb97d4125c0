#include "host/smoother/los.hpp"

#include <cmath>
#include <cstddef>

#include <Eigen/Core>

#include "host/filter/gate.hpp"
#include "host/model/ablation.hpp"

namespace groma::smoother {

std::vector<double> los_probabilities(std::span<const Residual> pair, const filter::GateConfig& config) {
  using States = Eigen::Vector2d;  // LOS, NLOS
  // Transition matrix from range i - 1 (matrix row) to range i (matrix column).
  const auto transition = [&](std::size_t i) {
    const double dt_s = pair[i].t_s - pair[i - 1].t_s;
    const double forgotten =
        model::is_ablated(model::Mechanism::kSmootherNlos) ? 1.0 : 1.0 - std::exp(-dt_s / config.sticky_s);
    const double nlos = config.nlos_prior * forgotten;
    const double freed = (1.0 - config.nlos_prior) * forgotten;
    return Eigen::Matrix2d{{1.0 - nlos, nlos}, {freed, 1.0 - freed}};
  };
  const auto normalised = [](const States& states) -> States { return states / (states(0) + states(1)); };
  std::vector<States> likelihoods;
  std::vector<double> true_shares;  // probability of no garbage, given LOS
  std::vector<States> forward;
  States now(1.0 - config.nlos_prior, config.nlos_prior);
  for (std::size_t i = 0; i < pair.size(); ++i) {
    if (i > 0) now = transition(i).transpose() * now.eval();
    const filter::RangeDensities density = filter::range_densities(pair[i].error_m, pair[i].sigma_m, config);
    const double seen = (1.0 - config.garbage_share) * density.los;
    const double nlos = (1.0 - config.garbage_share) * density.nlos;
    likelihoods.emplace_back(seen + density.garbage, nlos + density.garbage);
    true_shares.push_back(seen / (seen + density.garbage));
    now = normalised(now.cwiseProduct(likelihoods[i]));
    forward.push_back(now);
  }
  std::vector<double> out(pair.size());
  States after = States::Ones();  // likelihood of all later ranges, up to scale
  for (std::size_t i = pair.size(); i-- > 0;) {
    out[i] = normalised(forward[i].cwiseProduct(after))(0) * true_shares[i];
    if (i > 0) after = normalised(transition(i) * after.cwiseProduct(likelihoods[i]));
  }
  return out;
}

}  // namespace groma::smoother
