#include "host/filter/map_watch.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "test/support/random.hpp"

namespace groma::filter {
namespace {

constexpr double kMapVariance_m2 = 0.01;

// Ranges at a given rate; a share of them is off by 5 m.
struct Feed {
  MapWatch watch;
  test::Random random{1};
  double t_s = 0.0;

  void ranges(double duration_s, double share, double rate_hz = 50.0) {
    for (const double end_s = t_s + duration_s; t_s < end_s; t_s += 1.0 / rate_hz) {
      const double off_m = random.uniform() < share ? 5.0 : 0.0;
      watch.observe(t_s, off_m + 0.1 * random.gaussian(), kMapVariance_m2);
    }
  }
};

TEST(MapWatch, FollowsTheShareThatContradicts) {
  for (const double share : {0.0, 0.1, 0.5, 1.0}) {
    Feed feed;
    feed.ranges(100.0, share);
    EXPECT_NEAR(feed.watch.share(), share, 0.05);
  }
}

TEST(MapWatch, SuspectsAtOnceAndReportsAWrongMapAfterAWhile) {
  Feed feed;
  feed.ranges(1.0, 0.6);
  EXPECT_TRUE(feed.watch.is_suspect());
  EXPECT_FALSE(feed.watch.is_wrong());
  feed.ranges(13.0, 0.6);
  EXPECT_FALSE(feed.watch.is_wrong());
  feed.ranges(3.0, 0.6);
  EXPECT_TRUE(feed.watch.is_wrong());
}

TEST(MapWatch, WaitsForEnoughRangesIfTheyAreRare) {
  Feed feed;
  feed.ranges(30.0, 1.0, 1.0);
  EXPECT_TRUE(feed.watch.is_suspect());
  EXPECT_FALSE(feed.watch.is_wrong());
  feed.ranges(30.0, 1.0, 1.0);
  EXPECT_TRUE(feed.watch.is_wrong());
}

TEST(MapWatch, NlosIsNoWrongMap) {
  Feed feed;
  for (int i = 0; i < 20; ++i) {
    feed.ranges(5.0, 0.3);
    feed.ranges(10.0, 0.05);
  }
  EXPECT_FALSE(feed.watch.is_wrong());
}

TEST(MapWatch, AKidnappedRobotIsNoWrongMap) {
  Feed feed;
  feed.ranges(60.0, 0.02);
  feed.ranges(10.0, 0.9);
  feed.watch.restart();
  feed.ranges(30.0, 0.02);
  EXPECT_FALSE(feed.watch.is_wrong());
  EXPECT_TRUE(feed.watch.fits());
}

TEST(MapWatch, AnotherPoseDoesNotHideAWrongMap) {
  Feed feed;
  for (int i = 0; i < 6; ++i) {
    feed.ranges(4.0, 0.6);
    feed.watch.restart();
  }
  EXPECT_TRUE(feed.watch.is_wrong());
}

TEST(MapWatch, AcceptsTheMapAgainWhenRangesFitFor30s) {
  Feed feed;
  feed.ranges(30.0, 0.9);
  ASSERT_TRUE(feed.watch.is_wrong());
  feed.ranges(60.0, 0.0);  // a share of 0.9 takes 57 s to decay to 0.05
  EXPECT_TRUE(feed.watch.is_wrong());
  feed.ranges(40.0, 0.0);
  EXPECT_FALSE(feed.watch.is_wrong());
}

TEST(MapWatch, IgnoresNonFiniteValues) {
  Feed feed;
  feed.ranges(10.0, 0.5);
  const double before = feed.watch.share();
  feed.watch.observe(feed.t_s, std::numeric_limits<double>::quiet_NaN(), kMapVariance_m2);
  feed.watch.observe(feed.t_s, 1.0, std::numeric_limits<double>::infinity());
  EXPECT_EQ(feed.watch.share(), before);
}

}  // namespace
}  // namespace groma::filter
