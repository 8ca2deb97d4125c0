#include "host/filter/range_measurement.hpp"

#include <gtest/gtest.h>

#include <cstddef>
#include <vector>

#include "test/host/filter/small_site.hpp"
#include "test/support/numerical_jacobian.hpp"

namespace groma::filter {
namespace {

using test::numerical_jacobian;
using test::Random;

class RangeMeasurementTest : public ::testing::Test {
 protected:
  // Random pose, all parameters off their nominal values.
  void draw() {
    core_ << random_.uniform(-9.0, 9.0), random_.uniform(-9.0, 9.0), random_.uniform(-3.0, 3.0),
        0.02 * random_.gaussian(), 0.01 * random_.gaussian(), 0.02 * random_.gaussian(),
        0.1 * random_.gaussian(), 0.1 * random_.gaussian(), 0.05 * random_.gaussian();
    row_ = {0.0, 2.0 * random_.gaussian(), random_.gaussian(), random_.gaussian()};
    parameters_.values() += 0.02 * random_.gaussians(parameters_.size());
    // The ground's deviation is considered, never estimated: its value stays zero.
    parameters_.values().segment<kGroundSize>(parameters_.ground()).setZero();
  }

  // Compares the Jacobians w.r.t. all core states and parameters with numerical ones.
  template <typename Measure>
  void expect_exact(const Measure& measure, int anchor, int tag) {
    const RangeMeasurement measurement =
        measure(surface_, core_, row_, parameters_.pair(site_, anchor, tag), 0);
    Eigen::VectorXd all(kCoreSize + parameters_.size());
    all << core_, parameters_.values();
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& x) {
          Parameters parameters = parameters_;
          parameters.values() = x.tail(parameters_.size());
          return Eigen::VectorXd::Constant(1, measure(surface_, CoreVector(x.head<kCoreSize>()), row_,
                                                      parameters.pair(site_, anchor, tag), 0)
                                                  .range_m);
        },
        all, 1e-6);
    Eigen::RowVectorXd exact = Eigen::RowVectorXd::Zero(all.size());
    exact.head<kCoreSize>() = measurement.d_core;
    const PairIndices index = parameters_.pair_indices(anchor, tag);
    for (int i = 0; i < kPairParameters; ++i) {
      exact(kCoreSize + index[static_cast<std::size_t>(i)]) = measurement.d_parameters(i);
    }
    // The derivative w.r.t. the delay is first order only on a curved surface.
    EXPECT_NEAR(exact(kDelay), numerical(kDelay), 2e-3);
    exact(kDelay) = numerical(kDelay);
    EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), 3e-7);
  }

  model::Surface surface_ = testing::hills(0.5);
  Site site_{testing::three_tags(), testing::six_anchors(), 0.01};
  Parameters parameters_{site_};
  Random random_{31};
  CoreVector core_;
  model::OdometrySample row_;
};

TEST_F(RangeMeasurementTest, DerivativesEqualNumericalOnes) {
  for (int anchor = 0; anchor < parameters_.anchor_count(); ++anchor) {
    for (int tag = 0; tag < parameters_.tag_count(); ++tag) {
      draw();
      expect_exact(measure_range, anchor, tag);
    }
  }
}

TEST_F(RangeMeasurementTest, DelayDerivativeIsExactWithoutDelay) {
  for (int i = 0; i < 30; ++i) {
    draw();
    core_(kDelay) = 0.0;
    const PairParameters pair = parameters_.pair(site_, i % 6, i % 3);
    const RangeMeasurement measurement = measure_range(surface_, core_, row_, pair);
    const double h = 1e-6;
    CoreVector late = core_;
    late(kDelay) = h;
    CoreVector early = core_;
    early(kDelay) = -h;
    const double numerical = (measure_range(surface_, late, row_, pair).range_m -
                              measure_range(surface_, early, row_, pair).range_m) /
                             (2.0 * h);
    EXPECT_NEAR(measurement.d_core(kDelay), numerical, 1e-7);
  }
}

TEST_F(RangeMeasurementTest, PredictsFromThePoseADelayAgo) {
  // The robot drives away from the anchor at 2 m/s with ranges 50 ms old: 0.1 m too short.
  const model::Calibration calibration = model::surveyed_calibration(
      std::vector<model::Anchor>{{5, {0.0, 0.0, 0.0}}}, std::vector<model::Tag>{{1, Eigen::Vector3d::Zero()}},
      {.sigma_m = 0.1, .beta_m = {0.3, 0.1}, .gamma = {1.0, 0.01}}, 0.02);
  const PairParameters pair =
      Site(std::vector<model::Tag>{{1, Eigen::Vector3d::Zero()}}, calibration, 0.01).pair(0, 0);
  CoreVector core = CoreVector::Zero();
  core(kX) = 10.0;
  core(kDelay) = 0.05;
  const RangeMeasurement measurement = measure_range(model::Surface(), core, {0.0, 2.0, 0.0, 0.0}, pair);
  EXPECT_NEAR(measurement.range_m, 10.0 - 0.1 + 0.3, 1e-12);
  EXPECT_NEAR(measurement.d_core(kDelay), -2.0, 1e-12);
  EXPECT_NEAR(measure_range(model::Surface(), core, {0.0, 2.0, 0.0, 0.0}, without_biases(pair)).range_m, 9.9,
              1e-12);
}

TEST(Parameters, EachHasItsOwnIndex) {
  const Parameters parameters(Site(testing::three_tags(), testing::six_anchors(), 0.01));
  ASSERT_EQ(parameters.size(), 6 * model::anchor_size(3) + 3 * 3 + 4 + 6 + kGroundSize);
  Eigen::VectorXi taken = Eigen::VectorXi::Zero(parameters.size());
  const auto take = [&](int first, int count) {
    ASSERT_LE(first + count, parameters.size());
    taken.segment(first, count).array() += 1;
  };
  for (int anchor = 0; anchor < 6; ++anchor) {
    take(parameters.position(anchor), 3);
    for (int tag = 0; tag < 3; ++tag) {
      const PairIndices index = parameters.pair_indices(anchor, tag);
      for (std::size_t term = 3; term < model::kPairSize; ++term) take(index[term], 1);
    }
  }
  for (int tag = 0; tag < 3; ++tag) take(parameters.lever_arm(tag), 3);
  take(parameters.frame(), 4);
  for (int anchor = 0; anchor < 6; ++anchor) take(parameters.range_bias(anchor), 1);
  take(parameters.ground(), kGroundSize);
  EXPECT_TRUE((taken.array() == 1).all());
}

TEST(Parameters, UseTheCalibrationsBlocksForTheGivenTags) {
  const model::Calibration calibration = testing::six_anchors();
  const std::vector<model::Tag> all = testing::three_tags();
  // Tags in another order, one missing, and one that the calibration lacks.
  const std::vector<model::Tag> tags{all[2], {77, Eigen::Vector3d::Ones()}, all[0]};
  const Site site(tags, calibration, 0.01);
  const Parameters parameters(site);
  const Eigen::MatrixXd covariance =
      JointCovariance(site, parameters, Model::kJoint).parameters(site, parameters);
  EXPECT_EQ(covariance, JointCovariance(site, parameters, Model::kSchmidt).parameters(site, parameters));
  for (int slot = 0; slot < 6; ++slot) {
    const model::AnchorCalibration& anchor = calibration.anchors[static_cast<std::size_t>(slot)];
    EXPECT_EQ(site.anchor_index(anchor.id), slot);
    EXPECT_EQ(parameters.pair(site, slot, 0).terms, model::values_of(anchor.pairs[2]));
    EXPECT_EQ(parameters.pair(site, slot, 2).terms, model::values_of(anchor.pairs[0]));
    EXPECT_TRUE(site.knows_pair(slot, 0));
    EXPECT_FALSE(site.knows_pair(slot, 1));
    // beta of tag 3 against gamma of tag 1, and against the position's z.
    const int beta = parameters.pair_indices(slot, 0)[3 + model::kBeta];
    const int gamma = parameters.pair_indices(slot, 2)[3 + model::kGamma];
    EXPECT_EQ(covariance(beta, gamma), anchor.covariance(3 + 2, 6 + 0));
    EXPECT_EQ(covariance(parameters.position(slot) + 2, beta), anchor.covariance(2, 5));
  }
  EXPECT_EQ(covariance(parameters.lever_arm(1), parameters.lever_arm(1)), 1e-4);
  EXPECT_EQ(covariance, covariance.transpose());
}

TEST(Parameters, LeaveOutUnusableAnchorsAndExcessTags) {
  model::Calibration calibration = testing::six_anchors();
  calibration.anchors[1].position_m.x() = std::nan("");
  calibration.anchors[2].covariance.resize(2, 2);
  calibration.anchors[3].covariance(1, 1) = std::nan("");
  EXPECT_EQ(Site(testing::three_tags(), calibration, 0.01).anchor_count(), 3);

  calibration = testing::six_anchors();
  while (calibration.anchors.size() < 40) {
    calibration.anchors.push_back(calibration.anchors.front());
    calibration.anchors.back().id = static_cast<model::NodeId>(100 + calibration.anchors.size());
  }
  std::vector<model::Tag> tags;
  for (model::NodeId id = 1; id < 20; ++id) tags.push_back({id, Eigen::Vector3d::Zero()});
  const Site site(tags, calibration, 0.01);
  EXPECT_EQ(site.anchor_count(), 40);
  EXPECT_EQ(site.tag_count, kMaxTags);
  EXPECT_EQ(site.tag_slot(19), -1);
  EXPECT_EQ(site.anchor_index(9), -1);
  EXPECT_EQ(site.anchor_index(0xFFFF), -1);
  const Parameters parameters(site);
  EXPECT_EQ(parameters.anchor_count(), kMaxAnchors);
  EXPECT_EQ(parameters.size(), kMaxParameters);
  EXPECT_EQ(Parameters(site, 5).anchor_count(), 5);
}

// The lever arm and the antenna pattern are the calibration's. For an anchor straight ahead the range is
// longer by the pattern's first coefficient.
TEST(RangeMeasurement, UsesTheCalibratedLeverArmAndPattern) {
  model::Calibration calibration =
      model::surveyed_calibration(std::vector<model::Anchor>{{5, {10.0, 0.0, 0.0}}},
                                  std::vector<model::Tag>{{1, {1.0, 0.0, 0.0}}}, {}, 0.02);
  calibration.tags.resize(1);
  calibration.tags[0].id = 1;
  calibration.tags[0].lever_arm.emplace();
  calibration.tags[0].lever_arm->position_m = {1.5, 0.0, 0.0};
  calibration.tags[0].pattern_m = model::PatternTerms::Unit(0) * 0.02;
  const PairParameters pair =
      Site(std::vector<model::Tag>{{1, {1.0, 0.0, 0.0}}}, calibration, 0.01).pair(0, 0);
  const RangeMeasurement ahead = measure_range(model::Surface(), CoreVector::Zero(), {}, pair);
  EXPECT_NEAR(ahead.range_m, 8.5 + 0.02, 1e-12);
  EXPECT_NEAR(measure_range(model::Surface(), CoreVector::Zero(), {}, without_biases(pair)).range_m, 8.5,
              1e-12);
}

}  // namespace
}  // namespace groma::filter
