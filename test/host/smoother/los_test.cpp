#include "host/smoother/los.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <numbers>
#include <vector>

namespace groma::smoother {
namespace {

double gaussian(double x, double sigma) {
  return std::exp(-0.5 * x * x / (sigma * sigma)) / (sigma * std::sqrt(2.0 * std::numbers::pi));
}

// A Gaussian plus an exponential excess, by the trapezoidal rule.
double with_excess(double x, double sigma, double mean) {
  constexpr int kSteps = 20000;
  const double end = 40.0 * mean;
  double sum = 0.0;
  for (int i = 0; i <= kSteps; ++i) {
    const double excess = end * i / kSteps;
    const double weight = i == 0 || i == kSteps ? 0.5 : 1.0;
    sum += weight * std::exp(-excess / mean) / mean * gaussian(x - excess, sigma);
  }
  return sum * end / kSteps;
}

TEST(LosProbabilities, EqualsTheSumOverAllStateSequences) {
  const filter::GateConfig config;
  const std::vector<Residual> pair{{0.0, 0.05, 0.1}, {0.3, 0.4, 0.1},  {0.5, 0.6, 0.12}, {0.6, 0.15, 0.1},
                                   {3.0, 0.2, 0.1},  {3.1, -0.5, 0.1}, {3.2, 7.0, 0.1},  {9.0, 0.0, 0.2}};
  const std::size_t n = pair.size();
  const double garbage = config.garbage_share / config.garbage_width_m;
  std::vector<double> los_density;
  std::vector<double> nlos_density;
  for (const Residual& r : pair) {
    los_density.push_back((1.0 - config.garbage_share) * gaussian(r.error_m, r.sigma_m));
    nlos_density.push_back((1.0 - config.garbage_share) *
                           ((1.0 - config.short_share) * with_excess(r.error_m, r.sigma_m, config.excess_m) +
                            config.short_share * with_excess(-r.error_m, r.sigma_m, config.excess_m)));
  }
  std::vector<double> expected(n, 0.0);
  double total = 0.0;
  for (unsigned way = 0; way < (1U << n); ++way) {
    const auto nlos = [way](std::size_t i) { return ((way >> i) & 1U) != 0U; };
    double p = nlos(0) ? config.nlos_prior : 1.0 - config.nlos_prior;
    for (std::size_t i = 0; i < n; ++i) {
      if (i > 0) {
        const double keep = std::exp(-(pair[i].t_s - pair[i - 1].t_s) / config.sticky_s);
        const double renewed = nlos(i) ? config.nlos_prior : 1.0 - config.nlos_prior;
        p *= (1.0 - keep) * renewed + (nlos(i) == nlos(i - 1) ? keep : 0.0);
      }
      p *= (nlos(i) ? nlos_density[i] : los_density[i]) + garbage;
    }
    total += p;
    for (std::size_t i = 0; i < n; ++i) {
      if (!nlos(i)) expected[i] += p * los_density[i] / (los_density[i] + garbage);
    }
  }
  const std::vector<double> found = los_probabilities(pair, config);
  ASSERT_EQ(found.size(), n);
  for (std::size_t i = 0; i < n; ++i) EXPECT_NEAR(found[i], expected[i] / total, 1e-6) << i;
  // 0.15 m alone would be LOS; right after NLOS ranges the probability is lower.
  EXPECT_LT(found[3], los_probabilities(std::span(pair).subspan(3, 1), config)[0]);
  EXPECT_LT(found[6], 0.01);
}

TEST(LosProbabilities, IsEmptyWithoutRanges) {
  EXPECT_TRUE(los_probabilities({}, filter::GateConfig{}).empty());
}

}  // namespace
}  // namespace groma::smoother
