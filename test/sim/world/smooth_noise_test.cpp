#include "firmware/sim/world/smooth_noise.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace groma::sim {
namespace {

TEST(KeyedRandom, HasTheMomentsOfItsDistributions) {
  const KeyedRandom random(1);
  constexpr std::uint64_t kDraws = 200'000;
  double sum = 0.0;
  double squares = 0.0;
  double fourths = 0.0;
  double uniform = 0.0;
  for (std::uint64_t i = 0; i < kDraws; ++i) {
    const KeyedRandom draw = random.of(3, i);
    const double x = draw.normal();
    sum += x;
    squares += x * x;
    fourths += x * x * x * x;
    uniform += draw.uniform();
  }
  EXPECT_NEAR(sum / kDraws, 0.0, 0.01);
  EXPECT_NEAR(squares / kDraws, 1.0, 0.015);
  EXPECT_NEAR(fourths / kDraws, 3.0, 0.1);
  EXPECT_NEAR(uniform / kDraws, 0.5, 0.003);
}

TEST(KeyedRandom, NeighbouringKeysAndSeedsAreUncorrelated) {
  constexpr std::uint64_t kDraws = 50'000;
  double keys = 0.0;
  double seeds = 0.0;
  double swapped = 0.0;
  for (std::uint64_t i = 0; i < kDraws; ++i) {
    const double x = KeyedRandom(7).of(i, 1).normal();
    keys += x * KeyedRandom(7).of(i, 2).normal();
    seeds += x * KeyedRandom(8).of(i, 1).normal();
    if (i != 1) swapped += x * KeyedRandom(7).of(1, i).normal();
  }
  EXPECT_NEAR(keys / kDraws, 0.0, 0.02);
  EXPECT_NEAR(seeds / kDraws, 0.0, 0.02);
  EXPECT_NEAR(swapped / kDraws, 0.0, 0.02);
}

TEST(SmoothNoise, HasUnitVarianceAndNoCorrelationBeyondFourUnits) {
  const KeyedRandom random(5);
  constexpr int kPoints = 40'000;
  double squares = 0.0;
  double near = 0.0;
  double far = 0.0;
  double plane_squares = 0.0;
  for (int i = 0; i < kPoints; ++i) {
    const double u = -20'000.0 + 1.37 * i;
    const double x = smooth_noise(random, u);
    squares += x * x;
    near += x * smooth_noise(random, u + 0.5);
    far += x * smooth_noise(random, u + 4.01);
    const double p = smooth_noise(random, u, 0.7 * i);
    plane_squares += p * p;
  }
  EXPECT_NEAR(squares / kPoints, 1.0, 0.05);
  EXPECT_GT(near / kPoints, 0.8);
  EXPECT_NEAR(far / kPoints, 0.0, 0.03);
  EXPECT_NEAR(plane_squares / kPoints, 1.0, 0.1);
}

TEST(SmoothNoise, IsTwiceContinuouslyDifferentiableAtItsKnots) {
  const KeyedRandom random(6);
  constexpr double kStep = 1e-3;
  const auto second = [&](double u) {
    return (smooth_noise(random, u + kStep) - 2.0 * smooth_noise(random, u) +
            smooth_noise(random, u - kStep)) /
           (kStep * kStep);
  };
  for (int knot = -5; knot < 5; ++knot) {
    EXPECT_NEAR(smooth_noise(random, knot - 1e-9), smooth_noise(random, knot + 1e-9), 1e-7);
    EXPECT_NEAR(second(knot - 2.0 * kStep), second(knot + 2.0 * kStep), 0.1);
  }
}

}  // namespace
}  // namespace groma::sim
