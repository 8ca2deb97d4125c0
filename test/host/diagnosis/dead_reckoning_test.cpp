#include "host/diagnosis/dead_reckoning.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

namespace groma::diagnosis {
namespace {

// A robot that moves sideways too, with a gap in its odometry.
std::vector<model::OdometrySample> slalom() {
  std::vector<model::OdometrySample> out;
  for (int i = 0; i < 500; ++i) {
    if (i > 200 && i < 230) continue;
    const double t_s = 0.02 * i;
    out.push_back({t_s, 1.0 + 0.3 * std::sin(t_s), 0.2 * std::cos(2.0 * t_s), 0.8 * std::sin(0.7 * t_s)});
  }
  return out;
}

TEST(JoinedOdometry, MovesTheSameWayInFewerSamples) {
  const std::vector<model::OdometrySample> odometry = slalom();
  const std::vector<model::OdometrySample> few = joined(odometry, 0.1);
  EXPECT_LT(few.size(), odometry.size() / 4);
  const DeadReckoning given(odometry, {});
  const DeadReckoning path(few, {});
  for (const model::OdometrySample& sample : few) {
    const DeadReckoning::Place at = path.at(sample.t_s);
    const DeadReckoning::Place expected = given.at(sample.t_s);
    EXPECT_LT((at.position_m - expected.position_m).norm(), 1e-9);
    EXPECT_NEAR(at.heading_rad, expected.heading_rad, 1e-9);
  }
  // With an error of the yaw rate and between the samples too, by less than a thousandth of the way.
  const DeadReckoning::YawRateError error{.scale = 1.05, .bias_radps = 0.01};
  const DeadReckoning wrong(odometry, error);
  const DeadReckoning wrong_of_few(few, error);
  for (double t_s = 0.0; t_s < 9.9; t_s += 0.037)
    EXPECT_LT((wrong.at(t_s).position_m - wrong_of_few.at(t_s).position_m).norm(), 0.003) << t_s;
}

TEST(JoinedOdometry, KeepsSlowAndFewSamples) {
  const std::vector<model::OdometrySample> slow{
      {0.0, 1.0, 0.0, 0.1}, {0.2, 1.0, 0.1, 0.1}, {0.4, 1.0, 0.0, 0.1}};
  const std::vector<model::OdometrySample> kept = joined(slow, 0.1);
  ASSERT_EQ(kept.size(), slow.size());
  for (std::size_t i = 0; i < slow.size(); ++i) {
    EXPECT_EQ(kept[i].t_s, slow[i].t_s);
    EXPECT_NEAR(kept[i].vx_mps, slow[i].vx_mps, 1e-12);
    EXPECT_NEAR(kept[i].vy_mps, slow[i].vy_mps, 1e-12);
    EXPECT_NEAR(kept[i].omega_radps, slow[i].omega_radps, 1e-12);
  }
  EXPECT_TRUE(joined({}, 0.1).empty());
}

}  // namespace
}  // namespace groma::diagnosis
