#include "host/calibration/site_solver.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "host/calibration/los_solver.hpp"
#include "host/calibration/mirror.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

// The anchor at z = 1 m or, with an excess of 2, at z = -1 m.
TEST(WeighByEarlier, AddsTheCostOfTheEarlierPlace) {
  constexpr double kInflation = 1.5;
  struct Case {
    double earlier_z_m;
    double z_m;  // of the fit afterwards
    double cost_excess;
  };
  // 2 m are 4 sigmas: 8 nats. Both sides are too far from the last place: they cost the same.
  for (const Case& expected : {Case{1.0, 1.0, 2.0 + kInflation * 8.0},
                               Case{-1.0, -1.0, kInflation * 8.0 - 2.0}, Case{100.0, 1.0, 2.0}}) {
    AnchorFit fit;
    fit.problem.tag_count = 1;
    fit.kernels.resize(1);
    fit.inflation = kInflation;
    fit.anchor = anchor_at(Eigen::Vector3d::UnitZ(), 1, {});
    MirrorHypothesis mirror{.anchor = fit.anchor, .cost_excess = 2.0};
    mirror.anchor(2) = -1.0;
    weigh_by_earlier(
        {.position_m = {0.0, 0.0, expected.earlier_z_m}, .covariance_m2 = 0.25 * Eigen::Matrix3d::Identity()},
        fit, mirror);
    EXPECT_EQ(fit.anchor(2), expected.z_m);
    EXPECT_EQ(mirror.anchor(2), -expected.z_m);
    EXPECT_NEAR(mirror.cost_excess, expected.cost_excess, 1e-9);
  }
}

// The robot stands, and then drives off. While it stood, the anchor may be anywhere around it.
TEST(SolveSite, SearchesAgainIfLaterRangesContradictTheEarlierSolution) {
  const Eigen::Vector3d anchor_m(8.0, -3.0, 2.5);
  test::Random random(3);
  Association association;
  association.tags = test::three_tags();
  std::vector<Observation>& rows = association.anchors.emplace_back().rows;
  for (std::uint32_t i = 0; i < 110; ++i) {
    Observation& row = rows.emplace_back();
    row.t_s = 0.1 * i;
    row.index = i;
    row.tag = i % 3;
    row.tag_m.z() = 0.3 + 0.7 * row.tag;
    if (i >= 60) row.tag_m.head<2>() << random.uniform(-6.0, 6.0), random.uniform(-6.0, 6.0);
    row.range_m = (row.tag_m - anchor_m).norm() + 0.1 * random.gaussian();
  }
  SiteProblem problem{.association = &association, .priors = {}, .known_anchors = {}, .end_s = 5.95};
  std::vector<AnchorFit> beginning = solve_site(problem, {});
  ASSERT_EQ(beginning[0].problem.rows.size(), 60U);
  beginning[0].anchor = anchor_at({-8.0, 3.0, 2.5}, association.tags.size(), problem.priors);
  beginning[0].cost = robust_cost(beginning[0]);
  problem.end_s = std::numeric_limits<double>::infinity();
  const std::vector<AnchorFit> fits = solve_site(problem, beginning);
  EXPECT_LT((fits[0].anchor.head<3>() - anchor_m).head<2>().norm(), 0.5);
}

// On the wrong side, and with smaller biases, the ranges of the lowest tag are too long all the time, as in
// NLOS.
TEST(NlosStates, AFitOnTheWrongSideMovesAndNeedsNone) {
  const test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 100}, 12);
  const Drive drive = site.drive();
  const Association association = associate(drive, HeightSource::kPose);
  const PollTable table = tabulate_polls(association);
  std::vector<AnchorFit> fits = solve_site({.association = &association,
                                            .priors = drive.priors,
                                            .known_anchors = {},
                                            .end_s = std::numeric_limits<double>::infinity()},
                                           {});
  const Eigen::Vector3d right_m = fits[0].anchor.head<3>();
  fits[0].anchor.head<3>() = tag_spread(fits[0].problem.rows).mirror(right_m, kAcrossPlane);
  fits[0].anchor.segment(3, 3).array() -= 0.2;
  const double wrong_m = (fits[0].anchor.head<3>() - right_m).norm();
  ASSERT_GT(wrong_m, 2.0);
  EXPECT_FALSE(needs_nlos_states(table, fits));
  EXPECT_LT((fits[0].anchor.head<3>() - right_m).norm(), 0.1 * wrong_m);
}

}  // namespace
}  // namespace groma::calibration
