// Drives through halls with walls and moving obstacles: anchors are correct or marked, and the biases' sigmas
// are correct.
#include "test/host/calibration/blocked_site.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"

namespace groma::calibration {
namespace {

using model::AnchorVerdict;

constexpr double kDrive_s = 160.0;
// Chi square with three degrees of freedom, 99.7 %.
constexpr double kEllipsoid997 = 13.93;
constexpr double kSameSolution = 0.1;  // squared Mahalanobis distance

// One wall across the hall's gate, two inside the hall.
test::Blocking hall() {
  test::Blocking blocking;
  blocking.walls = {{{20.6, 4.0}, {20.6, 9.0}}, {{7.0, 1.0}, {7.0, 5.0}}, {{12.0, 9.0}, {16.0, 9.0}}};
  return blocking;
}

TEST(NlosSite, AnchorsAreCorrectOrMarkedAndBiasesConsistentOverManyDrives) {
  double error_m = 0.0;
  int ok = 0;
  int biases = 0;
  int inside = 0;
  constexpr int kSites = 4;
  for (int seed = 1; seed <= kSites; ++seed) {
    const test::Route route = test::kRoutes[static_cast<std::size_t>(seed) % test::kRoutes.size()];
    const test::SimulatedSite site =
        test::blocked_site(test::polled_settings(route, kDrive_s), hall(), static_cast<std::uint64_t>(seed));
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const model::AnchorCalibration& anchor = found.anchors[a];
      for (std::size_t j = 0; j < site.tags.size(); ++j) {
        ++biases;
        const double sigmas = (anchor.pairs[j].beta_m - site.beta_m[a][j]) / anchor.pairs[j].beta_sigma_m;
        if (std::abs(sigmas) < 1.96) ++inside;
      }
      if (anchor.verdict != AnchorVerdict::kOk) continue;
      ++ok;
      error_m += (anchor.position_m - site.anchors[a].position_m).norm();
      EXPECT_LT(test::square_sigmas(anchor, site.anchors[a].position_m), kEllipsoid997)
          << "seed " << seed << " anchor " << anchor.id << " off by "
          << (anchor.position_m - site.anchors[a].position_m).transpose();
    }
  }
  EXPECT_GT(ok, kSites * 7);
  EXPECT_LT(error_m / ok, 0.10);
  EXPECT_GT(inside, 0.90 * biases);
}

struct Outcome {
  double square_m2 = 0.0;  // of all anchors' errors
  double ok_error_m = 0.0;
  int ok = 0;
};
Outcome calibrate_sites(test::Blocking blocking, test::Powers powers) {
  blocking.powers = powers;
  Outcome out;
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const test::SimulatedSite site = test::blocked_site(
        test::polled_settings(test::kRoutes[seed % test::kRoutes.size()], kDrive_s), blocking, seed);
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const double error_m = (found.anchors[a].position_m - site.anchors[a].position_m).norm();
      out.square_m2 += error_m * error_m;
      if (found.anchors[a].verdict != AnchorVerdict::kOk) continue;
      out.ok_error_m += error_m;
      ++out.ok;
    }
  }
  out.ok_error_m /= std::max(1, out.ok);
  return out;
}

// Racks that cost no replies: NLOS for a third of the drive looks like a bias and a shift of the anchor.
TEST(NlosSite, PowersRevealNlosWithoutLostRepliesOverMany) {
  test::Blocking racks = hall();
  racks.walls.push_back({{3.0, 6.0}, {18.0, 6.0}});
  racks.long_nlos_reply = racks.short_nlos_reply = racks.reply_los;
  const Outcome without = calibrate_sites(racks, test::Powers::kNone);
  const Outcome with = calibrate_sites(racks, test::Powers::kTrue);
  const Outcome opposite = calibrate_sites(racks, test::Powers::kOpposite);
  const Outcome nothing = calibrate_sites(racks, test::Powers::kNothing);
  EXPECT_LT(with.square_m2, 0.25 * without.square_m2);
  EXPECT_GT(with.ok, without.ok + 4);
  EXPECT_LT(with.ok_error_m, 0.5 * without.ok_error_m);
  // The meaning of powers is estimated.
  EXPECT_LT(opposite.square_m2, 0.25 * without.square_m2);
  EXPECT_LT(nothing.square_m2, 1.7 * without.square_m2);
  EXPECT_LT(nothing.ok_error_m, 1.3 * without.ok_error_m);
}

TEST(NlosSite, MisleadingPowersCostLittleWithRepliesOverMany) {
  const Outcome without = calibrate_sites(hall(), test::Powers::kNone);
  for (const test::Powers powers : {test::Powers::kTrue, test::Powers::kOpposite, test::Powers::kNothing}) {
    const Outcome with = calibrate_sites(hall(), powers);
    EXPECT_LT(with.ok_error_m, 1.1 * without.ok_error_m) << static_cast<int>(powers);
    EXPECT_GE(with.ok, without.ok - 1) << static_cast<int>(powers);
  }
}

// The noise is estimated from the ranges.
TEST(NlosSite, ResultDoesNotDependOnTheConfiguredNoise) {
  const test::SimulatedSite site =
      test::blocked_site(test::polled_settings(test::Route::kWaves, kDrive_s), hall(), 5);
  Drive drive = site.drive();
  const model::Calibration right = calibrate(drive).calibration;
  const double nominal_m = drive.priors.sigma_m;
  for (const double factor : {3.0, 1.0 / 3.0}) {
    drive.priors.sigma_m = factor * nominal_m;
    const model::Calibration found = calibrate(drive).calibration;
    for (std::size_t a = 0; a < right.anchors.size(); ++a) {
      EXPECT_EQ(found.anchors[a].verdict, right.anchors[a].verdict) << right.anchors[a].id;
      EXPECT_LT(test::square_sigmas(found.anchors[a], right.anchors[a].position_m), kSameSolution)
          << "sigma times " << factor << ", anchor " << right.anchors[a].id;
    }
  }
}

// Isolated lost replies are no NLOS: isolated long ranges then do not contradict the others.
TEST(NlosSite, IsolatedLostRepliesAreNotNlos) {
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    test::SimulatedSite site = test::simulate_site({.outlier_share = 0.1}, seed);
    test::Random random(seed + 300);
    std::erase_if(site.ranges, [&](const model::RangeSample&) { return random.uniform() < 0.03; });
    for (const model::AnchorCalibration& anchor : calibrate(site.drive()).calibration.anchors) {
      EXPECT_TRUE(model::is_usable(anchor.verdict))
          << "seed " << seed << ", anchor " << anchor.id << ": " << anchor.advice;
    }
  }
}

TEST(NlosSite, MarksAnchorsWithoutLineOfSight) {
  test::Blocking blocking;
  blocking.walls = {{{20.6, 4.0}, {20.6, 9.0}}};
  const test::SimulatedSite site =
      test::blocked_site(test::polled_settings(test::Route::kWaves, kDrive_s), blocking, 11);
  const model::Calibration found = calibrate(site.drive()).calibration;
  for (const model::AnchorCalibration& anchor : found.anchors) {
    if (anchor.id != 12 && anchor.id != 13) {
      EXPECT_NE(anchor.verdict, AnchorVerdict::kNeverLos) << anchor.id;
      continue;
    }
    EXPECT_EQ(anchor.verdict, AnchorVerdict::kNeverLos) << anchor.id;
    EXPECT_FALSE(anchor.advice.empty());
    for (const model::PairBias& pair : anchor.pairs) EXPECT_GT(pair.beta_sigma_m, 0.15);
    const std::size_t a = anchor.id - site.anchors.front().id;
    EXPECT_LT(test::square_sigmas(anchor, site.anchors[a].position_m), kEllipsoid997);
  }
}

TEST(NlosSite, MarksBothMovedAnchorsAndNoOther) {
  for (const bool walls : {false, true}) {
    test::Blocking blocking = walls ? hall() : test::Blocking{};
    if (!walls) {
      // No NLOS at all: moves are found without the Markov chain.
      blocking.reply_los = 1.0;
      blocking.shadows_per_s = 0.0;
    }
    const test::SimulatedSite site =
        test::blocked_site(test::polled_settings(test::Route::kEight, kDrive_s), blocking, 21,
                           {{.anchor = 1, .by_m = {0.4, -0.3, 0.0}, .from_s = 0.5 * kDrive_s},
                            {.anchor = 5, .by_m = {-0.3, -0.4, 0.0}, .from_s = 0.5 * kDrive_s}});
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (std::size_t a = 0; a < found.anchors.size(); ++a) {
      const bool moved = a == 1 || a == 5;
      EXPECT_EQ(found.anchors[a].verdict == AnchorVerdict::kMoved, moved)
          << (walls ? "walls, " : "no walls, ") << found.anchors[a].id << ": " << found.anchors[a].advice;
    }
  }
}

TEST(NlosSite, OutliersAndCollisionsAreNotNlos) {
  // Neither isolated outliers nor replies lost to collisions are NLOS.
  test::Blocking blocking;
  blocking.reply_los = 0.98;
  blocking.shadows_per_s = 0.0;
  blocking.gross_share = 0.25;
  const test::SimulatedSite site =
      test::blocked_site(test::polled_settings(test::Route::kWaves, kDrive_s), blocking, 31);
  for (const model::AnchorCalibration& anchor : calibrate(site.drive()).calibration.anchors) {
    EXPECT_TRUE(anchor.verdict == AnchorVerdict::kOk || anchor.verdict == AnchorVerdict::kWeakZ)
        << anchor.id << ": " << anchor.advice;
  }
}

}  // namespace
}  // namespace groma::calibration
