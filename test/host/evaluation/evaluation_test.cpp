#include "host/evaluation/evaluation.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <vector>

namespace groma::evaluation {
namespace {

model::PlanarEstimate estimate_row(double t_s, double x_m, double y_m, double yaw_rad,
                                   const Eigen::Vector3d& variances = {1.0, 1.0, 1.0}) {
  return {t_s, x_m, y_m, yaw_rad, variances.asDiagonal()};
}

model::PoseSample pose(double t_s, double x_m, double y_m, double yaw_rad) {
  return {t_s, x_m, y_m, 0.0, yaw_rad};
}

// At 0.5 m/s, 50 rows per second; the pose repeats from row 40 for `rows_still` rows.
std::vector<model::PoseSample> halting(int rows_still, bool goes_on_meanwhile) {
  std::vector<model::PoseSample> out;
  double x_m = 0.0;
  for (int i = 0; i < 120; ++i) {
    const bool still = i >= 40 && i < 40 + rows_still;
    if (!still || goes_on_meanwhile) x_m += 0.01;
    out.push_back(pose(0.02 * i, still ? out.back().x_m : x_m, 1.0, 0.0));
  }
  return out;
}

TEST(EvaluationTest, FindsTruthThatRepeatsAPoseAndJumps) {
  const auto spans = frozen_spans(halting(20, true));
  ASSERT_EQ(spans.size(), 1U);
  EXPECT_NEAR(spans[0].from_s, 0.78, 1e-9);
  EXPECT_NEAR(spans[0].to_s, 1.18, 1e-9);
  EXPECT_NEAR(spans[0].jump_m, 0.21, 1e-9);
  // A robot that stops and moves off does not jump; one that is stationary for long may have been carried.
  EXPECT_TRUE(frozen_spans(halting(20, false)).empty());
  EXPECT_TRUE(frozen_spans(halting(70, true)).empty());
  EXPECT_TRUE(frozen_spans(halting(0, false)).empty());
  EXPECT_TRUE(frozen_spans({}).empty());
}

TEST(EvaluationTest, ByHand) {
  const std::array estimate{estimate_row(0.0, 3.0, 4.0, 0.1, {1.0, 4.0, 0.01}),
                            estimate_row(0.1, 0.0, 0.0, -0.2, {1.0, 1.0, 0.04})};
  const std::array truth{pose(0.0, 0.0, 0.0, 0.0), pose(0.1, 0.0, 0.0, 0.0)};
  const auto errors = pose_errors(estimate, truth);
  const auto result = evaluate(errors);
  ASSERT_TRUE(result);
  EXPECT_EQ(result->samples, 2U);
  EXPECT_DOUBLE_EQ(result->ate_m.max, 5.0);
  EXPECT_DOUBLE_EQ(result->ate_m.mean, 2.5);
  EXPECT_DOUBLE_EQ(result->ate_m.std, 2.5);
  EXPECT_DOUBLE_EQ(result->ate_m.rmse, std::sqrt(12.5));
  EXPECT_DOUBLE_EQ(result->ate_rad.mean, 0.15);
  EXPECT_DOUBLE_EQ(result->ate_rad.max, 0.2);
  // (9/1 + 16/4 + 0.01/0.01)/3 = 14/3, and (0.04/0.04)/3 = 1/3.
  ASSERT_TRUE(result->nees);
  EXPECT_NEAR(result->nees->max, 14.0 / 3.0, 1e-12);
  EXPECT_NEAR(result->nees->mean, 2.5, 1e-12);
  EXPECT_DOUBLE_EQ(result->nees->inside_95, 0.5);
}

TEST(EvaluationTest, TheBoundOf95PercentIsInside) {
  const std::array truth{pose(0.0, 0.0, 0.0, 0.0)};
  const std::array inside{estimate_row(0.0, std::sqrt(7.8149), 0.0, 0.0)};
  const std::array outside{estimate_row(0.0, std::sqrt(7.8151), 0.0, 0.0)};
  EXPECT_EQ(evaluate(pose_errors(inside, truth))->nees->inside_95, 1.0);
  EXPECT_EQ(evaluate(pose_errors(outside, truth))->nees->inside_95, 0.0);
}

TEST(EvaluationTest, InterpolatesThePoseAndTakesTheEarlierCovariance) {
  const std::array estimate{estimate_row(0.0, 0.0, 0.0, 0.0, {1.0, 1.0, 1.0}),
                            estimate_row(0.2, 2.0, -4.0, 0.4, {9.0, 9.0, 9.0})};
  const std::array truth{pose(0.05, 0.0, 0.0, 0.0)};
  const auto errors = pose_errors(estimate, truth);
  ASSERT_EQ(errors.size(), 1U);
  EXPECT_NEAR(errors[0].x_m, 0.5, 1e-12);
  EXPECT_NEAR(errors[0].y_m, -1.0, 1e-12);
  EXPECT_NEAR(errors[0].yaw_rad, 0.1, 1e-12);
  EXPECT_NEAR(*errors[0].nees, (0.25 + 1.0 + 0.01) / 3.0, 1e-12);
}

TEST(EvaluationTest, HeadingErrorsAreWrapped) {
  constexpr double kPi = std::numbers::pi;
  const std::array estimate{estimate_row(0.0, 0.0, 0.0, kPi - 0.1), estimate_row(0.2, 0.0, 0.0, -kPi + 0.1)};
  const std::array truth{pose(0.0, 0.0, 0.0, -kPi + 0.1), pose(0.1, 0.0, 0.0, -kPi),
                         pose(0.2, 0.0, 0.0, kPi - 0.2), pose(0.2, 0.0, 0.0, 3.0 * kPi + 0.2)};
  const auto errors = pose_errors(estimate, truth);
  ASSERT_EQ(errors.size(), 4U);
  EXPECT_NEAR(errors[0].yaw_rad, -0.2, 1e-12);
  EXPECT_NEAR(errors[1].yaw_rad, 0.0, 1e-12);
  EXPECT_NEAR(errors[2].yaw_rad, 0.3, 1e-12);
  EXPECT_NEAR(errors[3].yaw_rad, -0.1, 1e-12);
}

TEST(EvaluationTest, ScoresNothingInAGapOrOutside) {
  const std::array estimate{estimate_row(1.0, 0.0, 0.0, 0.0), estimate_row(1.25, 0.0, 0.0, 0.0),
                            estimate_row(1.75, 0.0, 0.0, 0.0), estimate_row(2.0, 0.0, 0.0, 0.0)};
  std::array<model::PoseSample, 8> truth{};
  const std::array<double, 8> times{0.9, 1.0, 1.1, 1.25, 1.5, 1.75, 2.0, 2.1};
  for (std::size_t i = 0; i < times.size(); ++i) truth.at(i).t_s = times.at(i);
  std::vector<double> scored;
  for (const PoseError& error : pose_errors(estimate, truth)) scored.push_back(error.t_s);
  EXPECT_EQ(scored, (std::vector{1.0, 1.1, 1.25, 1.75, 2.0})) << "not in the gap of 0.5 s, but at its ends";
}

TEST(EvaluationTest, ASingularCovarianceIsCountedAndExcluded) {
  const std::array estimate{estimate_row(0.0, 1.0, 0.0, 0.0),
                            estimate_row(0.1, 1.0, 0.0, 0.0, {0.0, 1.0, 1.0}),
                            estimate_row(0.2, 1.0, 0.0, 0.0, {-1.0, 1.0, 1.0})};
  const std::array truth{pose(0.0, 0.0, 0.0, 0.0), pose(0.1, 0.0, 0.0, 0.0), pose(0.2, 0.0, 0.0, 0.0)};
  const auto result = evaluate(pose_errors(estimate, truth));
  ASSERT_TRUE(result);
  EXPECT_EQ(result->samples, 3U);
  EXPECT_EQ(result->samples_without_covariance, 2U);
  EXPECT_EQ(result->ate_m.mean, 1.0);
  EXPECT_NEAR(result->nees->mean, 1.0 / 3.0, 1e-12);
  EXPECT_FALSE(evaluate(pose_errors(std::span(estimate).subspan(1), truth))->nees);
}

TEST(EvaluationTest, CoverageIsTheShareOfEitherInputThatIsScored) {
  std::vector<model::PlanarEstimate> estimate(100);  // 20 Hz, 5 s
  for (std::size_t i = 0; i < estimate.size(); ++i) estimate[i].t_s = 0.05 * static_cast<double>(i);
  const auto covered = [&](double from_s, double to_s, double step_s) {
    std::vector<model::PoseSample> truth;
    for (double t_s = from_s; t_s < to_s; t_s += step_s) truth.push_back({.t_s = t_s});
    return coverage(estimate, truth, pose_errors(estimate, truth));
  };
  const Coverage all = covered(0.0, 4.9, 0.1);
  EXPECT_EQ(all.estimate, 1.0);
  EXPECT_EQ(all.truth, 1.0);
  const Coverage slow = covered(0.0, 4.9, 1.0);
  EXPECT_EQ(slow.estimate, 1.0) << "a truth of 1 Hz scores the rows between";
  const Coverage short_truth = covered(1.0, 2.0, 0.1);
  EXPECT_NEAR(short_truth.estimate, 1.5 / 5.0, 0.02);
  EXPECT_EQ(short_truth.truth, 1.0);
  const Coverage long_truth = covered(-5.0, 15.0, 0.1);
  EXPECT_EQ(long_truth.estimate, 1.0);
  EXPECT_NEAR(long_truth.truth, 0.25, 0.01);
  EXPECT_EQ(covered(10.0, 12.0, 0.1).estimate, 0.0);
}

TEST(EvaluationTest, DisjointTimesGiveNoResult) {
  const std::array estimate{estimate_row(0.0, 1.0, 0.0, 0.0)};
  const std::array truth{pose(5.0, 0.0, 0.0, 0.0)};
  EXPECT_FALSE(evaluate(pose_errors(estimate, truth)));
  EXPECT_FALSE(evaluate(pose_errors({}, truth)));
  EXPECT_FALSE(evaluate({}));
}

// Independent implementation of the contract's definitions, by linear search and Cramer's rule.
struct Reference {
  double ate_sum = 0.0;
  double yaw_sum = 0.0;
  double nees_sum = 0.0;
  double nees_max = 0.0;
  int inside = 0;
  int samples = 0;
};

double determinant(const std::array<std::array<double, 3>, 3>& m) {
  return m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) -
         m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
         m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
}

Reference reference(const std::vector<model::PlanarEstimate>& estimate,
                    const std::vector<model::PoseSample>& truth) {
  Reference reference;
  for (const model::PoseSample& p : truth) {
    for (std::size_t i = 0; i + 1 < estimate.size(); ++i) {
      const model::PlanarEstimate& a = estimate[i];
      const model::PlanarEstimate& b = estimate[i + 1];
      if (!(a.t_s <= p.t_s && p.t_s < b.t_s) || b.t_s - a.t_s > 0.3) continue;
      const double w = (p.t_s - a.t_s) / (b.t_s - a.t_s);
      const double turn = std::atan2(std::sin(b.yaw_rad - a.yaw_rad), std::cos(b.yaw_rad - a.yaw_rad));
      const double yaw = a.yaw_rad + w * turn - p.yaw_rad;
      const std::array<double, 3> e{(1.0 - w) * a.x_m + w * b.x_m - p.x_m,
                                    (1.0 - w) * a.y_m + w * b.y_m - p.y_m,
                                    std::atan2(std::sin(yaw), std::cos(yaw))};
      std::array<std::array<double, 3>, 3> m{};
      for (std::size_t r = 0; r < 3; ++r) {
        for (std::size_t c = 0; c < 3; ++c)
          m.at(r).at(c) = a.covariance(static_cast<int>(r), static_cast<int>(c));
      }
      double product = 0.0;
      for (std::size_t k = 0; k < 3; ++k) {
        auto replaced = m;
        for (std::size_t r = 0; r < 3; ++r) replaced.at(r).at(k) = e.at(r);
        product += e.at(k) * determinant(replaced) / determinant(m);
      }
      reference.ate_sum += std::sqrt(e[0] * e[0] + e[1] * e[1]);
      reference.yaw_sum += std::abs(e[2]);
      reference.nees_sum += product / 3.0;
      reference.nees_max = std::max(reference.nees_max, product / 3.0);
      reference.inside += product <= 7.815 ? 1 : 0;
      ++reference.samples;
    }
  }
  return reference;
}

TEST(EvaluationTest, AgreesWithAnIndependentImplementation) {
  std::uint32_t state = 12345;
  const auto uniform = [&] {
    state = 1664525U * state + 1013904223U;
    return static_cast<double>(state >> 8U) / 16777216.0;
  };
  for (int run = 0; run < 20; ++run) {
    std::vector<model::PlanarEstimate> estimate;
    double t_s = 0.0;
    for (int i = 0; i < 200; ++i) {
      t_s += 0.01 + 0.4 * uniform() * uniform();
      model::PlanarEstimate row{t_s, 4.0 * uniform(), 4.0 * uniform(), 6.28 * uniform() - 3.14};
      Eigen::Matrix3d root;
      for (int k = 0; k < 9; ++k) root(k / 3, k % 3) = uniform() - 0.5;
      row.covariance = root * root.transpose() + 0.05 * Eigen::Matrix3d::Identity();
      estimate.push_back(row);
    }
    std::vector<model::PoseSample> truth;
    double time_s = 0.003;
    while (time_s < t_s + 1.0) {
      truth.push_back({time_s, 4.0 * uniform(), 4.0 * uniform(), 0.0, 6.28 * uniform() - 3.14});
      time_s += 0.02 + 0.1 * uniform();
    }
    const auto result = evaluate(pose_errors(estimate, truth));
    const Reference expected = reference(estimate, truth);
    ASSERT_TRUE(result);
    ASSERT_EQ(result->samples, static_cast<std::size_t>(expected.samples));
    ASSERT_EQ(result->samples_without_covariance, 0U);
    EXPECT_NEAR(result->ate_m.mean, expected.ate_sum / expected.samples, 1e-9);
    EXPECT_NEAR(result->ate_rad.mean, expected.yaw_sum / expected.samples, 1e-9);
    EXPECT_NEAR(result->nees->mean, expected.nees_sum / expected.samples, 1e-9 * expected.nees_sum);
    EXPECT_NEAR(result->nees->max, expected.nees_max, 1e-7 * expected.nees_max);
    EXPECT_DOUBLE_EQ(result->nees->inside_95, static_cast<double>(expected.inside) / expected.samples);
  }
}

}  // namespace
}  // namespace groma::evaluation
