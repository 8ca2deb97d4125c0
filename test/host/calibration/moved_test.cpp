// Anchors that moved during the drive, or whose id is swapped or duplicated: named, with the time, and no
// other.
#include "host/calibration/moved.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/blocked_site.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

using model::AnchorVerdict;

constexpr double kMovedDrive_s = 160.0;
// Chi square with three degrees of freedom, 99.99 %.
constexpr double kEllipsoid9999 = 21.1;

// No NLOS and no lost replies.
test::Blocking nothing_blocked() {
  test::Blocking blocking;
  blocking.reply_los = 1.0;
  blocking.shadows_per_s = 0.0;
  return blocking;
}

test::Blocking walls() {
  test::Blocking blocking;
  blocking.walls = {{{20.6, 4.0}, {20.6, 9.0}}, {{7.0, 1.0}, {7.0, 5.0}}, {{12.0, 9.0}, {16.0, 9.0}}};
  return blocking;
}

Eigen::Vector3d half_a_metre(double angle_rad) {
  return 0.5 * Eigen::Vector3d(std::cos(angle_rad), std::sin(angle_rad), 0.0);
}

// The last number of "... t_s = 40 and 95, ...".
double last_time_of(const std::string& advice) {
  const std::size_t from = advice.find("t_s = ");
  if (from == std::string::npos) return -1.0;
  std::string times = advice.substr(from + 6);
  times.resize(times.find_first_not_of("0123456789 and"));
  const std::size_t last = times.rfind(' ');
  return std::stod(last == std::string::npos ? times : times.substr(last + 1));
}

TEST(LastTime, IsReadFromTheAdvice) {
  EXPECT_EQ(last_time_of("about t_s = 40 and 95, last by 1 m"), 95.0);
  EXPECT_EQ(last_time_of("about t_s = 40, by 1 m"), 40.0);
}

TEST(StretchGains, EqualThoseOfTheDenseProblemWithASecondPlace) {
  test::Random random(3);
  constexpr std::size_t kTags = 2;
  const AnchorVector anchor = anchor_at({4.0, 6.0, 2.5}, kTags, {});
  std::vector<Observation> rows;
  for (std::size_t i = 0; i < 240; ++i) {
    Observation row;
    row.t_s = 0.1 * static_cast<double>(i);
    row.tag = i % 2;
    row.index = static_cast<std::uint32_t>(i);
    row.tag_m = {random.uniform(0.0, 12.0), random.uniform(0.0, 9.0), i % 2 == 0 ? 0.4 : 1.9};
    row.range_m = (row.tag_m - anchor.head<3>()).norm() + 0.1 * random.gaussian();
    if (i > 150) row.range_m += 0.3;
    rows.push_back(row);
  }
  AnchorProblem problem{.rows = rows, .tag_count = kTags, .priors = {}, .position = {}};
  problem.position.mean_m = {3.0, 3.0, 1.0};
  problem.position.information = Eigen::Matrix3d::Identity() / 900.0;
  const std::vector<RobustKernel> kernels(kTags, RobustKernel(KernelShape{.scale_m = 0.1}));
  const StretchGains gains({.problem = problem, .anchor = anchor, .kernels = kernels}, 12);
  ASSERT_EQ(gains.first_row.size(), 13U);

  const Eigen::Index size = anchor.size();
  const Eigen::VectorXd prior_mean = anchor_at(problem.position.mean_m, kTags, problem.priors);
  for (const auto& [from, to] : {std::pair<std::size_t, std::size_t>{0, 3}, {4, 9}, {7, 12}, {11, 12}}) {
    // All unknowns, then the shift of the position within the stretch, with a prior sigma of 10 m.
    Eigen::MatrixXd information = Eigen::MatrixXd::Zero(size + 3, size + 3);
    information.topLeftCorner(size, size) = information_of_priors(problem);
    information.bottomRightCorner<3, 3>().setIdentity();
    information.bottomRightCorner<3, 3>() /= 100.0;
    Eigen::VectorXd gradient = Eigen::VectorXd::Zero(size + 3);
    gradient.head(size) = information.topLeftCorner(size, size) * (anchor - prior_mean);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      const Eigen::Vector3d to_anchor_m = anchor.head<3>() - rows[i].tag_m;
      Eigen::VectorXd j = Eigen::VectorXd::Zero(size + 3);
      j(pair_index(rows[i].tag, kTags)) << to_anchor_m.normalized(),
          model::by_terms(to_anchor_m.norm(), -to_anchor_m.normalized());
      if (i >= gains.first_row[from] && i < gains.first_row[to]) j.tail<3>() = j.head<3>();
      const double r = rows[i].range_m - to_anchor_m.norm();
      const double weight = std::min(1.0, 0.3 / std::abs(r)) / 0.01;
      information += weight * j * j.transpose();
      gradient -= weight * r * j;
    }
    const double with = 0.5 * gradient.dot(information.ldlt().solve(gradient));
    const Eigen::VectorXd head = gradient.head(size);
    const double without = 0.5 * head.dot(information.topLeftCorner(size, size).ldlt().solve(head));
    EXPECT_NEAR(gains.gain(from, to), with - without, 1e-6 * with) << from << " to " << to;
  }
}

// Two anchors moved by half a metre, each at its own time.
TEST(Moved, BothMovedAnchorsAreFoundWithTheirTimesAndNoOtherOverManyDrives) {
  std::uint64_t seed = 40;
  for (const bool has_walls : {false, true}) {
    for (const auto& [one_s, two_s] : {std::pair{0.2 * kMovedDrive_s, 0.5 * kMovedDrive_s},
                                       {0.5 * kMovedDrive_s, 0.8 * kMovedDrive_s},
                                       {0.8 * kMovedDrive_s, 0.2 * kMovedDrive_s}}) {
      ++seed;
      const std::size_t one = has_walls ? 1 : seed % 10;
      const std::size_t two = has_walls ? 5 : (seed + 4) % 10;
      const test::SimulatedSite site = test::blocked_site(
          test::polled_settings(test::Route::kEight, kMovedDrive_s), has_walls ? walls() : nothing_blocked(),
          seed,
          {{.anchor = one, .by_m = half_a_metre(0.9 * static_cast<double>(seed)), .from_s = one_s},
           {.anchor = two, .by_m = half_a_metre(2.3 * static_cast<double>(seed)), .from_s = two_s}});
      const model::Calibration found = calibrate(site.drive()).calibration;
      for (std::size_t a = 0; a < found.anchors.size(); ++a) {
        const model::AnchorCalibration& anchor = found.anchors[a];
        EXPECT_EQ(anchor.verdict == AnchorVerdict::kMoved, a == one || a == two)
            << "seed " << seed << ", anchor " << anchor.id << ": " << anchor.advice;
        if (anchor.verdict != AnchorVerdict::kMoved) continue;
        EXPECT_NEAR(last_time_of(anchor.advice), a == one ? one_s : two_s, 4.0) << anchor.advice;
        const Eigen::Vector3d now_m =
            site.anchors[a].position_m + half_a_metre((a == one ? 0.9 : 2.3) * static_cast<double>(seed));
        EXPECT_LT(test::square_sigmas(anchor, now_m), kEllipsoid9999)
            << "seed " << seed << ", anchor " << anchor.id << " off by "
            << (anchor.position_m - now_m).transpose();
      }
    }
  }
}

TEST(Moved, AnAnchorMovedBackIsFound) {
  for (std::uint64_t seed = 61; seed <= 63; ++seed) {
    const std::size_t moved = seed % 10;
    const test::SimulatedSite site = test::blocked_site(
        test::polled_settings(test::Route::kWaves, kMovedDrive_s), nothing_blocked(), seed,
        {{.anchor = moved, .by_m = half_a_metre(static_cast<double>(seed)), .from_s = 50.0, .to_s = 100.0}});
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (std::size_t a = 0; a < found.anchors.size(); ++a) {
      EXPECT_EQ(found.anchors[a].verdict == AnchorVerdict::kMoved, a == moved)
          << "seed " << seed << ", anchor " << found.anchors[a].id << ": " << found.anchors[a].advice;
    }
    EXPECT_NEAR(last_time_of(found.anchors[moved].advice), 100.0, 4.0) << found.anchors[moved].advice;
    EXPECT_LT(test::square_sigmas(found.anchors[moved], site.anchors[moved].position_m), kEllipsoid9999);
  }
}

TEST(Moved, FindsNoneWhereNoneMovedOverManyDrives) {
  std::uint64_t seed = 70;
  for (int i = 0; i < 24; ++i) {
    ++seed;
    const test::Route route = test::kRoutes[seed % test::kRoutes.size()];
    test::SiteSettings settings{
        .route = route, .outlier_share = 0.15, .pose_sigma_m = 0.02, .pose_yaw_sigma_rad = 0.004};
    if (i % 4 == 1) settings.place_error_m = 0.05;
    const test::SimulatedSite site =
        i % 4 == 3 ? test::blocked_site(test::polled_settings(route, kMovedDrive_s), walls(), seed)
                   : test::simulate_site(settings, seed);
    for (const model::AnchorCalibration& anchor : calibrate(site.drive()).calibration.anchors) {
      EXPECT_NE(anchor.verdict, AnchorVerdict::kMoved)
          << "seed " << seed << ", " << anchor.id << ": " << anchor.advice;
      EXPECT_EQ(anchor.advice.find(" id"), std::string::npos)
          << "seed " << seed << ", " << anchor.id << ": " << anchor.advice;
    }
  }
}

// Poses that drift by as much as a move and report no covariance: all anchors show the poses' error.
TEST(Moved, FindsHardlyAnyWherePosesDriftAsFarOverManyDrives) {
  constexpr int kSites = 10;
  int named = 0;
  for (std::uint64_t seed = 101; seed < 101 + kSites; ++seed) {
    const test::SimulatedSite site = test::simulate_site({.route = test::kRoutes[seed % test::kRoutes.size()],
                                                          .outlier_share = 0.1,
                                                          .pose_sigma_m = 0.15,
                                                          .pose_yaw_sigma_rad = 0.02},
                                                         seed);
    for (const model::AnchorCalibration& anchor : calibrate(site.drive()).calibration.anchors) {
      named += anchor.verdict == AnchorVerdict::kMoved ? 1 : 0;
    }
  }
  RecordProperty("named_of_120", named);
  EXPECT_LE(named, 12 * kSites / 20);
}

// ---- swapped and duplicate ids -----------------------------------------------------------------------

// Anchors 5 and 11 have each other's id for a while.
test::SimulatedSite with_ids_swapped(test::SimulatedSite site, double from_s, double to_s) {
  for (model::RangeSample& range : site.ranges) {
    if (range.t_s < from_s || range.t_s >= to_s) continue;
    if (range.anchor_id == 5) {
      range.anchor_id = 11;
    } else if (range.anchor_id == 11) {
      range.anchor_id = 5;
    }
  }
  return site;
}

const model::AnchorCalibration& anchor_of(const model::Calibration& calibration, model::NodeId id) {
  return *model::find_anchor(calibration, id);
}

TEST(SwappedIds, ForAThirdOfTheDriveAreReported) {
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const test::SimulatedSite site = with_ids_swapped(test::simulate_site({}, seed), 80.0, 160.0);
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (const model::AnchorCalibration& anchor : found.anchors) {
      const bool swapped = anchor.id == 5 || anchor.id == 11;
      EXPECT_EQ(anchor.advice.find("ids were swapped") != std::string::npos, swapped)
          << "seed " << seed << ", " << anchor.id << ": " << anchor.advice;
      EXPECT_NE(anchor.verdict, AnchorVerdict::kMoved);
      if (!swapped) continue;
      EXPECT_EQ(anchor.verdict, AnchorVerdict::kWeak);
      EXPECT_NE(anchor.advice.find(anchor.id == 5 ? "anchor 11" : "anchor 5"), std::string::npos);
      EXPECT_NEAR(last_time_of(anchor.advice), 160.0, 2.0) << anchor.advice;
      EXPECT_LT(test::square_sigmas(anchor, site.anchors[anchor.id - 4U].position_m), kEllipsoid9999);
    }
    EXPECT_EQ(found.verdict, model::Verdict::kWarnings);
  }
}

TEST(SwappedIds, SinceHalfTheDriveAreReportedAtTheirNewPlaces) {
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const test::SimulatedSite site = with_ids_swapped(test::simulate_site({}, seed), 120.0, 1e9);
    const model::Calibration found = calibrate(site.drive()).calibration;
    for (const model::AnchorCalibration& anchor : found.anchors) {
      const bool swapped = anchor.id == 5 || anchor.id == 11;
      EXPECT_EQ(anchor.verdict == AnchorVerdict::kMoved, swapped) << anchor.id << ": " << anchor.advice;
      if (!swapped) continue;
      EXPECT_NE(anchor.advice.find(anchor.id == 5 ? "the place of anchor 11" : "the place of anchor 5"),
                std::string::npos)
          << anchor.advice;
      EXPECT_NEAR(last_time_of(anchor.advice), 120.0, 2.0) << anchor.advice;
      EXPECT_LT(test::square_sigmas(anchor, site.anchors[anchor.id == 5 ? 7 : 1].position_m), kEllipsoid9999);
    }
  }
}

// Anchor 11 is configured with id 5: both are heard, each is heard in its part of the hall, or one of them
// answers at random.
TEST(DuplicateId, IsNeverTrusted) {
  enum class Heard { kBoth, kNearest, kByChance };
  for (const Heard heard : {Heard::kBoth, Heard::kNearest, Heard::kByChance}) {
    for (std::uint64_t seed = 1; seed <= 4; ++seed) {
      test::SimulatedSite site = test::simulate_site({}, seed);
      test::Random random(seed + 50);
      std::erase_if(site.ranges, [&](const model::RangeSample& range) {
        if (range.anchor_id != 5 && range.anchor_id != 11) return false;
        if (heard == Heard::kByChance) return random.uniform() < 0.5;
        const bool east = test::true_pose(range.t_s, site.settings.route).x_m > 11.0;
        return heard == Heard::kNearest && east != (range.anchor_id == 11);
      });
      for (model::RangeSample& range : site.ranges) {
        if (range.anchor_id == 11) range.anchor_id = 5;
      }
      const model::Calibration found = calibrate(site.drive()).calibration;
      const model::AnchorCalibration& duplicate = anchor_of(found, 5);
      EXPECT_FALSE(model::is_usable(duplicate.verdict)) << "heard " << static_cast<int>(heard) << ", seed "
                                                        << seed << ": " << duplicate.position_m.transpose();
      EXPECT_NE(duplicate.advice.find(" id"), std::string::npos) << duplicate.advice;
      for (const model::AnchorCalibration& anchor : found.anchors) {
        if (anchor.id == 5) continue;
        EXPECT_EQ(anchor.advice.find(" id"), std::string::npos) << anchor.id << ": " << anchor.advice;
      }
    }
  }
}

}  // namespace
}  // namespace groma::calibration
