// Calibration while driving: it agrees with the batch solver, uses bounded memory and finds moved anchors.
#include "host/daemon/anchor_learner.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::daemon {
namespace {

using groma::test::simulate_site;
using groma::test::SimulatedSite;
using testing::ElementsAre;
using testing::IsEmpty;

AnchorLearner::Setup setup_of(const SimulatedSite& site) {
  AnchorLearner::Setup setup;
  setup.tags = site.tags;
  setup.surface = site.floor;
  setup.priors = site.drive().priors;
  setup.threaded = false;
  return setup;
}

const AnchorProgress& progress_of(const std::vector<AnchorProgress>& all, model::NodeId id) {
  return *std::find_if(all.begin(), all.end(),
                       [id](const AnchorProgress& anchor) { return anchor.id == id; });
}

// Feeds the site's measurements in the order of their times; calls `each_second` about once a second.
template <typename EachSecond>
void drive(const SimulatedSite& site, AnchorLearner& learner, const EachSecond& each_second) {
  auto pose = site.poses.begin();
  double next_s = 1.0;
  for (const model::RangeSample& range : site.ranges) {
    for (; pose != site.poses.end() && pose->t_s <= range.t_s; ++pose) {
      learner.on_pose_prior(*pose);
      learner.on_filter_pose(*pose);
    }
    learner.on_range(range);
    if (range.t_s >= next_s) {
      each_second(range.t_s);
      next_s += 1.0;
    }
  }
  for (; pose != site.poses.end(); ++pose) {
    learner.on_pose_prior(*pose);
    learner.on_filter_pose(*pose);
  }
}

TEST(AnchorLearner, EndsWhereTheBatchSolverEnds) {
  const SimulatedSite site =
      simulate_site({.outlier_share = 0.1, .pose_sigma_m = 0.02, .pose_yaw_sigma_rad = 0.004}, 1);
  AnchorLearner::Setup setup = setup_of(site);
  setup.step_s = 20.0;
  AnchorLearner learner(setup);
  double last_coverage = 0.0;
  drive(site, learner, [&](double /*t_s*/) {
    static_cast<void>(learner.service());
    for (const AnchorProgress& anchor : learner.progress()) {
      EXPECT_GE(anchor.coverage, 0.0);
      EXPECT_LE(anchor.coverage, 1.0);
      if (anchor.id == 7) last_coverage = anchor.coverage;
    }
  });
  EXPECT_GE(learner.steps(), 8U);
  EXPECT_EQ(last_coverage, 1.0);
  static_cast<void>(learner.finish());

  const calibration::Result batch = calibration::calibrate(site.drive());
  std::size_t used = 0;
  for (const model::AnchorCalibration& anchor : batch.calibration.anchors) {
    if (!calibration::carries(anchor)) continue;
    ++used;
    const auto& live = learner.live().anchors;
    const auto found =
        std::find_if(live.begin(), live.end(), [&](const auto& a) { return a.id == anchor.id; });
    ASSERT_NE(found, live.end()) << anchor.id;
    EXPECT_LT((found->position_m - anchor.position_m).norm(), 1e-6) << anchor.id;
    EXPECT_LT((found->covariance - anchor.covariance).norm(), 1e-6 * anchor.covariance.norm()) << anchor.id;
    EXPECT_EQ(found->verdict, anchor.verdict);
    EXPECT_EQ(progress_of(learner.progress(), anchor.id).state, AnchorState::kLive);
  }
  EXPECT_GE(used, 8U);
  EXPECT_LT((learner.live().common_frame_covariance - batch.calibration.common_frame_covariance).norm(),
            1e-9);
  EXPECT_EQ(learner.live().input_sha256.size(), 64U);
}

TEST(AnchorLearner, AgreesWithTheBatchSolverWithAThreadToo) {
  const SimulatedSite site = simulate_site({}, 2);
  AnchorLearner::Setup setup = setup_of(site);
  setup.threaded = true;
  AnchorLearner learner(setup);
  drive(site, learner, [&](double) { static_cast<void>(learner.service()); });
  static_cast<void>(learner.finish());
  const calibration::Result batch = calibration::calibrate(site.drive());
  for (const model::AnchorCalibration& anchor : batch.calibration.anchors) {
    if (!calibration::carries(anchor)) continue;
    const auto& live = learner.live().anchors;
    const auto found =
        std::find_if(live.begin(), live.end(), [&](const auto& a) { return a.id == anchor.id; });
    ASSERT_NE(found, live.end());
    EXPECT_LT((found->position_m - anchor.position_m).norm(), 1e-3);
  }
}

// Eight rounds of 240 s: the store stays within its bounds and calibrates as well as one drive.
TEST(DriveStore, KeepsTheLatestVisitOfEachPlaceInBoundedMemory) {
  const SimulatedSite site = simulate_site({.duration_s = 240.0, .ranges_per_pair = 4000}, 3);
  calibration::DriveStoreLimits limits;
  limits.segments = 150;
  limits.recent_segments = 30;
  calibration::DriveStore store(limits);
  constexpr int kRounds = 8;
  for (int round = 0; round < kRounds; ++round) {
    const double later_s = 240.0 * round;
    auto pose = site.poses.begin();
    for (model::RangeSample range : site.ranges) {
      for (; pose != site.poses.end() && pose->t_s <= range.t_s; ++pose) {
        model::PoseSample shifted = *pose;
        shifted.t_s += later_s;
        if (shifted.t_s < later_s + 240.0) store.add(shifted);
      }
      range.t_s += later_s;
      store.add(range);
    }
  }
  store.close();
  EXPECT_EQ(store.places().segments(), 150U);
  EXPECT_EQ(store.recent().segments(), 30U);
  const calibration::DriveStore::Samples samples = store.places().samples();
  EXPECT_LE(samples.ranges.size(), 150U * 36U * 4U);
  EXPECT_GE(samples.ranges.size(), 149U * 36U * 4U);
  EXPECT_TRUE(std::is_sorted(samples.ranges.begin(), samples.ranges.end(),
                             [](const auto& a, const auto& b) { return a.t_s < b.t_s; }));
  calibration::Drive thinned = site.drive();
  thinned.ranges = samples.ranges;
  thinned.poses = samples.poses;
  const calibration::Result result = calibration::calibrate(thinned);
  double sum_m = 0.0;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    sum_m += (result.calibration.anchors[a].position_m - site.anchors[a].position_m).norm();
  }
  EXPECT_LT(sum_m / 12.0, 0.15);
  // Nearly all ranges have a pose.
  EXPECT_LT(result.ranges_rejected, samples.ranges.size() / 10);
}

TEST(DriveStore, ForgetsAnAnchorUpToATime) {
  const SimulatedSite site = simulate_site({}, 4);
  calibration::DriveStore store;
  auto pose = site.poses.begin();
  for (const model::RangeSample& range : site.ranges) {
    for (; pose != site.poses.end() && pose->t_s <= range.t_s; ++pose) store.add(*pose);
    store.add(range);
  }
  store.forget(7, 100.0);
  store.close();
  for (const model::RangeSample& range : store.places().samples().ranges) {
    EXPECT_TRUE(range.anchor_id != 7 || range.t_s >= 100.0);
  }
}

TEST(AnchorLearner, AddsNewAnchorsAndKeepsTheKnownOnes) {
  const SimulatedSite site = simulate_site({.pose_sigma_m = 0.02, .pose_yaw_sigma_rad = 0.004}, 5);
  const SimulatedSite before = simulate_site({}, 5);
  AnchorLearner::Setup setup = setup_of(site);
  setup.poses = AnchorLearner::Poses::kFilter;
  setup.step_s = 30.0;
  setup.earlier = calibration::calibrate(before.drive()).calibration;
  std::erase_if(setup.earlier.anchors, [](const auto& anchor) { return anchor.id == 5 || anchor.id == 7; });
  AnchorLearner learner(setup);
  EXPECT_EQ(learner.live().anchors.size(), 10U);
  bool changed = false;
  drive(site, learner, [&](double) { changed = learner.service() || changed; });
  static_cast<void>(learner.finish());
  EXPECT_TRUE(changed);
  ASSERT_EQ(learner.live().anchors.size(), 12U);
  for (const model::AnchorCalibration& anchor : setup.earlier.anchors) {
    const auto& live = learner.live().anchors;
    const auto found =
        std::find_if(live.begin(), live.end(), [&](const auto& a) { return a.id == anchor.id; });
    EXPECT_EQ(found->position_m, anchor.position_m);
    EXPECT_EQ(progress_of(learner.progress(), anchor.id).state, AnchorState::kKnown);
  }
  for (const model::NodeId id : {model::NodeId{5}, model::NodeId{7}}) {
    const std::size_t index = id - 4U;
    const auto& anchor = learner.live().anchors[index];
    ASSERT_EQ(anchor.id, id);
    EXPECT_LT((anchor.position_m - site.anchors[index].position_m).head<2>().norm(), 0.3);
    EXPECT_EQ(progress_of(learner.progress(), id).state, AnchorState::kLive);
  }
}

// Halfway through the drive two anchors are moved by 0.5 m.
TEST(AnchorLearner, FindsTheAnchorsThatWereMovedAndNoOther) {
  for (const std::uint64_t seed : {1U, 2U}) {
    const groma::test::SiteSettings settings{.duration_s = 480.0,
                                             .ranges_per_pair = 800,
                                             .outlier_share = 0.05,
                                             .pose_sigma_m = 0.02,
                                             .pose_yaw_sigma_rad = 0.004};
    SimulatedSite site = simulate_site(settings, seed);
    AnchorLearner::Setup setup = setup_of(site);
    setup.poses = AnchorLearner::Poses::kFilter;
    setup.step_s = 20.0;
    groma::test::SiteSettings first = settings;
    first.duration_s = 240.0;
    first.ranges_per_pair = 400;
    setup.earlier = calibration::calibrate(simulate_site(first, seed).drive()).calibration;
    const double angle_rad = 1.0 + static_cast<double>(seed);
    const Eigen::Vector3d way_m = 0.5 * Eigen::Vector3d(std::cos(angle_rad), std::sin(angle_rad), 0.0);
    for (model::RangeSample& range : site.ranges) {
      if (range.t_s < 240.0 || (range.anchor_id != 5 && range.anchor_id != 11)) continue;
      const Eigen::Vector3d antenna_m = groma::test::antenna_of(
          groma::test::true_pose(range.t_s, settings.route), site.tags[range.tag_id - 1U]);
      const Eigen::Vector3d before_m = site.anchors[range.anchor_id - 4U].position_m;
      range.range_m += (antenna_m - before_m - way_m).norm() - (antenna_m - before_m).norm();
    }
    AnchorLearner learner(setup);
    std::vector<model::NodeId> moved;
    double found_s = 0.0;
    drive(site, learner, [&](double t_s) {
      static_cast<void>(learner.service());
      for (const AnchorProgress& anchor : learner.progress()) {
        if (anchor.state != AnchorState::kMoved ||
            std::find(moved.begin(), moved.end(), anchor.id) != moved.end()) {
          continue;
        }
        EXPECT_GT(t_s, 240.0);
        moved.push_back(anchor.id);
        found_s = t_s;
      }
    });
    std::sort(moved.begin(), moved.end());
    EXPECT_THAT(moved, ElementsAre(5, 11)) << "seed " << seed;
    EXPECT_LT(found_s, 420.0);
    static_cast<void>(learner.finish());
    // Calibrated again, each is at its new position.
    for (const model::AnchorCalibration& anchor : learner.live().anchors) {
      if (anchor.id != 5 && anchor.id != 11) continue;
      const Eigen::Vector3d error_m = anchor.position_m - site.anchors[anchor.id - 4U].position_m - way_m;
      EXPECT_LT(error_m.head<2>().norm(), 0.3) << "seed " << seed << ", anchor " << anchor.id;
    }
  }
}

TEST(AnchorLearner, CalibratesNothingWithoutData) {
  AnchorLearner::Setup setup;
  setup.threaded = false;
  AnchorLearner learner(setup);
  EXPECT_FALSE(learner.service());
  EXPECT_FALSE(learner.finish());
  EXPECT_THAT(learner.progress(), IsEmpty());
  learner.on_range({.t_s = std::nan(""), .tag_id = 1, .anchor_id = 2, .range_m = 3.0});
  learner.on_clock_set();
  EXPECT_FALSE(learner.finish());
}

}  // namespace
}  // namespace groma::daemon
