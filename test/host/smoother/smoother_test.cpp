#include "host/smoother/smoother.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "test/host/filter/small_site.hpp"

namespace groma::smoother {
namespace {

namespace site = filter::testing;
using test::Random;

constexpr model::PlanarPose kStart{1.0, -2.0, 0.4};

filter::ReplayOptions options_of(filter::Model model) {
  filter::ReplayOptions options;
  options.config.model = model;
  options.config.odometry = {0.03, 0.03, 0.01};
  options.start = {.t_s = 0.0, .pose = kStart};
  return options;
}

struct Score {
  double square_m2 = 0.0;
  double nees = 0.0;  // over 3
};

// Score of one estimate.
Score score(const model::PlanarEstimate& row, const model::PlanarPose& truth) {
  const Eigen::Vector3d e(row.x_m - truth.x_m, row.y_m - truth.y_m,
                          model::wrap_angle(row.yaw_rad - truth.theta_rad));
  return {.square_m2 = e.head<2>().squaredNorm(), .nees = e.dot(row.covariance.inverse() * e) / 3.0};
}

class Smoothing : public ::testing::TestWithParam<filter::Model> {};
INSTANTIATE_TEST_SUITE_P(Smoother, Smoothing,
                         ::testing::Values(filter::Model::kSchmidt, filter::Model::kJoint),
                         [](const ::testing::TestParamInfo<filter::Model>& model) {
                           return std::string(filter::model_name(model.param));
                         });

TEST_P(Smoothing, IsBetterThanTheFilterAndConsistent) {
  constexpr int kSites = 60;
  const model::Surface surface = site::hills(0.2);
  const model::Calibration calibration = site::six_anchors(0.5);
  Random random(31);
  Score smoothed;
  Score filtered;
  double los = 0.0;
  for (int i = 0; i < kSites; ++i) {
    const site::Drive drive =
        site::drive(surface, calibration, kStart, {.duration_s = 12.0, .range_s = 0.02}, random);
    const auto tags = site::three_tags();
    const filter::Run run{drive.odometry, drive.ranges, tags, &surface, &calibration};
    filter::ReplayOptions options = options_of(GetParam());
    options.start.pose = {kStart.x_m + 0.1 * random.gaussian(), kStart.y_m + 0.1 * random.gaussian(),
                          kStart.theta_rad + 0.05 * random.gaussian()};
    const Result result = smooth(run, options);
    ASSERT_EQ(result.rows.size(), drive.odometry.size());
    EXPECT_TRUE(result.converged);
    los += result.ranges_los / static_cast<double>(result.ranges.size()) / kSites;
    const std::size_t row = 60 + static_cast<std::size_t>(random.uniform(0.0, 120.0));
    EXPECT_EQ(result.rows[row].t_s, drive.odometry[row].t_s);
    const Score here = score(result.rows[row], drive.truth[row]);
    smoothed.square_m2 += here.square_m2 / kSites;
    smoothed.nees += here.nees / kSites;
    const model::PlanarEstimate live = filter::replay(run, options).rows[row];
    filtered.square_m2 +=
        (std::pow(live.x_m - drive.truth[row].x_m, 2) + std::pow(live.y_m - drive.truth[row].y_m, 2)) /
        kSites;
  }
  EXPECT_GT(los, 0.95);
  EXPECT_LT(smoothed.square_m2, filtered.square_m2);
  EXPECT_NEAR(smoothed.nees, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
}

// The height of an anchor that is about as high as the tags acts on ranges by its square. At just that height
// the ranges do not tell in which direction to begin.
TEST_P(Smoothing, ConvergesWhereTheHeightsOfAnchorsAreOpen) {
  constexpr int kSites = 12;
  constexpr double kHeightSigma_m = 2.0;
  const model::Surface flat;
  const std::vector<model::Tag> tags{site::three_tags()[1]};
  for (const double height_m : {1.5, tags[0].lever_arm_m.z()}) {
    SCOPED_TRACE(height_m);
    model::Calibration calibration = site::six_anchors(0.5);
    for (model::AnchorCalibration& anchor : calibration.anchors) {
      anchor.position_m.z() = height_m;
      anchor.covariance(2, 2) += kHeightSigma_m * kHeightSigma_m;
      anchor.verdict = model::AnchorVerdict::kWeakZ;
    }
    Random random(38);
    double square_m2 = 0.0;
    double nees = 0.0;
    for (int i = 0; i < kSites; ++i) {
      site::Drive drive =
          site::drive(flat, calibration, kStart, {.duration_s = 30.0, .range_s = 0.02}, random);
      std::erase_if(drive.ranges,
                    [&](const model::RangeSample& range) { return range.tag_id != tags[0].id; });
      const Result result =
          smooth({drive.odometry, drive.ranges, tags, &flat, &calibration}, options_of(GetParam()));
      EXPECT_TRUE(result.converged) << i;
      ASSERT_EQ(result.rows.size(), drive.truth.size());
      const Score here = score(result.rows[300], drive.truth[300]);
      square_m2 += here.square_m2 / kSites;
      nees += here.nees / kSites;
    }
    EXPECT_LT(std::sqrt(square_m2), 0.1);
    EXPECT_LT(nees, 1.0 + 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
  }
}

TEST_P(Smoothing, GivesNlosRangesLittleWeight) {
  const model::Surface surface = site::hills(0.2);
  const model::Calibration calibration = site::six_anchors(0.2);
  Random random(32);
  site::Drive drive =
      site::drive(surface, calibration, kStart, {.duration_s = 12.0, .range_s = 0.02}, random);
  std::size_t nlos = 0;
  for (model::RangeSample& range : drive.ranges) {
    if (range.anchor_id > 13 || range.t_s < 4.0 || range.t_s > 7.0) continue;
    range.range_m += 0.7 + 0.05 * random.gaussian();
    ++nlos;
  }
  const auto tags = site::three_tags();
  const Result result =
      smooth({drive.odometry, drive.ranges, tags, &surface, &calibration}, options_of(GetParam()));
  EXPECT_NEAR(result.ranges_los, static_cast<double>(drive.ranges.size() - nlos),
              0.05 * static_cast<double>(drive.ranges.size()));
  for (std::size_t row = 0; row < result.rows.size(); ++row) {
    EXPECT_LT(
        std::hypot(result.rows[row].x_m - drive.truth[row].x_m, result.rows[row].y_m - drive.truth[row].y_m),
        0.12)
        << row;
  }
}

// Ranges that are too long by less than the gate refuses, so that their weights are between 0 and 1.
TEST_P(Smoothing, RangesThatMayBeNlosCountForLess) {
  const model::Surface flat;
  const model::Calibration calibration = site::six_anchors(0.1);
  Random random(37);
  site::Drive drive = site::drive(flat, calibration, kStart, {.duration_s = 12.0, .range_s = 0.02}, random);
  for (model::RangeSample& range : drive.ranges) {
    if (range.anchor_id <= 12) range.range_m += 0.25;
  }
  const auto tags = site::three_tags();
  const auto mean_error_m = [&](double nlos_prior) {
    filter::ReplayOptions options = options_of(GetParam());
    options.config.gate.nlos_prior = nlos_prior;
    const Result result = smooth({drive.odometry, drive.ranges, tags, &flat, &calibration}, options);
    double sum_m = 0.0;
    for (std::size_t row = 0; row < result.rows.size(); ++row)
      sum_m += std::sqrt(score(result.rows[row], drive.truth[row]).square_m2);
    return sum_m / static_cast<double>(result.rows.size());
  };
  EXPECT_LT(mean_error_m(0.3), 0.8 * mean_error_m(0.0));
}

TEST_P(Smoothing, EstimatesDelaysOfOdometryAndRangesSeparately) {
  const model::Surface flat;
  model::Calibration calibration = site::six_anchors(0.1);
  calibration.range_delay_s = 0.06;
  calibration.range_delay_sigma_s = 0.002;
  Random random(33);
  site::Drive drive = site::drive(flat, calibration, kStart, {.duration_s = 40.0, .range_s = 0.02}, random);
  for (model::RangeSample& range : drive.ranges) range.t_s += calibration.range_delay_s;
  for (std::size_t i = drive.odometry.size(); i-- > 2;) {
    const double t_s = drive.odometry[i].t_s;
    drive.odometry[i] = drive.odometry[i - 2];
    drive.odometry[i].t_s = t_s;
  }
  const auto tags = site::three_tags();
  const auto solved = [&](double odometry_delay_sigma_s, double& mean_m, double& nees) {
    filter::ReplayOptions options = options_of(GetParam());
    options.config.odometry_delay_sigma_s = odometry_delay_sigma_s;
    Result result = smooth({drive.odometry, drive.ranges, tags, &flat, &calibration}, options);
    for (std::size_t row = 40; row < result.rows.size(); ++row) {
      const Score here = score(result.rows[row], drive.truth[row]);
      mean_m += std::sqrt(here.square_m2) / static_cast<double>(result.rows.size() - 40);
      nees += here.nees / static_cast<double>(result.rows.size() - 40);
    }
    return result;
  };
  double exact_m = 0.0;
  double exact_nees = 0.0;
  static_cast<void>(solved(0.0, exact_m, exact_nees));
  double open_m = 0.0;
  double open_nees = 0.0;
  const Result open = solved(0.05, open_m, open_nees);
  EXPECT_NEAR(open.odometry_delay_s, 0.1, 0.02);
  EXPECT_NEAR(open.range_delay_s, 0.06, 0.01);
  EXPECT_LT(open_m, 0.6 * exact_m);
  EXPECT_LT(open_nees, 2.5);
  EXPECT_GT(exact_nees, 2.0 * open_nees);
}

// One tag, because the filter's bias is an anchor's and the smoother's is a pair's. All weights are 1.
TEST_P(Smoothing, IsConsistentWithASlowRangeBias) {
  constexpr int kSites = 40;
  const model::Surface flat;
  model::Calibration calibration = site::six_anchors(0.3);
  calibration.range_noise = {.white_sigma_m = 0.05, .bias_sigma_m = 0.15, .bias_length_m = 4.0};
  const std::vector<model::Tag> tag{site::three_tags().front()};
  Random random(34);
  Score smoothed;
  Score filtered;
  for (int i = 0; i < kSites; ++i) {
    const site::Drive drive =
        site::drive(flat, calibration, kStart, {.duration_s = 6.0, .range_s = 0.02}, random);
    const filter::Run run{drive.odometry, drive.ranges, tag, &flat, &calibration};
    filter::ReplayOptions options = options_of(GetParam());
    options.config.range_bias_growth = 1.0;
    options.config.tunes_noise = false;
    options.config.gate.nlos_prior = 0.0;
    options.config.gate.garbage_share = 0.0;
    options.start.position_sigma_m = 0.5;
    options.start.heading_sigma_rad = 0.2;
    options.start.pose = {kStart.x_m + 0.5 * random.gaussian(), kStart.y_m + 0.5 * random.gaussian(),
                          kStart.theta_rad + 0.2 * random.gaussian()};
    const Result result = smooth(run, options);
    ASSERT_EQ(result.rows.size(), drive.odometry.size());
    const std::size_t row = 30 + static_cast<std::size_t>(random.uniform(0.0, 60.0));
    const Score here = score(result.rows[row], drive.truth[row]);
    smoothed.square_m2 += here.square_m2 / kSites;
    smoothed.nees += here.nees / kSites;
    filtered.square_m2 += score(filter::replay(run, options).rows[row], drive.truth[row]).square_m2 / kSites;
  }
  EXPECT_NEAR(smoothed.nees, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
  EXPECT_LT(smoothed.square_m2, filtered.square_m2);
}

// How far an anchor that is off by 0.2 m draws the poses, by its sigma.
TEST(Smoother, RangesOfAnAnchorThatIsKnownLessWellCountForLess) {
  const model::Surface flat;
  const model::Calibration calibration = site::six_anchors(0.1);
  Random random(36);
  const site::Drive drive =
      site::drive(flat, calibration, kStart, {.duration_s = 12.0, .range_s = 0.02}, random);
  const auto tags = site::three_tags();
  const auto smoothed = [&](double off_m, double sigma_m) {
    model::Calibration off = calibration;
    off.anchors[0].position_m.x() += off_m;
    off.anchors[0].covariance.topLeftCorner<2, 2>() = sigma_m * sigma_m * Eigen::Matrix2d::Identity();
    filter::ReplayOptions options = options_of(filter::Model::kSchmidt);
    options.config.gate.nlos_prior = 0.0;
    options.config.gate.garbage_share = 0.0;
    options.config.tunes_noise = false;
    return smooth({drive.odometry, drive.ranges, tags, &flat, &off}, options).rows;
  };
  const auto drawn_m = [&](double sigma_m) {
    const std::vector<model::PlanarEstimate> on = smoothed(0.0, sigma_m);
    const std::vector<model::PlanarEstimate> off = smoothed(0.2, sigma_m);
    double sum_m = 0.0;
    for (std::size_t row = 0; row < on.size(); ++row)
      sum_m += std::hypot(off[row].x_m - on[row].x_m, off[row].y_m - on[row].y_m);
    return sum_m / static_cast<double>(on.size());
  };
  const double certain_m = drawn_m(0.001);
  EXPECT_GT(certain_m, 0.01);
  EXPECT_LT(drawn_m(0.1), 0.2 * certain_m);
}

// Straight on along x for 2 s: the poses and their covariance in closed form.
TEST(Smoother, FollowsOdometryFromItsStartWithoutRanges) {
  const model::Surface flat;
  const model::Calibration calibration = site::six_anchors();
  const auto tags = site::three_tags();
  std::vector<model::OdometrySample> odometry;
  for (int i = 0; i <= 20; ++i) odometry.push_back({0.1 * i, 1.0, 0.0, 0.0});
  filter::ReplayOptions options = options_of(filter::Model::kSchmidt);
  options.start = {.t_s = 0.0, .pose = {1.0, -2.0, 0.0}, .position_sigma_m = 0.1, .heading_sigma_rad = 0.05};
  options.config.tunes_noise = false;
  options.config.scale_sigma = 0.01;
  options.config.yaw_rate_bias_radps = 0.002;
  const Result result = smooth({odometry, {}, tags, &flat, &calibration}, options);
  ASSERT_EQ(result.rows.size(), odometry.size());
  EXPECT_TRUE(result.converged);
  for (std::size_t i = 0; i < result.rows.size(); ++i) {
    const double t_s = odometry[i].t_s;
    EXPECT_NEAR(result.rows[i].x_m, 1.0 + t_s, 1e-9);
    EXPECT_NEAR(result.rows[i].y_m, -2.0, 1e-9);
    EXPECT_NEAR(result.rows[i].yaw_rad, 0.0, 1e-9);
    const double white = 0.1 * t_s;  // sum of the squared intervals
    // Of y by the turns: white ones, each acting from its interval on, and the yaw-rate bias.
    const double turned = 1e-4 * 0.1 * std::pow(t_s, 3) / 3.0 + 4e-6 * std::pow(t_s, 4) / 4.0;
    const Eigen::Matrix3d& covariance = result.rows[i].covariance;
    EXPECT_NEAR(covariance(0, 0), 0.01 + 9e-4 * white + 1e-4 * t_s * t_s, 1e-6) << t_s;
    EXPECT_NEAR(covariance(2, 2), 0.0025 + 1e-4 * white + 4e-6 * t_s * t_s, 1e-7) << t_s;
    EXPECT_NEAR(covariance(1, 1), 0.01 + 9e-4 * white + 0.0025 * t_s * t_s + turned, 1e-6) << t_s;
  }
}

TEST(Smoother, IgnoresOdometryOutOfOrder) {
  const model::Surface flat;
  const model::Calibration calibration = site::six_anchors(0.2);
  const auto tags = site::three_tags();
  Random random(35);
  const site::Drive drive =
      site::drive(flat, calibration, kStart, {.duration_s = 3.0, .range_s = 0.02}, random);
  std::vector<model::OdometrySample> disordered = drive.odometry;
  // A late one, and a second one with the same time.
  disordered.insert(disordered.begin() + 30, model::OdometrySample{drive.odometry[20].t_s, 3.0, 1.0, -1.0});
  disordered.insert(disordered.begin() + 10, model::OdometrySample{drive.odometry[9].t_s, -2.0, 0.0, 1.0});
  const filter::ReplayOptions options = options_of(filter::Model::kSchmidt);
  const Result expected = smooth({drive.odometry, drive.ranges, tags, &flat, &calibration}, options);
  const Result found = smooth({disordered, drive.ranges, tags, &flat, &calibration}, options);
  ASSERT_EQ(found.rows.size(), drive.odometry.size());
  for (std::size_t i = 0; i < found.rows.size(); ++i) {
    EXPECT_EQ(found.rows[i].t_s, expected.rows[i].t_s);
    EXPECT_EQ(found.rows[i].x_m, expected.rows[i].x_m);
    EXPECT_EQ(found.rows[i].y_m, expected.rows[i].y_m);
    EXPECT_EQ(found.rows[i].yaw_rad, expected.rows[i].yaw_rad);
  }
}

TEST(Smoother, GivesNothingWithoutOdometry) {
  const model::Surface surface;
  const model::Calibration calibration = site::six_anchors();
  const auto tags = site::three_tags();
  EXPECT_TRUE(smooth({{}, {}, tags, &surface, &calibration}, {}).rows.empty());
  const std::vector<model::OdometrySample> one{{0.0, 1.0, 0.0, 0.0}};
  EXPECT_TRUE(smooth({one, {}, tags, &surface, &calibration}, {}).rows.empty());
}

}  // namespace
}  // namespace groma::smoother
