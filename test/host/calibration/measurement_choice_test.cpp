#include "host/calibration/measurement_choice.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/blocked_site.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kChosenTags = 2;

struct Place {
  double t_s = 0.0;
  std::size_t tag = 0;
  Eigen::Vector3d antenna_m = Eigen::Vector3d::Zero();
};

// Ranges from antennas around an anchor; its mirror position is across the plane z = 1 m.
std::vector<RangeGeometry> seen_from(const Eigen::Vector3d& anchor_m, const std::vector<Place>& places) {
  const Eigen::Vector3d mirrored_m(anchor_m.x(), anchor_m.y(), 2.0 - anchor_m.z());
  std::vector<RangeGeometry> out;
  for (const Place& place : places) {
    const Eigen::Vector3d way_m = place.antenna_m - anchor_m;
    out.push_back({.t_s = place.t_s,
                   .tag = place.tag,
                   .direction = way_m.normalized(),
                   .distance_m = way_m.norm(),
                   .mirrored_m = (place.antenna_m - mirrored_m).norm(),
                   .sigma_m = 0.1});
  }
  return out;
}

AnchorGeometry geometry_of(const std::vector<RangeGeometry>& ranges, double mirror_offset_m) {
  return {.ranges = ranges,
          .tag_count = kChosenTags,
          .priors = {.beta_m = {.mean = 0.0, .sigma = 0.3}, .gamma = {.mean = 1.0, .sigma = 0.005}},
          .mirror_offset_m = mirror_offset_m};
}

// Reference: information of position, biases and side, its inverse, the root of the trace.
double dilution_m(const AnchorGeometry& anchor, const std::vector<std::size_t>& chosen) {
  constexpr auto kTags = static_cast<Eigen::Index>(kChosenTags);
  constexpr Eigen::Index kSize = model::anchor_size(kTags) + 1;
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(kSize, kSize);
  information.diagonal().head<3>().setConstant(1e-4);
  information.diagonal().segment<kSize - 4>(3) =
      model::per_tag(model::sigmas_of(anchor.priors), kTags).cwiseAbs2().cwiseInverse();
  information(kSize - 1, kSize - 1) = 1.0;
  for (const std::size_t i : chosen) {
    const RangeGeometry& range = anchor.ranges[i];
    Eigen::VectorXd row = Eigen::VectorXd::Zero(kSize);
    row(model::pair_indices(static_cast<Eigen::Index>(range.tag), kTags)) << -range.direction,
        model::by_terms(range.distance_m, range.direction);
    row(kSize - 1) = range.mirrored_m - range.distance_m;
    information += row * row.transpose() / std::pow(range.sigma_m, 2);
  }
  const Eigen::MatrixXd covariance = information.ldlt().solve(Eigen::MatrixXd::Identity(kSize, kSize));
  return std::sqrt(covariance.topLeftCorner<3, 3>().trace() +
                   std::pow(anchor.mirror_offset_m, 2) * covariance(kSize - 1, kSize - 1));
}

std::vector<std::size_t> evenly(std::size_t of, std::size_t count) {
  std::vector<std::size_t> out;
  for (std::size_t i = 0; i < count; ++i) out.push_back(i * of / count);
  return out;
}

std::vector<std::size_t> all_of(std::size_t count) {
  std::vector<std::size_t> out(count);
  std::iota(out.begin(), out.end(), std::size_t{0});
  return out;
}

std::vector<Place> anywhere(std::size_t count, std::uint64_t seed) {
  test::Random random(seed);
  std::vector<Place> out;
  for (std::size_t i = 0; i < count; ++i) {
    out.push_back(
        {.t_s = static_cast<double>(i),
         .tag = i % kChosenTags,
         .antenna_m = {random.uniform(-8.0, 8.0), random.uniform(-8.0, 8.0), random.uniform(0.0, 2.0)}});
  }
  return out;
}

// Every subset of 7 of 14 ranges: 3432 of them.
TEST(MeasurementChoice, IsNearlyAsGoodAsTheBestOfAllSubsets) {
  constexpr std::size_t kOf = 14;
  constexpr std::size_t kBudget = 7;
  double worst = 0.0;
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    const std::vector<RangeGeometry> ranges = seen_from({3.0, 1.0, 2.5}, anywhere(kOf, seed));
    const AnchorGeometry anchor = geometry_of(ranges, 3.0);
    double best_m = std::numeric_limits<double>::infinity();
    double sum_m = 0.0;
    double subsets = 0.0;
    std::vector<bool> is_in(kOf, false);
    std::fill(is_in.begin(), is_in.begin() + kBudget, true);
    do {
      std::vector<std::size_t> subset;
      for (std::size_t i = 0; i < kOf; ++i) {
        if (is_in[i]) subset.push_back(i);
      }
      const double found_m = dilution_m(anchor, subset);
      best_m = std::min(best_m, found_m);
      sum_m += found_m;
      subsets += 1.0;
    } while (std::prev_permutation(is_in.begin(), is_in.end()));
    const std::vector<std::size_t> chosen = choose_measurements(anchor, kBudget);
    ASSERT_EQ(chosen.size(), kBudget);
    EXPECT_TRUE(std::is_sorted(chosen.begin(), chosen.end()));
    const double chosen_m = dilution_m(anchor, chosen);
    EXPECT_LE(chosen_m, 1.25 * best_m) << "seed " << seed;
    EXPECT_LT(chosen_m, sum_m / subsets) << "seed " << seed;
    worst = std::max(worst, chosen_m / best_m);
  }
  RecordProperty("worst_over_best", std::to_string(worst));
}

// A robot that is stationary for nine tenths of its time: the ranges of its drive are not crowded out.
TEST(MeasurementChoice, KeepsTheDriveOfAMostlyStationaryRobot) {
  std::vector<Place> places;
  for (std::size_t i = 0; i < 6000; ++i) {
    const double way_m = i < 5400 ? 0.0 : 0.03 * static_cast<double>(i - 5400);
    places.push_back(
        {.t_s = 0.1 * static_cast<double>(i),
         .tag = i % kChosenTags,
         .antenna_m = {way_m - 6.0, 4.0 * std::sin(0.4 * way_m), i % kChosenTags == 0 ? 0.4 : 1.6}});
  }
  const std::vector<RangeGeometry> ranges = seen_from({2.0, 5.0, 2.5}, places);
  const AnchorGeometry anchor = geometry_of(ranges, 3.0);
  const std::vector<std::size_t> chosen = choose_measurements(anchor, 600);
  ASSERT_EQ(chosen.size(), 600U);
  const double whole_m = dilution_m(anchor, all_of(ranges.size()));
  const double chosen_m = dilution_m(anchor, chosen);
  RecordProperty("chosen_over_whole", std::to_string(chosen_m / whole_m));
  EXPECT_LT(chosen_m, 1.2 * whole_m);
  EXPECT_GT(dilution_m(anchor, evenly(ranges.size(), 600)), 2.0 * whole_m);

  // No stretch of time is left without ranges: a move or NLOS would go unnoticed.
  double longest_s = ranges[chosen.front()].t_s;
  for (std::size_t i = 1; i < chosen.size(); ++i) {
    longest_s = std::max(longest_s, ranges[chosen[i]].t_s - ranges[chosen[i - 1]].t_s);
  }
  EXPECT_LT(longest_s, 10.0);
}

// One antenna in a thousand is off the plane of the others: it alone determines z and the side.
TEST(MeasurementChoice, KeepsTheOnlyRangesThatDetermineHeightAndSide) {
  std::vector<Place> places;
  for (std::size_t i = 0; i < 4000; ++i) {
    const double angle_rad = 0.02 * static_cast<double>(i);
    const bool off_plane = i % 1000 == 777;
    places.push_back(
        {.t_s = 0.1 * static_cast<double>(i),
         .tag = 0,
         .antenna_m = {5.0 * std::cos(angle_rad), 5.0 * std::sin(angle_rad), off_plane ? 2.2 : 1.0}});
  }
  const std::vector<RangeGeometry> ranges = seen_from({1.0, 0.5, 1.6}, places);
  const AnchorGeometry anchor = geometry_of(ranges, 1.2);
  const std::vector<std::size_t> chosen = choose_measurements(anchor, 40);
  for (std::size_t i = 777; i < 4000; i += 1000) {
    EXPECT_TRUE(std::binary_search(chosen.begin(), chosen.end(), i)) << i;
  }
}

TEST(MeasurementChoice, TakesAllWhereThereAreFew) {
  const std::vector<RangeGeometry> ranges = seen_from({3.0, 1.0, 2.5}, anywhere(10, 1));
  EXPECT_EQ(choose_measurements(geometry_of(ranges, 3.0), 10), all_of(10));
  EXPECT_TRUE(choose_measurements(geometry_of(ranges, 3.0), 0).empty());
  EXPECT_TRUE(choose_measurements(geometry_of({}, 3.0), 5).empty());
}

double rmse_m(const Result& result, const test::SimulatedSite& site) {
  double square_m2 = 0.0;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    square_m2 += (result.calibration.anchors[a].position_m - site.anchors[a].position_m).squaredNorm();
  }
  return std::sqrt(square_m2 / static_cast<double>(site.anchors.size()));
}

// A drive of 240 s after the robot was stationary for nine times as long, with ranges all the time.
test::SimulatedSite standing_first(std::uint64_t seed) {
  constexpr double kStanding_s = 2160.0;
  test::SimulatedSite site = test::simulate_site({.outlier_share = 0.1}, seed);
  const model::PoseSample start = site.poses.front();
  std::vector<model::PoseSample> poses;
  for (double t_s = 0.0; t_s < kStanding_s; t_s += 0.2) {
    poses.push_back(start);
    poses.back().t_s = t_s;
  }
  for (model::PoseSample pose : site.poses) {
    pose.t_s += kStanding_s;
    poses.push_back(pose);
  }
  test::Random random(1000 + seed);
  std::vector<model::RangeSample> ranges;
  const std::size_t standing = 9 * site.ranges.size();
  const std::size_t tags = site.tags.size();
  for (std::size_t i = 0; i < standing; ++i) {
    const std::size_t tag = i % tags;
    const std::size_t anchor = i / tags % site.anchors.size();
    const double distance_m =
        (test::antenna_of(start, site.tags[tag]) - site.anchors[anchor].position_m).norm();
    ranges.push_back({.t_s = kStanding_s * static_cast<double>(i) / static_cast<double>(standing),
                      .tag_id = site.tags[tag].id,
                      .anchor_id = site.anchors[anchor].id,
                      .range_m = site.gamma[anchor][tag] * distance_m + site.beta_m[anchor][tag] +
                                 site.settings.sigma_m * random.gaussian()});
  }
  for (model::RangeSample range : site.ranges) {
    range.t_s += kStanding_s;
    ranges.push_back(range);
  }
  site.poses = poses;
  site.ranges = ranges;
  return site;
}

TEST(MeasurementChoice, ADriveOfTenTimesTheRangesKeepsItsAccuracyUnderTheBudgetOverManyDrives) {
  constexpr std::size_t kBudget = 900;  // of 6000
  double whole_m2 = 0.0;
  double twice_m2 = 0.0;  // with twice as many
  double chosen_m2 = 0.0;
  double evenly_m2 = 0.0;
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    test::SimulatedSite site = standing_first(seed);
    const Result whole = calibrate(site.drive());
    whole_m2 += std::pow(rmse_m(whole, site), 2);
    twice_m2 += std::pow(rmse_m(calibrate(site.drive(), {.most_anchor_ranges = 2 * kBudget}), site), 2);
    const Result bounded = calibrate(site.drive(), {.most_anchor_ranges = kBudget});
    // What a stationary robot cannot observe is no sign of a move or of NLOS.
    for (const Result* result : {&whole, &bounded}) {
      for (const model::AnchorCalibration& anchor : result->calibration.anchors) {
        EXPECT_TRUE(model::is_usable(anchor.verdict))
            << "seed " << seed << " anchor " << anchor.id << ": " << anchor.advice;
      }
    }
    chosen_m2 += std::pow(rmse_m(bounded, site), 2);
    EXPECT_LE(bounded.ranges_used, kBudget * site.anchors.size());
    std::vector<model::RangeSample> few;
    const std::size_t pairs = site.anchors.size() * site.tags.size();
    for (std::size_t i = 0; i < site.ranges.size(); ++i) {
      if (i / pairs * kBudget % (site.ranges.size() / site.anchors.size()) < kBudget)
        few.push_back(site.ranges[i]);
    }
    site.ranges = few;
    evenly_m2 += std::pow(rmse_m(calibrate(site.drive()), site), 2);
  }
  RecordProperty("chosen_over_whole", std::to_string(std::sqrt(chosen_m2 / whole_m2)));
  RecordProperty("twice_over_whole", std::to_string(std::sqrt(twice_m2 / whole_m2)));
  RecordProperty("evenly_over_whole", std::to_string(std::sqrt(evenly_m2 / whole_m2)));
  EXPECT_LT(std::sqrt(chosen_m2), 1.25 * std::sqrt(whole_m2));
  EXPECT_LT(std::sqrt(twice_m2), 1.05 * std::sqrt(whole_m2));
  EXPECT_LT(std::sqrt(chosen_m2), std::sqrt(evenly_m2));
}

// Missed polls are counted with all ranges: a gap between selected ranges is no missed poll.
TEST(MeasurementChoice, KeepsNlosDetectionOverManyDrives) {
  constexpr std::size_t kBudget = 2000;  // of up to 6000
  test::Blocking blocking;
  blocking.walls = {{{20.6, 4.0}, {20.6, 9.0}}, {{7.0, 1.0}, {7.0, 5.0}}};
  double whole_m = 0.0;
  double chosen_m = 0.0;
  int both_ok = 0;
  for (std::uint64_t seed = 1; seed <= 2; ++seed) {
    const test::SimulatedSite site =
        test::blocked_site(test::polled_settings(test::Route::kWaves, 240.0), blocking, seed);
    const Result whole = calibrate(site.drive());
    const Result chosen = calibrate(site.drive(), {.most_anchor_ranges = kBudget});
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const model::AnchorCalibration& one = whole.calibration.anchors[a];
      const model::AnchorCalibration& other = chosen.calibration.anchors[a];
      EXPECT_EQ(model::is_usable(one.verdict), model::is_usable(other.verdict)) << seed << " " << one.id;
      EXPECT_EQ(one.verdict == model::AnchorVerdict::kNeverLos,
                other.verdict == model::AnchorVerdict::kNeverLos)
          << seed << " " << one.id;
      if (one.verdict != model::AnchorVerdict::kOk || other.verdict != model::AnchorVerdict::kOk) continue;
      ++both_ok;
      whole_m += (one.position_m - site.anchors[a].position_m).norm();
      chosen_m += (other.position_m - site.anchors[a].position_m).norm();
    }
  }
  EXPECT_GT(both_ok, 14);
  RecordProperty("chosen_over_whole", std::to_string(chosen_m / whole_m));
  EXPECT_LT(chosen_m, 1.5 * whole_m);
}

}  // namespace
}  // namespace groma::calibration
