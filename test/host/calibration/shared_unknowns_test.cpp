#include "host/calibration/shared_unknowns.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>

#include "host/calibration/drive_error.hpp"
#include "host/model/antenna_pattern.hpp"
#include "test/support/numerical_jacobian.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kSharingTags = 2;
constexpr double kFraction = 0.3;

// Range of a robot with these errors: from the definitions, not from the code's derivatives.
double range_with_errors(const Observation& row, const Eigen::Vector3d& anchor_m, double gamma,
                         const Eigen::VectorXd& error) {
  const auto at_range = [&](Eigen::Index axis) {
    return (1.0 - kFraction) * error(axis) + kFraction * error(axis + 3);
  };
  const Eigen::Quaterniond attitude = row.attitude.cast<double>().normalized();
  Eigen::Vector3d antenna_m = row.tag_m + attitude * error.segment<3>(7) - error(6) * row.velocity_mps;
  antenna_m += Eigen::Vector3d(at_range(0), at_range(1), 0.0);
  antenna_m.head<2>() += at_range(2) * row.yaw_arm_m;
  const Eigen::Vector3d to_anchor_m = anchor_m - antenna_m;
  const Eigen::Vector3d in_body = attitude.conjugate() * to_anchor_m.normalized();
  return gamma * to_anchor_m.norm() + model::pattern_terms(in_body).dot(error.tail<model::kPatternTerms>());
}

Observation random_row(test::Random& random) {
  Observation row;
  row.tag_m = 4.0 * random.gaussians(3);
  row.velocity_mps = random.gaussians(3);
  row.yaw_arm_m = random.gaussians(2);
  const Eigen::Vector4d draw = random.gaussians(4).normalized();
  row.attitude = Eigen::Quaterniond(draw(0), draw(1), draw(2), draw(3)).cast<float>();
  return row;
}

TEST(SharedUnknowns, JacobianIsTheDerivativeOfTheRange) {
  test::Random random(1);
  for (int i = 0; i < 20; ++i) {
    const Observation row = random_row(random);
    const Eigen::Vector3d anchor_m = 8.0 * random.gaussians(3);
    const double gamma = 1.0 + 0.01 * random.gaussian();
    const auto range = [&](const Eigen::VectorXd& error) {
      return Eigen::VectorXd::Constant(1, range_with_errors(row, anchor_m, gamma, error));
    };
    const Eigen::VectorXd expected =
        test::numerical_jacobian(range, Eigen::VectorXd::Zero(kSharedTerms)).transpose();
    const model::AntennaPrediction predicted =
        model::predict_antenna_range(row.tag_m, anchor_m, model::values_of({.gamma = gamma}));
    const SharedRow found = shared_jacobian(row, predicted, kFraction);
    EXPECT_LT((found - expected).cwiseAbs().maxCoeff(), 1e-6);
  }
}

TEST(SharedUnknowns, MoveRowRemovesTheError) {
  test::Random random(2);
  const SharedUnknowns unknowns{
      .knots = {.begin_s = 0.0, .spacing_s = 4.0, .count = 2}, .knot_scale = {}, .body_tags = 1};
  for (int i = 0; i < 20; ++i) {
    Observation row = random_row(random);
    row.t_s = kFraction * unknowns.knots.spacing_s;
    const Eigen::Vector3d anchor_m = 8.0 * random.gaussians(3);
    const Eigen::VectorXd error = 0.01 * random.gaussians(unknowns.size());
    row.range_m = range_with_errors(row, anchor_m, 1.0, error);
    move_row(unknowns, error, anchor_m, row);
    // The pattern is evaluated at the direction before the move: a second-order error.
    EXPECT_NEAR(row.range_m, (row.tag_m - anchor_m).norm(), 5e-4);
  }
}

TEST(SharedUnknowns, PriorOfTheKnotsIsAFirstOrderProcess) {
  const SharedUnknowns unknowns{
      .knots = {.begin_s = 0.0, .spacing_s = 3.0, .count = 5}, .knot_scale = {}, .body_tags = 1};
  const SharedPrior prior{.drift = {.sigma_m = 0.2, .sigma_yaw_rad = 0.01, .correlation_s = 7.0},
                          .delay_sigma_s = 0.03,
                          .body = true};
  const Eigen::MatrixXd information = prior_information(unknowns, prior);
  const Eigen::MatrixXd covariance = information.inverse();
  for (Eigen::Index i = 0; i < unknowns.knots.count; ++i) {
    for (Eigen::Index k = 0; k < unknowns.knots.count; ++k) {
      const double kept = std::exp(-3.0 * std::abs(static_cast<double>(i - k)) / 7.0);
      EXPECT_NEAR(covariance(3 * i, 3 * k), 0.04 * kept, 1e-9);
      EXPECT_NEAR(covariance(3 * i + 2, 3 * k + 2), 1e-4 * kept, 1e-12);
      EXPECT_NEAR(covariance(3 * i, 3 * k + 1), 0.0, 1e-12);
    }
  }
  EXPECT_NEAR(prior_log_determinant(unknowns, prior), std::log(information.determinant()), 1e-6);
  // A lever arm measured by hand.
  for (Eigen::Index axis = 0; axis < 3; ++axis) {
    const Eigen::Index at = unknowns.body(0) + axis;
    EXPECT_NEAR(covariance(at, at), 0.02 * 0.02, 1e-12);
  }
}

// The correlation of an oscillator driven by white noise obeys its equation of motion, starting at rest.
TEST(SharedUnknowns, SmoothDriftIsThatOfADrivenOscillator) {
  for (const double damping_ratio : {1.0, 0.6, 0.1, 0.03}) {
    const DriftPrior drift{
        .sigma_m = 1.0, .sigma_yaw_rad = 1.0, .correlation_s = 7.0, .damping_ratio = damping_ratio};
    constexpr double kStep_s = 1e-3;
    double correlation = 1.0;
    double rate = 0.0;
    for (int i = 0; i < 40'000; ++i) {
      if (i % 5000 == 0) {
        EXPECT_NEAR(drift_correlation(drift, -kStep_s * i), correlation, 1e-3) << damping_ratio << i;
      }
      rate += kStep_s * (-2.0 * damping_ratio / 7.0 * rate - correlation / 49.0);
      correlation += kStep_s * rate;
    }
  }
}

TEST(SharedUnknowns, PriorOfTheKnotsMayBeSmooth) {
  const SharedUnknowns unknowns{
      .knots = {.begin_s = 0.0, .spacing_s = 3.0, .count = 6}, .knot_scale = {}, .body_tags = 1};
  for (const double damping_ratio : {1.0, 0.1}) {
    const SharedPrior prior{.drift = {.sigma_m = 0.2,
                                      .sigma_yaw_rad = 0.01,
                                      .correlation_s = 7.0,
                                      .damping_ratio = damping_ratio},
                            .delay_sigma_s = 0.03,
                            .body = true};
    const Eigen::MatrixXd information = prior_information(unknowns, prior);
    const Eigen::MatrixXd covariance = information.inverse();
    for (Eigen::Index i = 0; i < unknowns.knots.count; ++i) {
      for (Eigen::Index k = 0; k < unknowns.knots.count; ++k) {
        const double kept = drift_correlation(prior.drift, 3.0 * static_cast<double>(i - k));
        EXPECT_NEAR(covariance(3 * i, 3 * k), 0.04 * kept, 1e-7);
        EXPECT_NEAR(covariance(3 * i + 2, 3 * k + 2), 1e-4 * kept, 1e-9);
        EXPECT_NEAR(covariance(3 * i, 3 * k + 1), 0.0, 1e-9);
      }
    }
    EXPECT_NEAR(prior_log_determinant(unknowns, prior), std::log(information.determinant()), 1e-5);
  }
}

// Reference: mean error variance of linear interpolation at many points between two knots.
TEST(SharedUnknowns, InterpolationMissesLessOfASmoothDrift) {
  const PoseQuality typical{.sigma_m = 0.3, .sigma_yaw_rad = 0.02};
  DriftPrior drift{.sigma_m = 0.3, .sigma_yaw_rad = 0.02, .correlation_s = 20.0};
  EXPECT_NEAR(white_share(drift, typical, 2.0), 2.0 / (3.0 * 20.0), 2e-3);
  drift.damping_ratio = 1.0;
  double missed = 0.0;
  constexpr int kPlaces = 1000;
  for (int i = 0; i < kPlaces; ++i) {
    const double f = (i + 0.5) / kPlaces;
    Eigen::Matrix3d covariance;  // of the first knot, the next, and the point between
    const Eigen::Vector3d at(0.0, 12.0, 12.0 * f);
    for (Eigen::Index a = 0; a < 3; ++a)
      for (Eigen::Index b = 0; b < 3; ++b) covariance(a, b) = drift_correlation(drift, at(a) - at(b));
    const Eigen::Vector3d off(1.0 - f, f, -1.0);
    missed += off.dot(covariance * off) / kPlaces;
  }
  EXPECT_NEAR(white_share(drift, typical, 12.0), missed, 0.02 * missed);
  EXPECT_LT(missed, 0.03);
}

TEST(SharedUnknowns, PriorOfTheKnotsFollowsThePosesCovariance) {
  test::Random random(4);
  SharedUnknowns unknowns{.knots = {.begin_s = 1.0, .spacing_s = 3.0, .count = 4}, .knot_scale = {}};
  std::vector<PoseSpread> spreads;
  std::vector<Eigen::Matrix3d> covariances;
  for (int k = 0; k < 3; ++k) {  // none near the last knot
    Eigen::Matrix3d root = Eigen::Vector3d(0.3, 0.3, 0.02).asDiagonal() * Eigen::Matrix3d::Identity();
    for (Eigen::Index axis = 0; axis < 3; ++axis) root.row(axis) *= 1.0 + 0.5 * random.uniform();
    root(1, 0) = 0.1 * random.gaussian();
    root(2, 0) = 0.01 * random.gaussian();
    covariances.emplace_back(root * root.transpose());
    for (const double share : {0.5, 1.5}) {
      spreads.push_back({.t_s = 1.0 + 3.0 * k + share - 1.0, .covariance = share * covariances.back()});
    }
  }
  const PoseQuality typical{.sigma_m = 0.3, .sigma_yaw_rad = 0.02};
  unknowns.knot_scale = scale_knots(unknowns.knots, spreads, typical);
  // Twice the typical sigmas: twice those that the poses report.
  const SharedPrior prior{.drift = {.sigma_m = 0.6, .sigma_yaw_rad = 0.04, .correlation_s = 7.0},
                          .delay_sigma_s = 0.03};
  const Eigen::MatrixXd information = prior_information(unknowns, prior);
  const Eigen::MatrixXd covariance = information.inverse();
  for (Eigen::Index k = 0; k < 3; ++k) {
    const Eigen::Matrix3d expected = 4.0 * covariances[static_cast<std::size_t>(k)];
    EXPECT_LT((covariance.block<3, 3>(3 * k, 3 * k) - expected).norm(), 1e-4 * expected.norm());
  }
  EXPECT_NEAR(covariance(9, 9), 0.36, 1e-6);
  EXPECT_NEAR(covariance(11, 11), 0.0016, 1e-8);
  // Correlation from knot to knot, in the scale of each.
  const Eigen::Matrix3d one = unknowns.knot_scale[1].inverse() * covariance.block<3, 3>(3, 6) *
                              unknowns.knot_scale[2].inverse().transpose();
  EXPECT_NEAR(one(0, 0), 0.36 * std::exp(-3.0 / 7.0), 1e-6);
  EXPECT_NEAR(one(2, 2), 0.0016 * std::exp(-3.0 / 7.0), 1e-8);
  EXPECT_NEAR(prior_log_determinant(unknowns, prior), std::log(information.determinant()), 1e-6);
}

TEST(SharedUnknowns, TypicalQualityIsTheMedian) {
  std::vector<PoseSpread> spreads;
  EXPECT_FALSE(typical_quality(spreads).has_value());
  for (const double sigma : {0.1, 0.2, 5.0}) {
    spreads.push_back({.t_s = 0.0, .covariance = sigma * sigma * Eigen::Matrix3d::Identity()});
  }
  EXPECT_NEAR(typical_quality(spreads)->sigma_m, 0.2, 1e-12);
  EXPECT_NEAR(typical_quality(spreads)->sigma_yaw_rad, 0.2, 1e-12);
}

// An anchor with one episode of long NLOS: a third of its ranges are in it, another third are long NLOS
// outside it.
AnchorLos los_of(std::size_t rows) {
  AnchorLos out;
  out.has_long_nlos = true;
  out.episodes = 1;
  out.long_nlos = RobustKernel(KernelShape{.scale_m = 0.15});
  for (std::size_t i = 0; i < rows; ++i) {
    RangeLos& row = out.rows.emplace_back();
    row = {.los = 0.3F, .long_nlos = 0.6F, .other_density = 0.05F, .episode = i % 3 == 0 ? 0 : kNoEpisode};
    if (i % 3 == 2) row = {};
  }
  return out;
}

// Reference: all anchors' and the shared unknowns in one dense system, range by range; one anchor has long
// NLOS.
TEST(JointEquations, AreTheSchurComplementOfTheDenseSystem) {
  test::Random random(3);
  constexpr std::size_t kAnchors = 3;
  constexpr std::size_t kRows = 60;
  // The two NLOS excesses are at the end.
  constexpr Eigen::Index kOwn = model::anchor_size(static_cast<Eigen::Index>(kSharingTags)) + 2;
  const AnchorLos los_states = los_of(kRows);
  const SharedUnknowns unknowns{
      .knots = {.begin_s = 0.0, .spacing_s = 4.0, .count = 4}, .knot_scale = {}, .body_tags = kSharingTags};
  const std::vector<double> inflation{1.0, 2.5, 4.0};
  std::vector<std::vector<Observation>> rows(kAnchors);
  std::vector<AnchorFit> fits(kAnchors);
  const Eigen::Index own_size = kAnchors * kOwn;
  Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(own_size + unknowns.size(), own_size + unknowns.size());
  Eigen::VectorXd descent = Eigen::VectorXd::Zero(dense.rows());
  dense.topLeftCorner(own_size, own_size).setIdentity();  // for anchors without NLOS
  for (std::size_t a = 0; a < kAnchors; ++a) {
    AnchorFit& fit = fits[a];
    fit.problem.tag_count = kSharingTags;
    fit.problem.position.information = 0.1 * Eigen::Matrix3d::Identity();
    fit.anchor = anchor_at(8.0 * random.gaussians(3), kSharingTags, {});
    fit.kernels.assign(kSharingTags, RobustKernel(KernelShape{}));
    if (a == 1) {
      fit.problem.los_states = &los_states;
      fit.anchor.conservativeResize(kOwn);
      fit.anchor.tail<2>() << 0.3, -0.1;
    }
    for (std::size_t i = 0; i < kRows; ++i) {
      Observation row = random_row(random);
      row.index = static_cast<std::uint32_t>(i);
      row.t_s = 0.2 * static_cast<double>(i);
      row.tag = static_cast<std::uint32_t>(i % 2);
      row.range_m = predict(row, fit.anchor, kSharingTags).range_m + random.uniform(-0.1, 0.5);
      rows[a].push_back(row);
    }
    fit.problem.rows = rows[a];

    const Eigen::Index at = static_cast<Eigen::Index>(a) * kOwn;
    const double share = 1.0 / inflation[a];
    const NormalEquations alone = linearize(fit);
    const Eigen::Index size = fit.anchor.size();
    dense.block(at, at, size, size) = share * alone.information;
    descent.segment(at, size) = -share * alone.gradient;
    for (const Observation& row : rows[a]) {
      const RowAt at_solution = row_at(fit, row);
      const RowValue& value = at_solution.value;
      const PairRow& pair = at_solution.j;
      const KnotShare knot = knot_share(unknowns.knots, row.t_s);
      const SharedRow terms = shared_jacobian(row, at_solution.predicted, knot.fraction);
      Eigen::VectorXd own = Eigen::VectorXd::Zero(dense.rows());
      own.segment<kOwn>(at)(pair_index(row.tag, kSharingTags)) = pair;
      Eigen::VectorXd shared = Eigen::VectorXd::Zero(dense.rows());
      shared.segment<6>(own_size + knot.first) = terms.head<6>();
      shared(own_size + unknowns.delay()) = terms(6);
      shared.segment<kBodyTerms>(own_size + unknowns.body(row.tag)) = terms.tail<kBodyTerms>();
      const auto add = [&](double weight, double slope) {
        dense += share * weight *
                 (own * shared.transpose() + shared * own.transpose() + shared * shared.transpose());
        descent += share * slope * shared;
      };
      add(value.seen.weight, value.seen.slope);
      if (a != 1) continue;
      own(at + kOwn - 2) = 1.0;
      own(at + kOwn - 1) = los_states.rows[row.index].episode == 0 ? 1.0 : 0.0;
      add(value.nlos_weight, value.nlos_slope);
    }
  }
  const JointEquations found = eliminate_anchors(fits, inflation, unknowns);
  const Eigen::MatrixXd own = dense.topLeftCorner(own_size, own_size);
  const Eigen::MatrixXd cross = dense.topRightCorner(own_size, unknowns.size());
  const Eigen::MatrixXd gain = own.ldlt().solve(cross);
  const Eigen::MatrixXd information =
      dense.bottomRightCorner(unknowns.size(), unknowns.size()) - cross.transpose() * gain;
  EXPECT_LT((found.information - information).norm(), 1e-9 * information.norm());
  const Eigen::VectorXd rest = descent.tail(unknowns.size()) - gain.transpose() * descent.head(own_size);
  EXPECT_LT((found.descent - rest).norm(), 1e-9 * descent.norm());
  for (std::size_t a = 0; a < kAnchors; ++a) {
    const Eigen::MatrixXd of_anchor =
        gain.middleRows(static_cast<Eigen::Index>(a) * kOwn, fits[a].anchor.size());
    EXPECT_LT((found.anchors[a].gain - of_anchor).norm(), 1e-9 * of_anchor.norm());
  }
}

// No range observes the map's frame: neither LOS nor long NLOS ranges resist a shift of all poses.
TEST(JointEquations, LeaveAShiftOfAllPosesFree) {
  test::Random random(4);
  const SharedUnknowns unknowns{
      .knots = {.begin_s = 0.0, .spacing_s = 4.0, .count = 4}, .knot_scale = {}, .body_tags = 0};
  constexpr std::size_t kRows = 60;
  const AnchorLos los_states = los_of(kRows);
  std::vector<Observation> rows;
  std::vector<AnchorFit> fits(1);
  AnchorFit& fit = fits.front();
  fit.problem.tag_count = kSharingTags;
  fit.problem.los_states = &los_states;
  fit.problem.position.information = 1e-9 * Eigen::Matrix3d::Identity();
  fit.kernels.assign(kSharingTags, RobustKernel(KernelShape{}));
  fit.anchor = anchor_at(8.0 * random.gaussians(3), kSharingTags, {});
  fit.anchor.conservativeResize(5 + 2 * static_cast<Eigen::Index>(kSharingTags));
  fit.anchor.tail<2>() << 0.4, 0.0;
  for (std::size_t i = 0; i < kRows; ++i) {
    Observation row = random_row(random);
    row.index = static_cast<std::uint32_t>(i);
    row.t_s = 0.2 * static_cast<double>(i);
    row.tag = static_cast<std::uint32_t>(i % 2);
    row.range_m =
        predict(row, fit.anchor, kSharingTags).range_m + 0.05 * random.gaussian() + (i % 3 == 0 ? 0.4 : 0.0);
    rows.push_back(row);
  }
  fit.problem.rows = rows;
  const std::vector<double> inflation{1.0};
  const JointEquations found = eliminate_anchors(fits, inflation, unknowns);
  for (const Eigen::Index axis : {0, 1}) {
    Eigen::VectorXd shift = Eigen::VectorXd::Zero(unknowns.size());
    for (Eigen::Index knot = 0; knot < unknowns.knots.count; ++knot) shift(3 * knot + axis) = 1.0;
    EXPECT_LT(shift.dot(found.information * shift), 1e-6);
    Eigen::VectorXd with_it = Eigen::VectorXd::Zero(fit.anchor.size());
    with_it(axis) = -1.0;
    EXPECT_LT((found.anchors.front().gain * shift - with_it).norm(), 1e-6);
  }
}

}  // namespace
}  // namespace groma::calibration
