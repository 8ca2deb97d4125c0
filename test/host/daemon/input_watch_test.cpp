#include "host/daemon/input_watch.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace groma::daemon {
namespace {

model::RangeSample range(double t_s, model::NodeId tag, model::NodeId anchor, double range_m) {
  model::RangeSample sample;
  sample.t_s = t_s;
  sample.tag_id = tag;
  sample.anchor_id = anchor;
  sample.range_m = range_m;
  return sample;
}

TEST(InputWatch, AddsUpThePathByOdometry) {
  InputWatch watch;
  watch.on_odometry({.t_s = 0.0, .vx_mps = -3.0, .vy_mps = 4.0, .omega_radps = -0.5});
  watch.on_odometry({.t_s = 0.2, .vx_mps = 0.0, .vy_mps = 0.0, .omega_radps = 1.0});
  EXPECT_DOUBLE_EQ(watch.driven_m(), 1.0);
  EXPECT_DOUBLE_EQ(watch.turned_rad(), 0.1);
  watch.on_odometry({.t_s = 10.2, .vx_mps = 1.0, .vy_mps = 0.0, .omega_radps = 0.0});
  EXPECT_DOUBLE_EQ(watch.turned_rad(), 0.1 + InputWatch::kLongestHold_s) << "a gap is no motion";
  watch.on_clock_set();
  watch.on_odometry({.t_s = 500.0, .vx_mps = 1.0, .vy_mps = 0.0, .omega_radps = 0.0});
  EXPECT_DOUBLE_EQ(watch.driven_m(), 1.0);
}

TEST(InputWatch, ListsThePairsThatRange) {
  InputWatch watch;
  const filter::RangeResult used{.outcome = filter::RangeOutcome::kUsed, .innovation_m = 0.2};
  const filter::RangeResult gated{.outcome = filter::RangeOutcome::kGated, .innovation_m = 0.2};
  watch.on_range(range(1.0, 2, 100, 5.0));
  watch.note(range(1.0, 2, 100, 5.0), used);
  watch.note(range(1.0, 2, 100, 5.0), gated);
  watch.on_range(range(1.1, 1, 101, 7.0));
  watch.on_range(range(1.2, 1, 101, 8.0));
  watch.note(range(1.2, 1, 101, 8.0), {.outcome = filter::RangeOutcome::kUnknownAnchor});
  std::vector<PairStatus> pairs = watch.pairs();
  ASSERT_EQ(pairs.size(), 2U);
  EXPECT_EQ(pairs[0].tag_id, 1);
  EXPECT_EQ(pairs[0].ranges, 2U);
  EXPECT_EQ(pairs[0].used + pairs[0].gated, 0U);
  EXPECT_DOUBLE_EQ(pairs[0].range_m, 7.0 + InputWatch::kSmoothing);
  EXPECT_TRUE(std::isnan(pairs[0].innovation_m2));
  EXPECT_EQ(pairs[1].used, 1U);
  EXPECT_EQ(pairs[1].gated, 1U);
  EXPECT_DOUBLE_EQ(pairs[1].innovation_m2, 0.04);
  watch.on_range(range(6.05, 1, 101, 9.0));
  pairs = watch.pairs();
  ASSERT_EQ(pairs.size(), 1U) << "the other one is silent";
  EXPECT_EQ(pairs[0].anchor_id, 101);
  watch.on_range(range(20.0, 1, 101, 50.0));
  EXPECT_DOUBLE_EQ(watch.pairs()[0].range_m, 50.0) << "after a pause the smoothing begins again";
}

TEST(InputWatch, IsBounded) {
  InputWatch watch;
  for (int anchor = 0; anchor < 1000; ++anchor) {
    watch.on_range(range(1.0, 1, static_cast<model::NodeId>(anchor), 5.0));
    watch.note(range(1.0, 1, static_cast<model::NodeId>(anchor), 5.0),
               {.outcome = filter::RangeOutcome::kUsed});
  }
  EXPECT_EQ(watch.pairs().size(), InputWatch::kMaxPairs);
}

}  // namespace
}  // namespace groma::daemon
