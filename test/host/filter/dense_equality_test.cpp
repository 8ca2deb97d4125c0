// Compares the filter with a plain dense Kalman filter of the full state in Joseph form.
#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include <Eigen/Eigenvalues>

#include "host/filter/filter.hpp"
#include "host/filter/propagation.hpp"
#include "host/filter/range_measurement.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

Config plain_config(Model model) {
  Config config;
  config.model = model;
  config.odometry = {0.03, 0.03, 0.01};
  // All weights are 1, as in the reference.
  config.gate.nlos_prior = 0.0;
  config.gate.garbage_share = 0.0;
  config.tunes_noise = false;
  config.range_bias_growth = 1.0;
  return config;
}

// The reference: dense matrices, no sparsity, no deferred operations.
class DenseFilter {
 public:
  DenseFilter(const model::Surface& surface, const model::Calibration& calibration, const Config& config)
      : surface_(surface),
        config_(config),
        noise_(*calibration.range_noise),
        site_(testing::three_tags(), calibration, config.lever_arm_sigma_m),
        parameters_(site_) {
    const int size = kCoreSize + parameters_.size();
    x_ = Eigen::VectorXd::Zero(size);
    x_.tail(parameters_.size()) = parameters_.values();
    p_ = Eigen::MatrixXd::Zero(size, size);
    p_.bottomRightCorner(parameters_.size(), parameters_.size()) =
        testing::prior_covariance(site_, parameters_, calibration);
    estimated_ = Eigen::VectorXd::Zero(size);
    estimated_.head<kCoreSize>().setOnes();
    if (config.model == Model::kJoint) {
      estimated_.setOnes();
      for (int i = 0; i < parameters_.anchor_count(); ++i)
        estimated_(kCoreSize + parameters_.range_bias(i)) = 0.0;
    }
    if (config.model == Model::kAnchorStates) {
      for (int i = 0; i < parameters_.anchor_count(); ++i) {
        estimated_.segment<3>(kCoreSize + parameters_.position(i)).setOnes();
      }
    }
  }

  void consider_anchor(int slot) {
    estimated_.segment(kCoreSize + parameters_.position(slot), parameters_.anchor_size()).setZero();
  }

  void start(const Start& start, const model::OdometrySample& row) {
    x_.head<3>() << start.pose.x_m, start.pose.y_m, start.pose.theta_rad;
    const double position = std::pow(start.position_sigma_m, 2);
    p_.diagonal().head<kCoreSize>() << position, position, std::pow(start.heading_sigma_rad, 2),
        std::pow(config_.scale_sigma, 2), std::pow(config_.yaw_rate_bias_radps, 2),
        std::pow(config_.range_delay_sigma_s, 2), 0.0, 0.0, 0.0;
    take_row(row);
  }

  void advance(double dt_s) {
    const int steps = static_cast<int>(std::ceil(dt_s / kMaxStep_s));
    for (int i = 0; i < steps; ++i) {
      const Motion motion = move(surface_, core(), row_, dt_s / steps);
      Eigen::MatrixXd f = Eigen::MatrixXd::Identity(x_.size(), x_.size());
      f.block<3, kCoreSize>(0, 0) = motion.d_core;
      const double fade = std::exp(-(motion.pose.head<2>() - x_.head<2>()).norm() / noise_.bias_length_m);
      x_.head<3>() = motion.pose;
      for (int anchor = 0; anchor < parameters_.anchor_count(); ++anchor) {
        const int slow = kCoreSize + parameters_.range_bias(anchor);
        f(slow, slow) = fade;
        x_(slow) *= fade;
      }
      p_ = f * p_ * f.transpose();
      for (int anchor = 0; anchor < parameters_.anchor_count(); ++anchor) {
        const int slow = kCoreSize + parameters_.range_bias(anchor);
        p_(slow, slow) += (1.0 - fade * fade) * std::pow(noise_.bias_sigma_m, 2);
      }
    }
  }

  void take_row(const model::OdometrySample& row) {
    row_ = row;
    Eigen::MatrixXd keep = Eigen::MatrixXd::Identity(x_.size(), x_.size());
    keep.block<3, 3>(kOdometryVx, kOdometryVx).setZero();
    x_ = keep * x_;
    p_ = keep * p_ * keep;
    p_(kOdometryVx, kOdometryVx) = std::pow(config_.odometry.sigma_vx_mps, 2);
    p_(kOdometryVy, kOdometryVy) = std::pow(config_.odometry.sigma_vy_mps, 2);
    p_(kOdometryOmega, kOdometryOmega) = std::pow(config_.odometry.sigma_omega_radps, 2);
  }

  double update(const model::RangeSample& range) {
    parameters_.values() = x_.tail(parameters_.size());
    const int anchor = site_.anchor_index(range.anchor_id);
    const int tag = site_.tag_slot(range.tag_id);
    const PairParameters pair = parameters_.pair(site_, anchor, tag);
    const PairIndices index = parameters_.pair_indices(anchor, tag);
    const bool pure = config_.model == Model::kOriginal;
    const RangeMeasurement m = measure_range(surface_, core(), row_, pure ? without_biases(pair) : pair);
    Eigen::RowVectorXd h = Eigen::RowVectorXd::Zero(x_.size());
    h.head<kCoreSize>() = m.d_core;
    Eigen::RowVectorXd j = Eigen::RowVectorXd::Zero(x_.size());
    for (std::size_t i = 0; i < index.size(); ++i)
      j(kCoreSize + index[i]) = m.d_parameters(static_cast<Eigen::Index>(i));
    double r = std::pow(pure ? config_.range_sigma_m : noise_.white_sigma_m, 2);
    if (config_.model == Model::kInflated) r += (j * p_ * j.transpose())(0);
    if (!pure && config_.model != Model::kInflated) h += j;
    const double s = (h * p_ * h.transpose())(0) + r;
    const Eigen::VectorXd gain = estimated_.cwiseProduct(p_ * h.transpose() / s);
    const Eigen::MatrixXd rest = Eigen::MatrixXd::Identity(x_.size(), x_.size()) - gain * h;
    x_ += gain * (range.range_m - m.range_m);
    p_ = rest * p_ * rest.transpose() + gain * r * gain.transpose();
    return s;
  }

  CoreVector core() const { return x_.head<kCoreSize>(); }
  const Eigen::VectorXd& x() const { return x_; }
  const Eigen::MatrixXd& p() const { return p_; }

 private:
  const model::Surface& surface_;
  Config config_;
  model::RangeNoise noise_;
  Site site_;
  Parameters parameters_;
  model::OdometrySample row_;
  Eigen::VectorXd x_;
  Eigen::MatrixXd p_;
  Eigen::VectorXd estimated_;
};

class DenseEquality : public ::testing::TestWithParam<Model> {};

TEST_P(DenseEquality, OverADriveOnHills) {
  const model::Surface surface = testing::hills(0.3);
  model::Calibration calibration = testing::six_anchors();
  calibration.range_noise = {.white_sigma_m = 0.08, .bias_sigma_m = 0.1, .bias_length_m = 1.5};
  calibration.anchors[2].verdict = model::AnchorVerdict::kWeak;
  const Config config = plain_config(GetParam());
  Random random(41);
  const testing::Drive drive =
      testing::drive(surface, calibration, {1.0, -2.0, 0.4}, {.duration_s = 6.0, .range_s = 0.017}, random);

  const auto filter = std::make_unique<Filter>(surface, testing::three_tags(), calibration, config);
  DenseFilter dense(surface, calibration, config);
  dense.consider_anchor(2);
  const Start start{.t_s = 0.0, .pose = {1.05, -2.08, 0.43}};
  filter->process(drive.odometry.front());
  filter->start(start);
  dense.start(start, drive.odometry.front());

  double t_s = 0.0;
  std::size_t next = 0;
  for (std::size_t i = 1; i < drive.odometry.size(); ++i) {
    for (; next < drive.ranges.size() && drive.ranges[next].t_s < drive.odometry[i].t_s; ++next) {
      const model::RangeSample& range = drive.ranges[next];
      dense.advance(range.t_s - t_s);
      t_s = range.t_s;
      const double s = dense.update(range);
      const RangeResult result = filter->process(range);
      ASSERT_EQ(result.outcome, RangeOutcome::kUsed);
      EXPECT_NEAR(result.innovation_variance_m2, s, 1e-9);
    }
    dense.advance(drive.odometry[i].t_s - t_s);
    t_s = drive.odometry[i].t_s;
    dense.take_row(drive.odometry[i]);
    filter->process(drive.odometry[i]);
  }
  ASSERT_GT(next, 300U);

  const bool keeps_cross = GetParam() != Model::kOriginal && GetParam() != Model::kInflated;
  CoreVector difference = filter->core() - dense.core();
  difference(kTheta) = model::wrap_angle(difference(kTheta));
  EXPECT_LT(difference.cwiseAbs().maxCoeff(), 1e-9);
  EXPECT_LT(
      (filter->parameters().values() - dense.x().tail(filter->parameters().size())).cwiseAbs().maxCoeff(),
      1e-9);
  const Eigen::MatrixXd p = testing::whole(*filter);
  EXPECT_LT((p - dense.p()).cwiseAbs().maxCoeff(), 1e-9);
  EXPECT_EQ(filter->covariance().cross().cwiseAbs().maxCoeff() > 1e-5, keeps_cross);
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(p).eigenvalues().minCoeff(), -1e-12);
}

INSTANTIATE_TEST_SUITE_P(Models, DenseEquality,
                         ::testing::Values(Model::kOriginal, Model::kInflated, Model::kSchmidt,
                                           Model::kAnchorStates, Model::kJoint),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           std::string name(model_name(model.param));
                           std::erase(name, '-');
                           return name;
                         });

}  // namespace
}  // namespace groma::filter
