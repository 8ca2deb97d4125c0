#include "host/calibration/range_noise.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <vector>

#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

struct Truth {
  double white_sigma_m = 0.05;
  double bias_sigma_m = 0.0;
  double bias_length_m = 1.0;
  double blocked_share = 0.0;
  std::size_t pairs = 8;
};

// A tag at each anchor whose pose stands still while its antenna reports a speed: only residuals differ.
std::optional<model::RangeNoise> found(const Truth& truth, std::uint64_t seed) {
  test::Random random(seed);
  constexpr double kStep_s = 0.07;
  constexpr double kSpeed_mps = 0.5;
  std::vector<std::vector<Observation>> rows(truth.pairs);
  std::vector<AnchorFit> fits(truth.pairs);
  const double fade = std::exp(-kSpeed_mps * kStep_s / truth.bias_length_m);
  for (std::size_t i = 0; i < truth.pairs; ++i) {
    double slow_m = truth.bias_sigma_m * random.gaussian();
    for (std::uint32_t k = 0; k < 4000; ++k) {
      slow_m = fade * slow_m + std::sqrt(1.0 - fade * fade) * truth.bias_sigma_m * random.gaussian();
      Observation row;
      row.t_s = kStep_s * k;
      row.tag_m = {3.0, 4.0, 0.0};
      row.velocity_mps = {0.0, kSpeed_mps, 0.0};
      row.range_m = 5.2 + slow_m + truth.white_sigma_m * random.gaussian();
      // With a share of 0.1: NLOS for 7 s of each 70 s.
      if (k % 1000 < 1000 * truth.blocked_share) row.range_m += 1.0;
      row.index = k;
      rows[i].push_back(row);
    }
    fits[i].problem.rows = rows[i];
    fits[i].problem.tag_count = 1;
    fits[i].anchor = anchor_at(Eigen::Vector3d::Zero(), 1, {.beta_m = {0.2, 0.5}});
    fits[i].kernels.resize(1);
  }
  return range_noise(fits);
}

TEST(RangeNoise, SeparatesWhiteNoiseFromSlowBias) {
  for (const double length_m : {0.3, 4.0}) {
    const auto noise = found({.white_sigma_m = 0.06, .bias_sigma_m = 0.1, .bias_length_m = length_m}, 5);
    ASSERT_TRUE(noise.has_value());
    EXPECT_NEAR(noise->white_sigma_m, 0.06, 0.006);
    EXPECT_NEAR(noise->bias_sigma_m, 0.1, 0.01);
    EXPECT_NEAR(noise->bias_length_m, length_m, 0.25 * length_m);
  }
}

TEST(RangeNoise, WhiteNoiseHasNoSlowBias) {
  const auto noise = found({.white_sigma_m = 0.08}, 6);
  ASSERT_TRUE(noise.has_value());
  EXPECT_NEAR(noise->white_sigma_m, 0.08, 0.003);
  EXPECT_EQ(noise->bias_sigma_m, 0.0);
}

TEST(RangeNoise, IgnoresNlosRanges) {
  const auto noise = found({.white_sigma_m = 0.05, .blocked_share = 0.1}, 7);
  ASSERT_TRUE(noise.has_value());
  EXPECT_NEAR(noise->white_sigma_m, 0.05, 0.003);
  EXPECT_EQ(noise->bias_sigma_m, 0.0);
}

TEST(RangeNoise, NeedsThreePairs) {
  EXPECT_FALSE(found({.pairs = 2}, 8).has_value());
}

}  // namespace
}  // namespace groma::calibration
