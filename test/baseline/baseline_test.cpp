// The methods on a small simulated drive, their Jacobians, and an independent solution.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "host/evaluation/evaluation.hpp"
#include "test/baseline/drive.hpp"
#include "test/baseline/graph.hpp"
#include "test/baseline/graph_factors.hpp"
#include "test/baseline/kalman.hpp"
#include "test/baseline/method.hpp"
#include "test/support/numerical_jacobian.hpp"
#include "test/support/small_run.hpp"

namespace groma::baseline {
namespace {

// A surface with slopes, so that no derivative vanishes.
model::Surface hills() {
  const model::BSpline::Grid grid{.x0_m = -10.0, .y0_m = -10.0, .dx_m = 2.0, .dy_m = 2.0, .nx = 14, .ny = 13};
  std::vector<double> heights(static_cast<std::size_t>(grid.nx * grid.ny));
  for (std::size_t i = 0; i < heights.size(); ++i) heights[i] = 0.4 * std::sin(1.7 * static_cast<double>(i));
  return model::BSpline(grid, heights);
}

// Positions and biases off by what the covariance says, drawn by `seed`; 0: exact.
model::Calibration calibration_of(const io::Dataset& run, std::uint64_t seed) {
  model::RangePriors priors;
  priors.beta_m = {0.0, 0.03};
  priors.gamma = {1.0, 1e-3};
  model::Calibration calibration = model::surveyed_calibration(run.surveyed_anchors, run.tags, priors, 0.05);
  test::SmallNoise noise(seed);
  for (model::AnchorCalibration& anchor : calibration.anchors) {
    for (double& value : anchor.position_m) value += seed == 0 ? 0.0 : 0.05 * noise();
    for (model::PairBias& pair : anchor.pairs)
      pair.beta_m = test::small_run_beta_m(pair.tag_id, anchor.id) + (seed == 0 ? 0.0 : 0.03 * noise());
  }
  return calibration;
}

// A drive with all that it refers to.
struct Scene {
  explicit Scene(double duration_s, std::uint64_t seed = 0)
      : run(test::make_small_run(duration_s, 5)),
        calibration(calibration_of(run, seed)),
        site(run.tags, calibration),
        drive(*make_drive(run, run.surface, site, calibration, {})) {}

  io::Dataset run;
  model::Calibration calibration;
  Site site;
  Drive drive;
};

Outcome outcome_of(const Drive& drive, std::string_view name, bool tuned = false, std::uint64_t seed = 1) {
  const MethodInfo& method = *find_method(name);
  const auto made = method.make(drive, tuned ? method.tuned : method.plain, seed);
  return run(drive, *made);
}

evaluation::Evaluation scored(const Outcome& outcome, const Scene& scene) {
  return *evaluation::evaluate(evaluation::pose_errors(outcome.rows, scene.run.ground_truth));
}

void expect_same(const std::vector<model::PlanarEstimate>& a, const std::vector<model::PlanarEstimate>& b) {
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    ASSERT_EQ(a[i].x_m, b[i].x_m) << i;
    ASSERT_EQ(a[i].y_m, b[i].y_m) << i;
    ASSERT_EQ(a[i].yaw_rad, b[i].yaw_rad) << i;
    ASSERT_EQ(a[i].covariance, b[i].covariance) << i;
  }
}

// d' P^-1 d / 3 of the difference of two estimates, P of the first.
double distance(const model::PlanarEstimate& a, const model::PlanarEstimate& b) {
  const Eigen::Vector3d d(a.x_m - b.x_m, a.y_m - b.y_m, model::wrap_angle(a.yaw_rad - b.yaw_rad));
  return d.dot(a.covariance.ldlt().solve(d)) / 3.0;
}

TEST(Motion, JacobiansAreTheNumericalOnes) {
  const model::Surface surface = hills();
  const Eigen::Vector3d velocity(1.2, -0.4, 0.7);
  constexpr double kStep_s = 0.1;
  const auto by_all = [&](const Eigen::VectorXd& at) -> Eigen::VectorXd {
    const Step moved = step(surface, {at(0), at(1), at(2)}, at.tail<3>(), kStep_s);
    return Eigen::Vector3d(moved.pose.x_m, moved.pose.y_m, moved.pose.theta_rad);
  };
  Eigen::VectorXd at(6);
  at << 1.3, -2.1, 0.6, velocity;
  const Step moved = step(surface, {1.3, -2.1, 0.6}, velocity, kStep_s);
  const Eigen::MatrixXd numerical = test::numerical_jacobian(by_all, at);
  EXPECT_LT((moved.by_pose - numerical.leftCols<3>()).cwiseAbs().maxCoeff(), 1e-8);
  EXPECT_LT((moved.by_velocity - numerical.rightCols<3>()).cwiseAbs().maxCoeff(), 1e-8);
  const Eigen::Matrix3d change = moved.by_pose - Eigen::Matrix3d::Identity();
  EXPECT_GT((change.topLeftCorner<2, 2>().cwiseAbs().maxCoeff()), 1e-4);
}

TEST(Motion, FollowsACircleOnAPlane) {
  const model::Surface plane;
  model::PlanarPose pose;
  constexpr int kSteps = 400;
  for (int i = 0; i < kSteps; ++i) pose = step(plane, pose, {1.0, 0.0, 0.5}, 0.01).pose;
  EXPECT_NEAR(pose.x_m, 2.0 * std::sin(2.0), 1e-4);
  EXPECT_NEAR(pose.y_m, 2.0 * (1.0 - std::cos(2.0)), 1e-4);
  EXPECT_NEAR(pose.theta_rad, 2.0, 1e-9);
}

Pair pair_of(std::size_t seed) {
  Pair pair{.anchor_m = {8.0, 5.0, 2.5}, .terms = {0.3, 1.004}, .lever_arm_m = {0.7, -0.3, 1.4}};
  test::SmallNoise noise(seed);
  PairMatrix root;
  for (double& value : root.reshaped()) value = 0.05 * noise();
  pair.covariance = root * root.transpose();
  return pair;
}

TEST(RangePrediction, JacobiansAndCalibrationVarianceAreTheNumericalOnes) {
  const model::Surface surface = hills();
  const Pair pair = pair_of(3);
  for (const RangeModel model : {RangeModel::kPure, RangeModel::kBiased}) {
    const auto by_all = [&](const Eigen::VectorXd& at) -> Eigen::VectorXd {
      Pair other = pair;
      other.lever_arm_m = at.segment<3>(6);
      other.terms = at.tail<2>();
      return Eigen::VectorXd::Constant(
          1, predict(model, surface, {at(0), at(1), at(2)}, other, at.segment<3>(3)).range_m);
    };
    Eigen::VectorXd at(11);
    at << 1.3, -2.1, 0.6, pair.anchor_m, pair.lever_arm_m, pair.terms;
    const Eigen::RowVectorXd numerical = test::numerical_jacobian(by_all, at);
    const Prediction predicted = predict(model, surface, {1.3, -2.1, 0.6}, pair, pair.anchor_m);
    EXPECT_LT((predicted.by_pose - numerical.head<3>()).cwiseAbs().maxCoeff(), 1e-8);
    EXPECT_LT((predicted.by_anchor - numerical.segment<3>(3)).cwiseAbs().maxCoeff(), 1e-8);
    if (model == RangeModel::kPure) {
      EXPECT_EQ(predicted.calibration_variance_m2, 0.0);
      continue;
    }
    Eigen::RowVectorXd by_pair(5);
    by_pair << numerical.segment<3>(3), numerical.tail<2>();
    const double lever_arm_m2 = 1e-4 * numerical.segment<3>(6).squaredNorm();
    EXPECT_NEAR(predicted.calibration_variance_m2,
                (by_pair * pair.covariance * by_pair.transpose()).value() + lever_arm_m2, 1e-9);
    EXPECT_NEAR(
        predicted.other_variance_m2,
        (numerical.tail<2>() * pair.covariance.bottomRightCorner<2, 2>() * numerical.tail<2>().transpose())
                .value() +
            lever_arm_m2,
        1e-9);
  }
}

// Each block's Jacobian against central differences.
void expect_numerical(const ceres::CostFunction& cost, std::vector<Eigen::VectorXd> at) {
  const auto evaluate = [&](double** jacobians) {
    std::vector<const double*> blocks(at.size());
    std::transform(at.begin(), at.end(), blocks.begin(),
                   [](const Eigen::VectorXd& block) { return block.data(); });
    Eigen::VectorXd residual(cost.num_residuals());
    EXPECT_TRUE(cost.Evaluate(blocks.data(), residual.data(), jacobians));
    return residual;
  };
  std::vector<RowMajor> analytical(at.size());
  std::vector<double*> pointers(at.size());
  for (std::size_t i = 0; i < at.size(); ++i) {
    analytical[i].resize(cost.num_residuals(), at[i].size());
    pointers[i] = analytical[i].data();
  }
  evaluate(pointers.data());
  for (std::size_t i = 0; i < at.size(); ++i) {
    const Eigen::VectorXd begin = at[i];
    const auto by_block = [&](const Eigen::VectorXd& value) -> Eigen::VectorXd {
      at[i] = value;
      return evaluate(nullptr);
    };
    const Eigen::MatrixXd numerical = test::numerical_jacobian(by_block, begin);
    at[i] = begin;
    EXPECT_LT((analytical[i] - numerical).cwiseAbs().maxCoeff(),
              1e-6 * (1.0 + numerical.cwiseAbs().maxCoeff()))
        << "block " << i;
    EXPECT_GT(numerical.cwiseAbs().maxCoeff(), 0.0) << "block " << i;
  }
}

Increment some_increment() {
  Increment out;
  out.moved << 0.3, -0.05, 0.1;
  out.by_bias << 0.01, -0.02;
  out.passed_s = 0.2;
  out.velocity << 1.5, -0.2, 0.5;
  out.covariance << 1e-4, 1e-5, 0.0, 1e-5, 2e-4, 1e-5, 0.0, 1e-5, 4e-4;
  return out;
}

Eigen::VectorXd some(Eigen::Index size, double scale) {
  return scale * Eigen::VectorXd::LinSpaced(size, -1.0, 1.5);
}

TEST(GraphFactors, JacobiansAreTheNumericalOnes) {
  const model::Surface surface = hills();
  const Pair pair = pair_of(4);
  const PairModel of{.pair = &pair,
                     .root = pair.covariance.llt().matrixL().toDenseMatrix() * Eigen::MatrixXd::Ones(5, 7),
                     .frame_root = 0.03 * model::position_by_frame(pair.anchor_m)};
  const Eigen::Vector3d pose(1.3, -2.1, 0.6);
  const Eigen::Vector3d odometry(0.02, 0.01, 0.03);
  const RangeCost range(surface, 0, 0, of, some_increment(), 9.0, 0.08, 0.04);
  expect_numerical(range, {pose, odometry, some(7, 0.2), some(3, 1.0), some(4, 0.7), some(1, 1.0)});
  const OdometryCost moved(surface, 0, 0, some_increment());
  // The delay is no unknown of this factor: its column is zero, which the last check would refuse.
  const Eigen::Vector3d next = pose + Eigen::Vector3d(0.31, 0.12, 0.11);
  expect_numerical(moved, {pose, next, odometry});
  Eigen::MatrixXd root = Eigen::MatrixXd::Random(5, 5);
  expect_numerical(LinearCost({2, 3}, root, some(5, 1.0), some(5, 0.1)), {some(2, 0.4), some(3, 0.2)});
}

// The maximum a posteriori poses by dense Gauss-Newton with numerical derivatives, independent of the
// filters' code: distances are written out, the drive is flat.
TEST(PaperFilter, AgreesWithADenseBatchSolution) {
  Scene scene(3.0);
  Drive& drive = scene.drive;
  // Ranges at the times of odometry samples only, so that both have the same poses.
  std::vector<Range> at_samples;
  for (Range range : drive.ranges) {
    const auto next =
        std::find_if(drive.odometry.begin(), drive.odometry.end(),
                     [&](const model::OdometrySample& sample) { return sample.t_s >= range.t_s - 1e-9; });
    if (next == drive.odometry.end() || std::abs(next->t_s - range.t_s) > 1e-6) continue;
    range.t_s = next->t_s;
    at_samples.push_back(range);
  }
  ASSERT_GT(at_samples.size(), 50U);
  drive.ranges = at_samples;

  const Eigen::Index poses = std::ssize(drive.odometry);
  const auto residuals = [&](const Eigen::VectorXd& x) -> Eigen::VectorXd {
    std::vector<double> out{(x(0) - drive.start.pose.x_m) / 0.1, (x(1) - drive.start.pose.y_m) / 0.1,
                            (x(2) - drive.start.pose.theta_rad) / 0.05};
    for (Eigen::Index k = 0; k + 1 < poses; ++k) {
      const auto& sample = drive.odometry[static_cast<std::size_t>(k)];
      const double dt = drive.odometry[static_cast<std::size_t>(k + 1)].t_s - sample.t_s;
      const Eigen::Vector3d from = x.segment<3>(3 * k);
      const Eigen::Vector3d to = x.segment<3>(3 * k + 3);
      const double middle = from.z() + 0.5 * (to.z() - from.z());
      const double vx =
          (std::cos(middle) * (to.x() - from.x()) + std::sin(middle) * (to.y() - from.y())) / dt;
      const double vy =
          (std::cos(middle) * (to.y() - from.y()) - std::sin(middle) * (to.x() - from.x())) / dt;
      out.push_back((vx - sample.vx_mps) / drive.odometry_noise.sigma_vx_mps);
      out.push_back((vy - sample.vy_mps) / drive.odometry_noise.sigma_vy_mps);
      out.push_back(((to.z() - from.z()) / dt - sample.omega_radps) / drive.odometry_noise.sigma_omega_radps);
    }
    for (const Range& range : drive.ranges) {
      Eigen::Index k = 0;
      while (drive.odometry[static_cast<std::size_t>(k)].t_s < range.t_s) ++k;
      const Eigen::Vector3d pose = x.segment<3>(3 * k);
      const Eigen::Vector3d& arm = range.pair->lever_arm_m;
      const Eigen::Vector3d antenna(pose.x() + std::cos(pose.z()) * arm.x() - std::sin(pose.z()) * arm.y(),
                                    pose.y() + std::sin(pose.z()) * arm.x() + std::cos(pose.z()) * arm.y(),
                                    0.25 + arm.z());
      out.push_back(((antenna - range.pair->anchor_m).norm() - range.range_m) / drive.range_sigma_m);
    }
    return Eigen::Map<Eigen::VectorXd>(out.data(), std::ssize(out));
  };
  // Pure ranges, without biases.
  for (Range& range : drive.ranges)
    range.range_m -= test::small_run_beta_m(scene.site.tags()[range.pair->tag].id,
                                            scene.site.anchors()[range.pair->anchor].id);
  PaperFilter filter(drive, {}, RangeModel::kPure);
  const Outcome outcome = run(drive, filter);
  Eigen::VectorXd x(3 * poses);
  for (Eigen::Index k = 0; k < poses; ++k) {
    const auto& row = outcome.rows[static_cast<std::size_t>(k)];
    x.segment<3>(3 * k) << row.x_m + 0.01, row.y_m - 0.01, row.yaw_rad;
  }
  Eigen::MatrixXd normal;
  for (int round = 0; round < 5; ++round) {
    const Eigen::MatrixXd jacobian = test::numerical_jacobian(residuals, x);
    normal = jacobian.transpose() * jacobian;
    x -= normal.ldlt().solve(jacobian.transpose() * residuals(x));
  }
  const Eigen::Matrix3d covariance =
      normal.ldlt().solve(Eigen::MatrixXd::Identity(3 * poses, 3 * poses)).bottomRightCorner<3, 3>();
  const model::PlanarEstimate& last = outcome.rows.back();
  const model::PlanarEstimate batch{last.t_s, x(3 * poses - 3), x(3 * poses - 2), x(3 * poses - 1),
                                    covariance};
  EXPECT_LT(distance(batch, last), 0.05);  // a fifth of a sigma
  EXPECT_LT((last.covariance - covariance).cwiseAbs().maxCoeff(), 0.05 * covariance.diagonal().maxCoeff());
}

class EachMethod : public testing::TestWithParam<const char*> {};

TEST_P(EachMethod, LocalizesASmallDrive) {
  const Scene scene(20.0, 7);
  const Outcome outcome = outcome_of(scene.drive, GetParam());
  const bool batch = std::string(GetParam()) == "ceres-batch";
  EXPECT_EQ(outcome.rows.size(), batch ? 19U : scene.run.odometry.size());
  EXPECT_EQ(outcome.ranges + outcome.rejected, scene.drive.ranges.size());
  const evaluation::Evaluation score = scored(outcome, scene);
  // Anchors are off by 0.05 m an axis. All but the factor graphs take their errors for white noise.
  const std::map<std::string, double> most_m{{"paper-odometry", 0.2}, {"paper-original", 0.6}};
  const auto found = most_m.find(GetParam());
  EXPECT_LT(score.ate_m.mean, found == most_m.end() ? 0.08 : found->second);
  EXPECT_EQ(score.samples_without_covariance, 0U);
  const bool keeps_correlations = std::string(GetParam()).starts_with("ceres");
  if (found == most_m.end()) EXPECT_LT(score.nees->mean, keeps_correlations ? 6.0 : 25.0);
}

TEST_P(EachMethod, GivesTheSameBytesAgain) {
  const Scene scene(4.0, 7);
  for (const bool tuned : {false, true})
    expect_same(outcome_of(scene.drive, GetParam(), tuned).rows,
                outcome_of(scene.drive, GetParam(), tuned).rows);
}

TEST_P(EachMethod, IsCausal) {
  const Scene scene(6.0, 7);
  Drive half = scene.drive;
  const double to_s = half.start.t_s + 3.0;
  std::erase_if(half.odometry, [&](const model::OdometrySample& sample) { return sample.t_s > to_s; });
  std::erase_if(half.ranges, [&](const Range& range) { return range.t_s > to_s; });
  std::vector<model::PlanarEstimate> whole = outcome_of(scene.drive, GetParam()).rows;
  std::erase_if(whole, [&](const model::PlanarEstimate& row) { return row.t_s > to_s; });
  expect_same(outcome_of(half, GetParam()).rows, whole);
}

INSTANTIATE_TEST_SUITE_P(All, EachMethod,
                         testing::Values("paper-odometry", "paper-original", "paper-adapted",
                                         "paper-anchor-states", "trilateration", "iterated-ekf",
                                         "particle-filter", "ceres-window", "ceres-batch"),
                         [](const auto& info) {
                           std::string name = info.param;
                           std::replace(name.begin(), name.end(), '-', '_');
                           return name;
                         });

TEST(Methods, AreAllTested) {
  EXPECT_EQ(methods().size(), 9U);
  EXPECT_EQ(find_method("joint"), nullptr);
}

TEST(ParticleFilter, DependsOnTheSeed) {
  const Scene scene(2.0);
  EXPECT_NE(outcome_of(scene.drive, "particle-filter", false, 1).rows.back().x_m,
            outcome_of(scene.drive, "particle-filter", false, 2).rows.back().x_m);
}

TEST(AnchorStates, ImproveAnAnchorThatIsFarOff) {
  Scene scene(20.0);
  // One anchor is off by 0.3 m and says so; the others are exact and say 5 cm.
  model::AnchorCalibration& anchor = scene.calibration.anchors[2];
  const Eigen::Vector3d truth = anchor.position_m;
  anchor.position_m.x() += 0.3;
  anchor.covariance(0, 0) = 0.09;
  const Site site(scene.run.tags, scene.calibration);
  const Drive drive = *make_drive(scene.run, scene.run.surface, site, scene.calibration, {});
  const Outcome outcome = outcome_of(drive, "paper-anchor-states");
  ASSERT_FALSE(outcome.anchors.empty());
  EXPECT_EQ(outcome.anchors.size() % 6, 0U);
  EXPECT_NEAR((outcome.anchors[2].position_m - truth).norm(), 0.3, 0.1);
  EXPECT_LT((outcome.anchors[outcome.anchors.size() - 4].position_m - truth).norm(), 0.15);
}

// Marginalization loses nothing but the linearization.
TEST(CeresWindow, AgreesWithTheBatch) {
  const Scene scene(20.0, 7);
  const std::vector<model::PlanarEstimate> batch = outcome_of(scene.drive, "ceres-batch").rows;
  for (const model::PlanarEstimate& row : outcome_of(scene.drive, "ceres-window").rows) {
    for (const model::PlanarEstimate& reference : batch) {
      if (reference.t_s != row.t_s) continue;
      EXPECT_LT(distance(reference, row), 0.05) << row.t_s;
      EXPECT_NEAR(row.covariance.trace() / reference.covariance.trace(), 1.0, 0.1) << row.t_s;
    }
  }
}

TEST(CeresBatch, KernelBoundsWhatNlosDoes) {
  Scene scene(10.0);
  for (std::size_t i = 0; i < scene.drive.ranges.size(); i += 8) scene.drive.ranges[i].range_m += 3.0;
  CeresBatch plain(scene.drive, {}, {9.0});
  CeresBatch robust(scene.drive, {.kernel = 1.0}, {9.0});
  const double plain_m = scored(run(scene.drive, plain), scene).ate_m.mean;
  const double robust_m = scored(run(scene.drive, robust), scene).ate_m.mean;
  EXPECT_LT(robust_m, 0.05);
  EXPECT_LT(robust_m, 0.5 * plain_m);
}

TEST(CeresBatch, HasARowAtTheSampleBeforeEachInstant) {
  const Scene scene(3.0);
  CeresBatch reference(scene.drive, {}, {1.0, 1.04, 2.0, 99.0, -5.0});
  const Outcome outcome = run(scene.drive, reference);
  ASSERT_EQ(outcome.rows.size(), 3U);
  EXPECT_NEAR(outcome.rows[0].t_s, 1.0, 1e-9);
  EXPECT_NEAR(outcome.rows[1].t_s, 2.0, 1e-9);
  EXPECT_EQ(outcome.rows[2].t_s, scene.drive.odometry.back().t_s);
}

// The calibration's slow range bias: with it the reference claims less.
TEST(CeresBatch, SlowBiasesWidenTheCovariance) {
  Scene scene(6.0);
  const Eigen::Matrix3d without = outcome_of(scene.drive, "ceres-batch").rows.back().covariance;
  scene.drive.range_noise.bias_sigma_m = 0.05;
  scene.drive.range_noise.bias_length_m = 1.0;
  const Eigen::Matrix3d with = outcome_of(scene.drive, "ceres-batch").rows.back().covariance;
  EXPECT_GT(with.trace(), 1.2 * without.trace());
  const Eigen::Matrix3d window = outcome_of(scene.drive, "ceres-window").rows.back().covariance;
  EXPECT_NEAR(window.trace() / with.trace(), 1.0, 0.3);
}

TEST(Gate, RejectsWhatIsFarOff) {
  Scene scene(5.0);
  for (std::size_t i = 0; i < scene.drive.ranges.size(); i += 10) scene.drive.ranges[i].range_m += 5.0;
  PaperFilter open(scene.drive, {}, RangeModel::kBiased);
  PaperFilter gated(scene.drive, {.gate = 4.0}, RangeModel::kBiased);
  const Outcome with = run(scene.drive, gated);
  EXPECT_NEAR(static_cast<double>(with.rejected), 0.1 * static_cast<double>(scene.drive.ranges.size()), 3.0);
  EXPECT_LT(scored(with, scene).ate_m.mean, 0.3 * scored(run(scene.drive, open), scene).ate_m.mean);
}

TEST(Drive, TakesWhatIsChosen) {
  Scene scene(5.0);
  DriveOptions options;
  options.from_s = 2.0;
  options.to_s = 4.0;
  options.tags = {2};
  options.anchors = {5, 6};
  const Drive drive = *make_drive(scene.run, scene.run.surface, scene.site, scene.calibration, options);
  EXPECT_EQ(drive.start.t_s, 2.0);
  EXPECT_EQ(drive.odometry.front().t_s, 2.0);
  EXPECT_LE(drive.odometry.back().t_s, 4.0);
  ASSERT_FALSE(drive.ranges.empty());
  for (const Range& range : drive.ranges) {
    EXPECT_GE(range.t_s, 2.0);
    EXPECT_LE(range.t_s, 4.0);
    EXPECT_EQ(scene.site.tags()[range.pair->tag].id, 2);
    EXPECT_TRUE(range.pair->anchor == 1 || range.pair->anchor == 2);
  }
  options.from_s = 100.0;
  options.to_s.reset();
  EXPECT_FALSE(make_drive(scene.run, scene.run.surface, scene.site, scene.calibration, options));
}

TEST(Drive, CountsRangesThatTheCalibrationLacks) {
  Scene scene(5.0);
  scene.calibration.anchors.pop_back();
  std::erase_if(scene.calibration.anchors[0].pairs,
                [](const model::PairBias& pair) { return pair.tag_id == 1; });
  scene.calibration.anchors[0].covariance = Eigen::MatrixXd::Identity(5, 5);
  const Site site(scene.run.tags, scene.calibration);
  const Drive drive = *make_drive(scene.run, scene.run.surface, site, scene.calibration, {});
  std::size_t unknown = 0;
  for (const model::RangeSample& range : scene.run.ranges) {
    if (range.t_s >= drive.start.t_s && (range.anchor_id == 9 || (range.anchor_id == 4 && range.tag_id == 1)))
      ++unknown;
  }
  EXPECT_GT(unknown, 0U);
  EXPECT_EQ(drive.unknown_ranges, unknown);
  EXPECT_EQ(drive.ranges.size() + unknown, scene.drive.ranges.size());
}

}  // namespace
}  // namespace groma::baseline
