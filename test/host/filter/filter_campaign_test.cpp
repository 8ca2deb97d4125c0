// Accuracy and consistency of the filter against the posterior Cramer-Rao bound. One instant of each drive
// with the seeds GROMA_FIRST_SEED to GROMA_LAST_SEED (the environment may override these), each on a site of
// its own drawn from the calibration's covariance. For short campaigns the limits are wider by
// GROMA_SAMPLING_SIGMAS standard deviations of the figure.
#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "test/host/filter/small_site.hpp"
#include "test/support/numerical_jacobian.hpp"

namespace groma::filter {
namespace {

using test::Random;

constexpr model::PlanarPose kStart{1.0, -2.0, 0.4};
constexpr double kStartSigma_m = 0.1;
constexpr double kStartSigma_rad = 0.05;
constexpr double kScaleSigma = 0.01;
constexpr double kYawRateBiasSigma_radps = 0.001;
constexpr double kLeverArmSigma_m = 0.01;
constexpr model::OdometryNoise kNoise{0.03, 0.03, 0.01};

std::uint64_t seed_of(const char* name, std::uint64_t otherwise) {
  const char* text = std::getenv(name);
  return text != nullptr ? std::stoull(text) : otherwise;
}

model::Calibration twelve_anchors() {
  return testing::calibration_of({{4, {-14.0, -12.0, 2.8}},
                                  {5, {-13.0, 1.0, 3.1}},
                                  {6, {-12.0, 13.0, 2.4}},
                                  {7, {-4.0, 16.0, 3.2}},
                                  {8, {3.0, 15.0, 0.7}},
                                  {9, {12.0, 14.0, 2.9}},
                                  {10, {15.0, 4.0, 1.2}},
                                  {11, {14.0, -6.0, 3.3}},
                                  {12, {11.0, -15.0, 2.6}},
                                  {13, {3.0, -17.0, 0.9}},
                                  {14, {-5.0, -15.0, 3.0}},
                                  {15, {0.0, 6.0, 5.5}}});
}

// Posterior Cramer-Rao bound of the pose, with the priors of pose, odometry errors and site, linearized about
// the truth. Independent of the filter's code: the derivatives are finite differences of the simulator's
// motion and of the distance.
class Bound {
 public:
  Bound(const model::Surface& surface, const model::Calibration& calibration)
      : surface_(surface), calibration_(calibration), tags_(testing::three_tags()) {
    const auto anchors = static_cast<Eigen::Index>(calibration.anchors.size());
    lever_arms_ = kOdometry + anchors * kAnchor;
    frame_ = lever_arms_ + 9;
    covariance_.setZero(frame_ + 4, frame_ + 4);
    covariance_.diagonal().head<kOdometry>() << std::pow(kStartSigma_m, 2), std::pow(kStartSigma_m, 2),
        std::pow(kStartSigma_rad, 2), std::pow(kScaleSigma, 2), std::pow(kYawRateBiasSigma_radps, 2), 0.0,
        0.0, 0.0;
    for (Eigen::Index i = 0; i < anchors; ++i) {
      covariance_.block<kAnchor, kAnchor>(kOdometry + i * kAnchor, kOdometry + i * kAnchor) =
          model::own_covariance(calibration.anchors[static_cast<std::size_t>(i)],
                                calibration.common_frame_covariance);
    }
    covariance_.diagonal().segment<9>(lever_arms_).setConstant(std::pow(kLeverArmSigma_m, 2));
    covariance_.bottomRightCorner<4, 4>() = calibration.common_frame_covariance;
  }

  // Next odometry sample: its errors are independent.
  void begin_row() {
    covariance_.middleRows<3>(kRow).setZero();
    covariance_.middleCols<3>(kRow).setZero();
    covariance_.diagonal().segment<3>(kRow) << std::pow(kNoise.sigma_vx_mps, 2),
        std::pow(kNoise.sigma_vy_mps, 2), std::pow(kNoise.sigma_omega_radps, 2);
  }

  // Propagates from the true pose at the true velocity; row: the odometry sample.
  void drive(const model::PlanarPose& from, const Eigen::Vector3d& velocity, const model::OdometrySample& row,
             double dt_s) {
    const auto to = [&](const Eigen::VectorXd& error) -> Eigen::VectorXd {
      const Eigen::Vector3d there =
          velocity + Eigen::Vector3d(error(3) * row.vx_mps - error(5), error(3) * row.vy_mps - error(6),
                                     -error(4) - error(7));
      const model::PlanarPose end = testing::integrate(
          surface_,
          {.x_m = from.x_m + error(0), .y_m = from.y_m + error(1), .theta_rad = from.theta_rad + error(2)},
          there, dt_s, 1);
      return Eigen::Vector3d(end.x_m, end.y_m, end.theta_rad);
    };
    const Eigen::MatrixXd by_error = test::numerical_jacobian(to, Eigen::VectorXd::Zero(kOdometry));
    const Eigen::MatrixXd rows = by_error * covariance_.topRows<kOdometry>();
    const Eigen::Matrix3d corner = rows.leftCols<kOdometry>() * by_error.transpose();
    covariance_.topRows<3>() = rows;
    covariance_.leftCols<3>() = rows.transpose();
    covariance_.topLeftCorner<3, 3>() = corner;
  }

  // Update by a LOS range at the true pose.
  void measure(const model::PlanarPose& pose, std::size_t anchor, std::size_t tag, double sigma_m) {
    const auto a = static_cast<Eigen::Index>(anchor);
    const auto j = static_cast<Eigen::Index>(tag);
    const Eigen::Vector3d anchor_m = calibration_.anchors[anchor].position_m;
    const auto antenna_m = [&](const Eigen::VectorXd& at) -> Eigen::VectorXd {
      const model::SurfacePoint ground = surface_.at(at(0), at(1));
      const Eigen::Vector3d normal =
          Eigen::Vector3d(-ground.gradient.x(), -ground.gradient.y(), 1.0).normalized();
      const Eigen::Quaterniond tilt = Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), normal) *
                                      Eigen::AngleAxisd(at(2), Eigen::Vector3d::UnitZ());
      return Eigen::Vector3d(at(0), at(1), ground.z_m) + tilt * Eigen::Vector3d(at.tail<3>());
    };
    Eigen::VectorXd at(6);
    at << pose.x_m, pose.y_m, pose.theta_rad, tags_[tag].lever_arm_m;
    const Eigen::Vector3d separation = antenna_m(at) - anchor_m;
    const Eigen::RowVector3d direction = separation.normalized().transpose();
    const Eigen::RowVectorXd by_body = direction * test::numerical_jacobian(antenna_m, at);
    Eigen::VectorXd h = Eigen::VectorXd::Zero(covariance_.rows());
    h.head<3>() = by_body.head<3>();
    h.segment<3>(lever_arms_ + 3 * j) = by_body.tail<3>();
    h.segment<3>(kOdometry + a * kAnchor) = -direction;
    h(kOdometry + a * kAnchor + 3 + j) = 1.0;
    h(kOdometry + a * kAnchor + 6 + j) = separation.norm();
    h.segment<3>(frame_) = -direction;
    h(frame_ + 3) = -direction.dot(Eigen::RowVector3d(-anchor_m.y(), anchor_m.x(), 0.0));
    const Eigen::VectorXd response = covariance_ * h;
    covariance_.noalias() -= response * (response / (h.dot(response) + sigma_m * sigma_m)).transpose();
  }

  [[nodiscard]] double position_m2() const { return covariance_(0, 0) + covariance_(1, 1); }
  [[nodiscard]] double heading_rad2() const { return covariance_(2, 2); }

 private:
  static constexpr Eigen::Index kRow = 5;  // after x, y, theta, scale, yaw-rate bias: the sample's errors
  static constexpr Eigen::Index kOdometry = 8;
  static constexpr Eigen::Index kAnchor = model::anchor_size(3);

  const model::Surface& surface_;
  const model::Calibration& calibration_;
  std::vector<model::Tag> tags_;
  Eigen::Index lever_arms_ = 0;
  Eigen::Index frame_ = 0;
  Eigen::MatrixXd covariance_;
};

constexpr std::size_t kAhead = 4;  // 0.2 s

struct Campaign {
  int runs = 0;
  double nees = 0.0;  // sum
  int inside_95 = 0;
  double nis = 0.0;  // sum over runs, of one range each
  std::size_t used = 0;
  std::size_t gated = 0;
  double square_m2 = 0.0;
  double square_rad2 = 0.0;
  double bound_m2 = 0.0;
  double bound_rad2 = 0.0;
  // The same instant, predicted from kAhead odometry samples before it.
  double predicted_nees = 0.0;
  int predicted_inside_95 = 0;
  double predicted_square_m2 = 0.0;

  [[nodiscard]] double position_over_bound() const { return std::sqrt(square_m2 / bound_m2); }
  [[nodiscard]] double heading_over_bound() const { return std::sqrt(square_rad2 / bound_rad2); }
};

// Half width of the 99 % interval of chi-square divided by its degrees of freedom.
double band(double degrees) {
  return 2.576 * std::sqrt(2.0 / degrees);
}

double square_m2(const Estimate& estimate, const model::PlanarPose& truth) {
  return std::pow(estimate.pose.x_m - truth.x_m, 2) + std::pow(estimate.pose.y_m - truth.y_m, 2);
}

Campaign run(Model model) {
  const model::Calibration calibration = twelve_anchors();
  Config config;
  config.model = model;
  config.odometry = kNoise;
  config.scale_sigma = kScaleSigma;
  config.yaw_rate_bias_radps = kYawRateBiasSigma_radps;
  config.lever_arm_sigma_m = kLeverArmSigma_m;
  const testing::DriveOptions options{.duration_s = 30.0,
                                      .range_s = 0.01,
                                      .scale_sigma = kScaleSigma,
                                      .yaw_rate_bias_sigma_radps = kYawRateBiasSigma_radps,
                                      .range_sigma_m = config.range_sigma_m,
                                      .lever_arm_sigma_m = kLeverArmSigma_m,
                                      .noise = kNoise};
  Campaign out;
  const std::uint64_t last = seed_of("GROMA_LAST_SEED", GROMA_LAST_SEED);
  for (std::uint64_t seed = seed_of("GROMA_FIRST_SEED", GROMA_FIRST_SEED); seed <= last; ++seed) {
    Random random(0x6772'6f6d'6100 + seed);
    const model::Surface surface = testing::hills(0.2);
    const testing::Drive drive = testing::drive(surface, calibration, kStart, options, random);
    Filter filter(surface, testing::three_tags(), calibration, config);
    filter.process(drive.odometry.front());
    filter.start({.t_s = 0.0,
                  .pose = {kStart.x_m + kStartSigma_m * random.gaussian(),
                           kStart.y_m + kStartSigma_m * random.gaussian(),
                           kStart.theta_rad + kStartSigma_rad * random.gaussian()},
                  .position_sigma_m = kStartSigma_m,
                  .heading_sigma_rad = kStartSigma_rad});
    Bound bound(surface, calibration);
    const std::size_t instant =
        40 + static_cast<std::size_t>(random.uniform(0.0, static_cast<double>(drive.odometry.size() - 60)));
    std::size_t next = 0;
    double nis = 0.0;
    for (std::size_t row = 0; row < instant; ++row) {
      const model::OdometrySample& odometry = drive.odometry[row];
      if (row + kAhead == instant) {
        const auto first = drive.odometry.begin() + static_cast<std::ptrdiff_t>(row);
        const std::vector<MotionInput> ahead(first, first + kAhead + 1);
        const Estimate predicted = testing::predict(filter, ahead);
        const double error = testing::squared_error(predicted, drive.truth[instant]);
        out.predicted_nees += error;
        out.predicted_inside_95 += error <= 7.815 ? 1 : 0;
        out.predicted_square_m2 += square_m2(predicted, drive.truth[instant]);
      }
      if (row > 0) filter.process(odometry);
      bound.begin_row();
      const Eigen::Vector3d velocity = testing::true_velocity(odometry.t_s);
      model::PlanarPose at = drive.truth[row];
      double t_s = odometry.t_s;
      const auto go_to = [&](double until_s) {
        bound.drive(at, velocity, odometry, until_s - t_s);
        at = testing::integrate(surface, at, velocity, until_s - t_s, 2);
        t_s = until_s;
      };
      for (; next < drive.ranges.size() && drive.ranges[next].t_s < drive.odometry[row + 1].t_s; ++next) {
        const model::RangeSample& range = drive.ranges[next];
        const RangeResult result = filter.process(range);
        EXPECT_TRUE(result.outcome == RangeOutcome::kUsed || result.outcome == RangeOutcome::kGated);
        nis = result.nis;
        go_to(range.t_s);
        bound.measure(at, next % 12, next / 12 % 3, options.range_sigma_m);
      }
      go_to(drive.odometry[row + 1].t_s);
    }
    filter.advance_to(drive.odometry[instant].t_s);
    const Estimate estimate = filter.estimate();
    const model::PlanarPose& truth = drive.truth[instant];
    const double error = testing::squared_error(estimate, truth);
    ++out.runs;
    out.nees += error;
    out.inside_95 += error <= 7.815 ? 1 : 0;
    out.nis += nis;
    out.square_m2 += square_m2(estimate, truth);
    out.square_rad2 += std::pow(model::wrap_angle(estimate.pose.theta_rad - truth.theta_rad), 2);
    out.used += filter.counters().ranges[RangeOutcome::kUsed];
    out.gated += filter.counters().ranges[RangeOutcome::kGated];
    out.bound_m2 += bound.position_m2();
    out.bound_rad2 += bound.heading_rad2();
  }
  return out;
}

// Records a property of the test in the --gtest_output file.
void record(const char* name, double value) {
  ::testing::Test::RecordProperty(name, std::to_string(value));
}

class FilterCampaign : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(Models, FilterCampaign, ::testing::Values(Model::kSchmidt, Model::kJoint),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           return std::string(model_name(model.param));
                         });

TEST_P(FilterCampaign, IsConsistentAndNearTheCramerRaoBound) {
  const Campaign campaign = run(GetParam());
  const auto runs = static_cast<double>(campaign.runs);
  const double nees = campaign.nees / (3.0 * runs);
  const double inside = campaign.inside_95 / runs;
  record("runs", runs);
  record("nees", nees);
  record("inside_95", inside);
  record("nis", campaign.nis / runs);
  record("position_rmse_m", std::sqrt(campaign.square_m2 / runs));
  record("position_over_bound", campaign.position_over_bound());
  record("heading_rmse_rad", std::sqrt(campaign.square_rad2 / runs));
  record("heading_over_bound", campaign.heading_over_bound());
  record("predicted_nees", campaign.predicted_nees / (3.0 * runs));
  record("predicted_inside_95", campaign.predicted_inside_95 / runs);
  record("predicted_position_rmse_m", std::sqrt(campaign.predicted_square_m2 / runs));

  // All ranges are LOS: hardly any is gated.
  EXPECT_LE(1000 * campaign.gated, campaign.used);
  const double sigmas = GROMA_SAMPLING_SIGMAS;
  const double nees_luck = sigmas * std::sqrt(2.0 / (3.0 * runs));
  const double inside_luck = sigmas * std::sqrt(0.95 * 0.05 / runs);
  for (const double of : {nees, campaign.predicted_nees / (3.0 * runs)}) {
    EXPECT_GE(of, 0.90 - nees_luck);
    EXPECT_LE(of, 1.11 + nees_luck);
  }
  for (const double of : {inside, campaign.predicted_inside_95 / runs}) {
    EXPECT_GE(of, 0.922 - inside_luck);
    EXPECT_LE(of, 0.978 + inside_luck);
  }
  EXPECT_NEAR(campaign.nis / runs, 1.0, band(runs));
  if (GetParam() != Model::kJoint) return;
  EXPECT_LE(campaign.position_over_bound(), 1.1 + sigmas / std::sqrt(4.0 * runs));
  EXPECT_LE(campaign.heading_over_bound(), 1.1 + sigmas / std::sqrt(2.0 * runs));
  // Not below the bound, up to sampling error.
  EXPECT_GE(campaign.position_over_bound(), 1.0 - 4.0 / std::sqrt(4.0 * runs));
  EXPECT_GE(campaign.heading_over_bound(), 1.0 - 4.0 / std::sqrt(2.0 * runs));
}

}  // namespace
}  // namespace groma::filter
