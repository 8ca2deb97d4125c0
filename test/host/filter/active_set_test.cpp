// Sites with more anchors than the filter keeps active: corridors driven from end to end and back.
#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <initializer_list>
#include <memory>
#include <vector>

#include <Eigen/Eigenvalues>
#include <Eigen/LU>

#include "host/filter/filter.hpp"
#include "host/filter/ordered_filter.hpp"
#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"

namespace groma::filter {
namespace {

using test::Random;

constexpr double kSpacing_m = 4.0;
constexpr double kReach_m = 9.0;
constexpr double kSpeed_mps = 2.0;

// Anchors alternate between both sides of the corridor.
model::Calibration corridor(int anchors, double position_sigma_m = 0.1) {
  std::vector<model::Anchor> along;
  along.reserve(static_cast<std::size_t>(anchors));
  for (int i = 0; i < anchors; ++i) {
    along.push_back({static_cast<model::NodeId>(100 + i),
                     {kSpacing_m * i, i % 2 == 0 ? 3.0 : -3.0, 1.0 + 0.5 * (i % 4)}});
  }
  model::Calibration calibration = model::surveyed_calibration(
      along, testing::three_tags(), {.sigma_m = 0.1, .beta_m = {0.2, 0.05}, .gamma = {1.0, 0.002}},
      position_sigma_m);
  calibration.common_frame_covariance.diagonal() << 4e-4, 4e-4, 1e-4, 1e-9;
  for (model::AnchorCalibration& anchor : calibration.anchors)
    model::add_common_frame(anchor, calibration.common_frame_covariance);
  calibration.range_noise = {.white_sigma_m = 0.1, .bias_sigma_m = 0.05, .bias_length_m = 3.0};
  return calibration;
}

struct Truth {
  std::vector<model::OdometrySample> odometry;
  std::vector<model::RangeSample> ranges;  // by time
  std::vector<std::size_t> ranges_until;   // number of ranges before the end of each odometry interval
  std::vector<model::PlanarPose> poses;    // at each odometry sample
  std::vector<Eigen::Vector3d> anchors;
};

// Drives from end to end `trips` times. All errors are drawn from the calibration's covariances.
Truth drive_along(const model::Calibration& calibration, int trips, Random& random) {
  constexpr double kRow_s = 0.1;
  const double length_m = kSpacing_m * static_cast<double>(calibration.anchors.size() - 1);
  const model::RangeNoise noise = *calibration.range_noise;
  Truth out;
  std::vector<Eigen::VectorXd> sites;
  const Eigen::VectorXd frame = random.gaussians(calibration.common_frame_covariance);
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    Eigen::VectorXd site =
        random.gaussians(model::own_covariance(anchor, calibration.common_frame_covariance));
    site += model::values_of(anchor);
    site.head<3>() += frame.head<3>() + frame(3) * Eigen::Vector3d(-site(1), site(0), 0.0);
    out.anchors.emplace_back(site.head<3>());
    sites.push_back(site);
  }
  std::vector<model::Tag> tags = testing::three_tags();
  for (model::Tag& tag : tags) tag.lever_arm_m += 0.01 * random.gaussians(3);
  std::vector<double> slow_m;
  for (std::size_t i = 0; i < sites.size(); ++i) slow_m.push_back(noise.bias_sigma_m * random.gaussian());
  const double fade = std::exp(-kSpeed_mps * kRow_s / noise.bias_length_m);
  const double scale = 0.01 * random.gaussian();
  const double bias = 0.002 * random.gaussian();

  model::PlanarPose at{0.0, 0.0, 0.0};
  int trip = 0;
  for (int row = 0; trip < trips; ++row) {
    const double t_s = row * kRow_s;
    const double target = (trip % 2 == 0 ? 0.0 : std::numbers::pi) - (trip % 2 == 0 ? 0.2 : -0.2) * at.y_m;
    const Eigen::Vector3d velocity(kSpeed_mps, 0.0, 1.5 * model::wrap_angle(target - at.theta_rad));
    out.poses.push_back(at);
    out.odometry.push_back({t_s, (velocity.x() + 0.03 * random.gaussian()) / (1.0 + scale),
                            0.03 * random.gaussian() / (1.0 + scale),
                            velocity.z() + bias + 0.01 * random.gaussian()});
    for (double& error_m : slow_m) {
      error_m = fade * error_m + std::sqrt(1.0 - fade * fade) * noise.bias_sigma_m * random.gaussian();
    }
    // Each anchor in reach answers one tag per odometry interval.
    int count = 0;
    for (std::size_t i = 0; i < sites.size(); ++i) {
      if (std::abs(sites[i](0) - at.x_m) > kReach_m) continue;
      const double dt_s = kRow_s * (0.05 + 0.1 * count++);
      const std::size_t tag = (i + static_cast<std::size_t>(row)) % 3;
      const model::SurfacePose pose = model::pose_on_surface(
          model::Surface(), testing::integrate(model::Surface(), at, velocity, dt_s, 1));
      const auto prediction =
          model::predict_range(pose.pose, tags[tag].lever_arm_m, sites[i].head<3>(),
                               model::terms_of(sites[i], static_cast<Eigen::Index>(tag), 3));
      out.ranges.push_back({t_s + dt_s, tags[tag].id, calibration.anchors[i].id,
                            prediction.range_m + slow_m[i] + noise.white_sigma_m * random.gaussian()});
    }
    out.ranges_until.push_back(out.ranges.size());
    at = testing::integrate(model::Surface(), at, velocity, kRow_s, 2);
    const bool outward = trip % 2 == 0;
    if ((outward && at.x_m > length_m) || (!outward && at.x_m < 0.0)) ++trip;
  }
  return out;
}

Config config_with(Model model, int active) {
  Config config;
  config.model = model;
  config.odometry = {0.03, 0.03, 0.01};
  config.active_anchors = active;
  config.range_bias_growth = 1.0;
  // No NLOS, so that the gate's history of an anchor before its removal does not matter.
  config.gate.nlos_prior = 0.0;
  config.gate.garbage_share = 0.0;
  config.tunes_noise = false;
  return config;
}

template <class FilterType>
std::unique_ptr<FilterType> make(const model::Calibration& calibration, const Config& config) {
  return std::make_unique<FilterType>(model::Surface(), testing::three_tags(), calibration, config);
}

// Processes the odometry samples [from, to) and their ranges; calls `check` after each sample.
template <class FilterType, class Check>
void feed(const Truth& truth, std::size_t from, std::size_t to, FilterType& filter, const Check& check) {
  for (std::size_t row = from; row < to; ++row) {
    if (row > 0) filter.process(truth.odometry[row]);
    check(row);
    for (std::size_t i = row > 0 ? truth.ranges_until[row - 1] : 0; i < truth.ranges_until[row]; ++i) {
      filter.process(truth.ranges[i]);
    }
  }
}

template <class FilterType>
void begin(const Truth& truth, FilterType& filter, Random* random = nullptr) {
  filter.process(truth.odometry.front());
  const auto draw = [&](double sigma) { return random != nullptr ? sigma * random->gaussian() : 0.0; };
  filter.start({.t_s = 0.0, .pose = {draw(0.1), draw(0.1), draw(0.05)}});
}

const auto kNothing = [](std::size_t) {};

// The reference has all anchors active. For considered anchors, the cross-covariance of an inactive anchor
// with the core is exact.
TEST(ActiveSet, ExchangesOfConsideredAnchorsLoseNoInformation) {
  const model::Calibration calibration = corridor(kMaxAnchors);
  Random random(81);
  const Truth truth = drive_along(calibration, 4, random);
  const auto reference = make<Filter>(calibration, config_with(Model::kSchmidt, kMaxAnchors));
  const auto filter = make<Filter>(calibration, config_with(Model::kSchmidt, 8));
  for (Filter* each : {reference.get(), filter.get()}) begin(truth, *each);
  double largest = 0.0;
  double largest_covariance = 0.0;
  std::size_t row = 0;
  for (; row < truth.odometry.size(); row += 10) {
    const std::size_t to = std::min(row + 10, truth.odometry.size());
    for (Filter* each : {reference.get(), filter.get()}) feed(truth, row, to, *each, kNothing);
    largest = std::max(largest, (reference->core() - filter->core()).cwiseAbs().maxCoeff());
    largest_covariance =
        std::max(largest_covariance,
                 (reference->covariance().core() - filter->covariance().core()).cwiseAbs().maxCoeff());
  }
  EXPECT_LT(largest, 1e-9);
  EXPECT_LT(largest_covariance, 1e-9);
  EXPECT_EQ(reference->counters().anchor_exchanges, 0U);
  EXPECT_GT(filter->counters().anchor_exchanges, 24U);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kNotActive], 0U);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kUsed],
            reference->counters().ranges[RangeOutcome::kUsed]);
}

struct Drives {
  double nees = 0.0;
  double error_m = 0.0;
};

// Mean NEES and error at one instant of the last trip, over many corridors.
Drives drive_many(Model model, int anchors, int active, int trips, int corridors, std::uint64_t seed) {
  Random random(seed);
  Drives out;
  for (int i = 0; i < corridors; ++i) {
    const model::Calibration calibration = corridor(anchors);
    const Truth truth = drive_along(calibration, trips, random);
    const auto filter = make<Filter>(calibration, config_with(model, active));
    begin(truth, *filter, &random);
    const auto rows = static_cast<double>(truth.odometry.size());
    const auto instant = static_cast<std::size_t>(random.uniform((trips - 1.0) / trips, 0.99) * rows);
    feed(truth, 0, instant, *filter, kNothing);
    filter->process(truth.odometry[instant]);
    const Estimate estimate = filter->estimate();
    out.nees += testing::squared_error(estimate, truth.poses[instant]) / (3.0 * corridors);
    out.error_m += std::hypot(estimate.pose.x_m - truth.poses[instant].x_m,
                              estimate.pose.y_m - truth.poses[instant].y_m) /
                   corridors;
    EXPECT_EQ(filter->counters().ranges[RangeOutcome::kNotActive], 0U);
    EXPECT_EQ(filter->counters().anchor_exchanges > 0, active < anchors);
  }
  return out;
}

class ActiveSetModels : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(ActiveSet, ActiveSetModels, ::testing::Values(Model::kSchmidt, Model::kJoint),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           return std::string(model_name(model.param));
                         });

TEST_P(ActiveSetModels, IsConsistentOverManyReturns) {
  constexpr int kCorridors = 150;
  const Drives reference = drive_many(GetParam(), kMaxAnchors, kMaxAnchors, 2, kCorridors, 82);
  const Drives drives = drive_many(GetParam(), kMaxAnchors, 8, 2, kCorridors, 82);
  RecordProperty("nees", std::to_string(drives.nees));
  RecordProperty("nees_reference", std::to_string(reference.nees));
  // 4 sigmas of the mean of chi-squares.
  EXPECT_NEAR(reference.nees, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kCorridors)));
  EXPECT_NEAR(drives.nees, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kCorridors)));
  EXPECT_NEAR(drives.error_m, reference.error_m, 0.1 * reference.error_m);
}

// The same anchors are removed and come back many times: the neglected correlations must not add up.
TEST(ActiveSet, EstimatedAnchorsStayConsistentOverManyTrips) {
  constexpr int kCorridors = 60;
  const Drives drives = drive_many(Model::kJoint, kMaxAnchors, 6, 12, kCorridors, 87);
  RecordProperty("nees", std::to_string(drives.nees));
  EXPECT_NEAR(drives.nees, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kCorridors)));
}

// A thousand anchors: errors are as small as with few, and nothing is allocated.
TEST_P(ActiveSetModels, AThousandAnchorsFromEndToEnd) {
  const model::Calibration calibration = corridor(1000);
  Random random(83);
  const Truth truth = drive_along(calibration, 1, random);
  const auto filter = make<Filter>(calibration, config_with(GetParam(), kMaxAnchors));
  EXPECT_EQ(filter->anchors(), 1000U);
  begin(truth, *filter);
  const std::size_t before = test::allocations();
  double nees = 0.0;
  double worst_m = 0.0;
  feed(truth, 0, truth.odometry.size(), *filter, [&](std::size_t row) {
    const Estimate estimate = filter->estimate();
    nees += testing::squared_error(estimate, truth.poses[row]) /
            (3.0 * static_cast<double>(truth.odometry.size()));
    worst_m = std::max(worst_m, std::hypot(estimate.pose.x_m - truth.poses[row].x_m,
                                           estimate.pose.y_m - truth.poses[row].y_m));
  });
  EXPECT_EQ(test::allocations(), before);
  RecordProperty("nees", std::to_string(nees));
  RecordProperty("worst_m", std::to_string(worst_m));
  EXPECT_GT(nees, 0.6);
  EXPECT_LT(nees, 1.5);
  EXPECT_LT(worst_m, 0.4);
  EXPECT_EQ(filter->counters().anchor_exchanges, 1000U - kMaxAnchors);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kNotActive], 0U);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kUsed], truth.ranges.size());
}

// Poorly surveyed anchors are estimated on the way out and removed from the active set. On the way back their
// estimates are restored.
TEST(ActiveSet, AnAnchorComesBackWithItsEstimate) {
  const model::Calibration calibration = corridor(40, 0.5);
  Random random(84);
  double nees = 0.0;
  constexpr int kSites = 20;
  for (int i = 0; i < kSites; ++i) {
    const Truth truth = drive_along(calibration, 2, random);
    const auto filter = make<Filter>(calibration, config_with(Model::kJoint, kMaxAnchors));
    begin(truth, *filter);
    // The variance of the fifth anchor: at first, when it is removed, and when it is active again.
    constexpr int kAnchor = 4;
    const int slot = filter->parameters().slot_of(kAnchor);
    ASSERT_EQ(slot, kAnchor);
    const auto variance = [&] {
      const Parameters& parameters = filter->parameters();
      const int x = parameters.position(filter->parameters().slot_of(kAnchor));
      return filter->covariance().parameters(filter->site(), parameters)(x, x);
    };
    const double before = variance();
    double estimated = 0.0;
    double back = 0.0;
    std::size_t row = 0;
    for (; row < truth.odometry.size() && back == 0.0; ++row) {
      const bool was_active = filter->parameters().slot_of(kAnchor) >= 0;
      if (was_active) estimated = variance();
      feed(truth, row, row + 1, *filter, kNothing);
      if (!was_active && filter->parameters().slot_of(kAnchor) >= 0) back = variance();
    }
    ASSERT_GT(back, 0.0);
    EXPECT_LT(estimated, 0.1 * before);
    EXPECT_LT(back, 1.2 * estimated);
    const Parameters& parameters = filter->parameters();
    const int first = parameters.position(filter->parameters().slot_of(kAnchor));
    const Eigen::Vector3d e = parameters.values().segment<3>(first) + parameters.values().head<3>() +
                              parameters.values()(3) * Eigen::Vector3d(-parameters.values()(first + 1),
                                                                       parameters.values()(first), 0.0) -
                              truth.anchors[kAnchor];
    Eigen::Matrix<double, 3, Eigen::Dynamic> d =
        Eigen::Matrix<double, 3, Eigen::Dynamic>::Zero(3, parameters.size());
    d.leftCols<3>().setIdentity();
    d.middleCols<3>(first).setIdentity();
    const Eigen::Matrix3d p = d * filter->covariance().parameters(filter->site(), parameters) * d.transpose();
    nees += e.dot(p.inverse() * e) / (3.0 * kSites);
  }
  // Chi-square of 60 degrees of freedom, 4 sigmas.
  EXPECT_LT(nees, 1.0 + 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
}

// While an anchor is absent, the ranges of others improve frame and lever arms. Its estimate follows by the
// regression on them when it left.
TEST(ActiveSet, AnAbsentAnchorFollowsTheCommonParameters) {
  model::Calibration calibration = corridor(4);
  const Eigen::Matrix4d drift = Eigen::Vector4d(0.04, 0.04, 0.0, 0.0).asDiagonal();
  calibration.common_frame_covariance += drift;
  for (model::AnchorCalibration& anchor : calibration.anchors) {
    anchor.verdict = model::AnchorVerdict::kOk;
    model::add_common_frame(anchor, drift);
  }
  const auto filter = make<Filter>(calibration, config_with(Model::kJoint, 3));
  const std::vector<model::Tag> tags = testing::three_tags();
  filter->process(model::OdometrySample{});
  filter->start({.pose = {5.0, 0.0, 0.0}});
  // Ranges of these anchors in turn, from the start's pose to anchors off by the frame's error.
  double t_s = 0.0;
  const auto range = [&](std::initializer_list<std::size_t> anchors, double duration_s) {
    for (const double end_s = t_s + duration_s; t_s < end_s;) {
      for (const std::size_t anchor : anchors) {
        for (const model::Tag& tag : tags) {
          t_s += 0.02;
          filter->process(model::OdometrySample{t_s, 0.0, 0.0, 0.0});
          const Eigen::Vector3d antenna_m = Eigen::Vector3d(5.0, 0.0, 0.0) + tag.lever_arm_m;
          const Eigen::Vector3d anchor_m =
              calibration.anchors[anchor].position_m + Eigen::Vector3d(0.2, -0.15, 0.0);
          filter->process(model::RangeSample{t_s, tag.id, calibration.anchors[anchor].id,
                                             (antenna_m - anchor_m).norm() + 0.2});
        }
      }
    }
  };
  range({0, 1, 2}, 0.2);
  range({1, 2}, 1.5);
  ASSERT_GE(filter->parameters().slot_of(0), 0);
  const Parameters left = filter->parameters();
  const Eigen::MatrixXd p = filter->covariance().parameters(filter->site(), left);
  const int first = left.position(filter->parameters().slot_of(0));
  const int size = left.anchor_size() - 1;  // without the slow range bias
  const int common = left.common_size();
  const Eigen::MatrixXd regression =
      p.block(first, 0, size, common) * p.topLeftCorner(common, common).inverse();
  range({3, 2}, 2.0);
  ASSERT_EQ(filter->parameters().slot_of(0), -1);
  // A range far off makes it active again and corrects nothing.
  ASSERT_EQ(filter->process(model::RangeSample{t_s, 1, calibration.anchors[0].id, 900.0}).outcome,
            RangeOutcome::kGated);
  ASSERT_GE(filter->parameters().slot_of(0), 0);
  const Parameters& now = filter->parameters();
  const Eigen::VectorXd change = now.values().segment(now.position(filter->parameters().slot_of(0)), size) -
                                 left.values().segment(first, size);
  const Eigen::VectorXd expected = regression * (now.values().head(common) - left.values().head(common));
  EXPECT_GT(expected.norm(), 1e-3);
  EXPECT_LT((change - expected).norm(), 1e-7);
}

// Late inputs across exchanges of anchors: the result equals that of inputs in order.
TEST_P(ActiveSetModels, LateInputsUndoExchanges) {
  const model::Calibration calibration = corridor(60);
  Random random(85);
  const Truth truth = drive_along(calibration, 2, random);
  Config config = config_with(GetParam(), 6);
  config.silent_s = 0.3;
  const auto reference = make<Filter>(calibration, config);
  begin(truth, *reference);
  feed(truth, 0, truth.odometry.size(), *reference, kNothing);
  const auto filter = make<OrderedFilter>(calibration, config);
  begin(truth, *filter);
  // In blocks of four odometry samples: first the ranges, then the samples, each in reverse order.
  const std::size_t before = test::allocations();
  for (std::size_t block = 0; block < truth.odometry.size(); block += 4) {
    const std::size_t end = std::min(block + 4, truth.odometry.size());
    const std::size_t first = block > 0 ? truth.ranges_until[block - 1] : 0;
    for (std::size_t i = truth.ranges_until[end - 1]; i > first; --i) filter->process(truth.ranges[i - 1]);
    for (std::size_t row = end; row > std::max<std::size_t>(block, 1); --row)
      filter->process(truth.odometry[row - 1]);
  }
  EXPECT_EQ(test::allocations(), before);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kOutOfOrder], 0U);
  EXPECT_GT(reference->counters().anchor_exchanges, 90U);
  EXPECT_EQ(filter->counters().anchor_exchanges, reference->counters().anchor_exchanges);
  EXPECT_EQ(filter->counters().ranges[RangeOutcome::kNotActive],
            reference->counters().ranges[RangeOutcome::kNotActive]);
  EXPECT_EQ(filter->filter().core(), reference->core());
  EXPECT_EQ(testing::whole(filter->filter()), testing::whole(*reference));
  EXPECT_EQ(filter->filter().parameters().values(), reference->parameters().values());
}

// If more anchors answer than may be active, the active ones stay and the others' ranges are counted.
TEST(ActiveSet, RefusesRangesWithoutAFreeSlot) {
  const model::Calibration calibration = corridor(kMaxAnchors);
  Random random(86);
  const Truth truth = drive_along(calibration, 1, random);
  const auto filter = make<Filter>(calibration, config_with(Model::kSchmidt, 3));
  begin(truth, *filter);
  feed(truth, 0, truth.odometry.size(), *filter, kNothing);
  const Counters& counters = filter->counters();
  EXPECT_GT(counters.ranges[RangeOutcome::kNotActive], 100U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kUsed] + counters.ranges[RangeOutcome::kNotActive],
            truth.ranges.size());
  EXPECT_LT(std::abs(filter->estimate().pose.y_m - truth.poses.back().y_m), 0.5);
}

}  // namespace
}  // namespace groma::filter
