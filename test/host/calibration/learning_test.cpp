// What the drive store keeps, and when anchors are rechecked. anchor_learner_test.cpp tests whole drives.
#include "host/calibration/learning.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <set>
#include <vector>

#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

// A store for three segments, and four of them: the last one is back at the second one's place.
TEST(DriveStore, DropsTheEarlierVisitOfAPlaceAndNoOtherPlace) {
  constexpr double kPlaces_m[] = {0.0, 10.0, 20.0, 10.1};
  DriveStore store({.segments = 3});
  for (int i = 0; i < 40; ++i) {
    const double t_s = 0.1 * i + 0.05;
    const double x_m = kPlaces_m[static_cast<std::size_t>(t_s)];
    store.add(model::PoseSample{.t_s = t_s, .x_m = x_m});
    store.add(model::RangeSample{.t_s = t_s, .tag_id = 1, .anchor_id = 5, .range_m = 1.0 + x_m});
  }
  store.close();
  EXPECT_EQ(store.places().segments(), 3U);
  std::set<double> ranges_m;
  for (const model::RangeSample& range : store.places().samples().ranges) ranges_m.insert(range.range_m);
  EXPECT_EQ(ranges_m, (std::set<double>{1.0, 11.1, 21.0}));
}

// A short drive determines anchors too poorly to show that one was moved.
TEST(Learn, RechecksAnchorsOnlyAfterTwentySeconds) {
  const test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 800}, 6);
  LearningInput input{.places = {},
                      .recent = {},
                      .live = calibrate(site.drive()).calibration,
                      .tags = site.tags,
                      .surface = site.floor,
                      .priors = site.drive().priors};
  for (const double duration_s : {10.0, 30.0}) {
    DriveStore store;
    auto pose = site.poses.begin();
    for (const model::RangeSample& range : site.ranges) {
      if (range.t_s > duration_s) break;
      for (; pose->t_s <= range.t_s; ++pose) store.add(*pose);
      store.add(range);
    }
    store.close();
    input.recent = store.recent();
    EXPECT_EQ(learn(input).rechecked.empty(), duration_s < 20.0) << duration_s;
  }
}

}  // namespace
}  // namespace groma::calibration
