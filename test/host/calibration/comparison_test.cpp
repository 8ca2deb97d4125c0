// Comparison and update of calibrations: against dense algebra, by statistics, and on simulated drives with
// moved anchors.
#include "host/calibration/comparison.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

using model::AnchorVerdict;
using model::position_by_frame;
using testing::ElementsAre;
using testing::IsEmpty;

Eigen::MatrixXd drawn_covariance(test::Random& random, Eigen::Index size, double sigma) {
  Eigen::MatrixXd root(size, size);
  for (Eigen::Index i = 0; i < size; ++i) root.row(i) = random.gaussians(size).transpose();
  Eigen::MatrixXd out = root * root.transpose() + 0.5 * Eigen::MatrixXd::Identity(size, size);
  return sigma * sigma * out / out.diagonal().mean();
}

// A site with two calibrations drawn from their own covariances.
struct Pair {
  std::vector<Eigen::Vector3d> truth;
  model::Calibration a;
  model::Calibration b;
};

Pair draw_pair(std::uint64_t seed, std::size_t anchors = 12, double sigma_m = 0.05, double frame_m = 0.03) {
  test::Random random(seed);
  Pair out;
  for (std::size_t i = 0; i < anchors; ++i) {
    out.truth.emplace_back(random.uniform(0.0, 30.0), random.uniform(0.0, 20.0), random.uniform(0.3, 3.5));
  }
  std::vector<Eigen::VectorXd> biases;
  for (std::size_t i = 0; i < anchors; ++i) biases.push_back(0.3 * random.gaussians(2));
  for (model::Calibration* calibration : {&out.a, &out.b}) {
    Eigen::Vector4d scale(frame_m, frame_m, 0.3 * frame_m, 0.1 * frame_m);
    const Eigen::MatrixXd shape = drawn_covariance(random, 4, 1.0);
    calibration->common_frame_covariance = scale.asDiagonal() * shape * scale.asDiagonal();
    calibration->verdict = model::Verdict::kUsable;
    const Eigen::Vector4d frame = random.gaussians(Eigen::MatrixXd(calibration->common_frame_covariance));
    for (std::size_t i = 0; i < anchors; ++i) {
      model::AnchorCalibration& anchor = calibration->anchors.emplace_back();
      anchor.id = static_cast<model::NodeId>(10 + i);
      anchor.covariance = drawn_covariance(random, model::kPairSize, sigma_m);
      const Eigen::VectorXd error = random.gaussians(anchor.covariance);
      const Eigen::Vector3d place_m = out.truth[i] + position_by_frame(out.truth[i]) * frame;
      anchor.pairs.push_back({.tag_id = 1});
      set_values(anchor, model::anchor_at(place_m, 1, {.beta_m = {biases[i](0), 0.3}}) + error,
                 anchor.covariance);
      model::add_common_frame(anchor, calibration->common_frame_covariance);
      anchor.verdict = AnchorVerdict::kOk;
      anchor.ranges_used = 1000;
    }
  }
  return out;
}

// The anchor's covariance without the common frame's.
Eigen::MatrixXd own(const model::AnchorCalibration& anchor, const model::Calibration& calibration) {
  const Eigen::Matrix<double, 3, 4> frame = position_by_frame(anchor.position_m);
  Eigen::MatrixXd out = anchor.covariance;
  out.topLeftCorner<3, 3>() -= frame * calibration.common_frame_covariance * frame.transpose();
  return out;
}

TEST(Chi2, TailsMatchTables) {
  EXPECT_NEAR(chi2_tail_1(3.841), 0.05, 1e-4);
  EXPECT_NEAR(chi2_tail_1(10.828), 0.001, 1e-5);
  EXPECT_NEAR(chi2_tail_3(7.815), 0.05, 1e-4);
  EXPECT_NEAR(chi2_tail_3(16.266), 0.001, 1e-5);
  EXPECT_EQ(chi2_tail_3(0.0), 1.0);
}

TEST(Chi2, BeyondARadiusMatchesAGridSearch) {
  test::Random random(5);
  for (int i = 0; i < 20; ++i) {
    const Eigen::Matrix3d covariance = drawn_covariance(random, 3, 0.1);
    const Eigen::Vector3d displacement = 0.4 * random.gaussians(3);
    constexpr double kRadius_m = 0.15;
    double least = displacement.norm() <= kRadius_m ? 0.0 : 1e9;
    for (double polar = 0.0; polar < 3.15; polar += 0.02) {
      for (double around = 0.0; around < 6.29; around += 0.02) {
        const Eigen::Vector3d r =
            displacement - kRadius_m * Eigen::Vector3d(std::sin(polar) * std::cos(around),
                                                       std::sin(polar) * std::sin(around), std::cos(polar));
        if (displacement.norm() > kRadius_m) least = std::min(least, r.dot(covariance.inverse() * r));
      }
    }
    const double found = chi2_beyond(displacement, covariance, kRadius_m);
    EXPECT_LE(found, least + 1e-9);
    EXPECT_GE(found, least - 0.01 * (1.0 + least));
  }
}

// Reference: the difference of one anchor given all others, from the dense covariance of all differences.
TEST(Comparison, IsTheConditionalOfTheJointGaussian) {
  const Pair pair = draw_pair(3, 5);
  const Comparison comparison = compare(pair.a, pair.b);
  const Eigen::Index n = 15;
  Eigen::MatrixXd frames(n, 4);
  Eigen::MatrixXd joint = Eigen::MatrixXd::Zero(n, n);
  Eigen::VectorXd difference(n);
  for (Eigen::Index i = 0; i < 5; ++i) {
    const auto& a = pair.a.anchors[static_cast<std::size_t>(i)];
    const auto& b = pair.b.anchors[static_cast<std::size_t>(i)];
    frames.middleRows<3>(3 * i) = position_by_frame(a.position_m);
    joint.block<3, 3>(3 * i, 3 * i) =
        own(a, pair.a).topLeftCorner<3, 3>() + own(b, pair.b).topLeftCorner<3, 3>();
    difference.segment<3>(3 * i) = b.position_m - a.position_m;
  }
  joint += frames * (pair.a.common_frame_covariance + pair.b.common_frame_covariance) * frames.transpose();
  const Eigen::MatrixXd precision = joint.inverse();
  ASSERT_EQ(comparison.anchors.size(), 5U);
  for (Eigen::Index i = 0; i < 5; ++i) {
    const Eigen::Matrix3d covariance = precision.block<3, 3>(3 * i, 3 * i).inverse();
    const Eigen::Vector3d conditional = covariance * precision.middleRows<3>(3 * i) * difference;
    const AnchorChange& change = comparison.anchors[static_cast<std::size_t>(i)];
    EXPECT_LT((change.displacement_m - conditional).norm(), 1e-8);
    EXPECT_LT((change.covariance_m2 - covariance).norm(), 1e-8);
  }
}

TEST(Comparison, OfAnUnchangedSiteFollowsChiSquareAndAlarmsOnlyByChance) {
  constexpr int kSeeds = 400;
  double sum = 0.0;
  int differs = 0;
  for (std::uint64_t seed = 1; seed <= kSeeds; ++seed) {
    const Pair pair = draw_pair(seed);
    const Comparison comparison = compare(pair.a, pair.b);
    bool any = false;
    for (const AnchorChange& change : comparison.anchors) {
      sum += change.chi2;
      any = any || change.differs;
      EXPECT_FALSE(change.moved);
    }
    differs += any ? 1 : 0;
  }
  // 4800 values of 3 degrees of freedom; those of one site are slightly correlated.
  EXPECT_NEAR(sum / (12.0 * kSeeds), 3.0, 0.15);
  EXPECT_LE(differs, 4) << "one in a thousand sites is expected";
}

TEST(Comparison, FindsEachAnchorThatMovedAndNoOther) {
  for (std::uint64_t seed = 1; seed <= 200; ++seed) {
    Pair pair = draw_pair(seed, 12, 0.03, 0.02);
    test::Random random(seed);
    for (const std::size_t i : {2U, 7U}) {
      const double angle = random.uniform(0.0, 6.2832);
      pair.b.anchors[i].position_m += 0.5 * Eigen::Vector3d(std::cos(angle), std::sin(angle), 0.0);
    }
    const Comparison comparison = compare(pair.a, pair.b);
    for (std::size_t i = 0; i < comparison.anchors.size(); ++i) {
      EXPECT_EQ(comparison.anchors[i].moved, i == 2 || i == 7) << "seed " << seed << ", anchor " << i;
    }
  }
}

TEST(Comparison, ReportsNewAndMissingAnchors) {
  Pair pair = draw_pair(4);
  pair.a.anchors.erase(pair.a.anchors.begin() + 3);
  pair.b.anchors[5].covariance.resize(0, 0);  // null in the file
  pair.b.anchors[0].pairs[0].beta_m += 1.0;
  const Comparison comparison = compare(pair.a, pair.b);
  EXPECT_THAT(comparison.only_b, ElementsAre(13));
  EXPECT_THAT(comparison.only_a, ElementsAre(15));
  EXPECT_EQ(comparison.anchors.size(), 10U);
  for (const PairChange& change : comparison.pairs) EXPECT_EQ(change.differs, change.anchor_id == 10);
}

// ---- update ---------------------------------------------------------------------------------------

// Reference: both calibrations as one linear problem, with all anchors, both frames, and the priors of the
// biases once.
TEST(Update, IsTheDenseSolutionOfBothDrives) {
  model::RangePriors priors;
  priors.beta_m = {0.1, 0.3};
  priors.gamma = {1.0, 0.2};
  constexpr Eigen::Index kSize = model::kPairSize;
  Pair pair = draw_pair(8, 4);
  const Update updated = update(pair.a, pair.b, priors);
  ASSERT_THAT(updated.moved, IsEmpty());

  const Eigen::Index frames = 4 * kSize;
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(frames + 8, frames + 8);
  Eigen::VectorXd right_side = Eigen::VectorXd::Zero(frames + 8);
  information.block<4, 4>(frames, frames) = pair.a.common_frame_covariance.inverse();
  information.block<4, 4>(frames + 4, frames + 4) = pair.b.common_frame_covariance.inverse();
  for (Eigen::Index i = 0; i < 4; ++i) {
    for (Eigen::Index drive = 0; drive < 2; ++drive) {
      const model::Calibration& calibration = drive == 0 ? pair.a : pair.b;
      const auto& anchor = calibration.anchors[static_cast<std::size_t>(i)];
      const Eigen::MatrixXd weight = own(anchor, calibration).inverse();
      Eigen::MatrixXd by = Eigen::MatrixXd::Zero(kSize, frames + 8);
      by.middleCols<kSize>(kSize * i).setIdentity();
      by.block<3, 4>(0, frames + 4 * drive) =
          position_by_frame(pair.a.anchors[static_cast<std::size_t>(i)].position_m);
      information += by.transpose() * weight * by;
      right_side += by.transpose() * weight * values_of(anchor);
    }
    const model::TermVector weight = sigmas_of(priors).cwiseAbs2().cwiseInverse();
    information.diagonal().segment<model::kPairTermCount>(kSize * i + 3) -= weight;
    right_side.segment<model::kPairTermCount>(kSize * i + 3) -= weight.cwiseProduct(means_of(priors));
  }
  const Eigen::MatrixXd covariance = information.inverse();
  const Eigen::VectorXd solution = covariance * right_side;
  for (Eigen::Index i = 0; i < 4; ++i) {
    const auto& anchor = updated.calibration.anchors[static_cast<std::size_t>(i)];
    const Eigen::Vector3d dense_m = solution.segment<3>(kSize * i);
    const Eigen::Matrix3d dense = covariance.block<3, 3>(kSize * i, kSize * i);
    EXPECT_LT((anchor.position_m - dense_m).norm(), 0.3 * std::sqrt(dense.trace())) << i;
    const Eigen::Matrix3d stated = anchor.covariance.topLeftCorner<3, 3>();
    EXPECT_GT(stated.trace(), 0.9 * dense.trace()) << i;
    EXPECT_LT(stated.trace(), 1.4 * dense.trace()) << i;
  }
}

// Each drive alone knows a bias as well as the prior: the means of three equal terms.
TEST(Update, CountsThePriorsOfTheBiasesOnce) {
  model::RangePriors priors;
  priors.beta_m = {0.1, 0.3};
  priors.gamma = {1.0, 0.02};
  const auto of_drive = [&](double beta_m, double gamma) {
    model::Calibration out;
    model::AnchorCalibration& anchor = out.anchors.emplace_back();
    anchor.id = 10;
    anchor.position_m = {3.0, 4.0, 2.0};
    anchor.pairs.push_back({.tag_id = 1,
                            .beta_m = 0.5 * (priors.beta_m.mean + beta_m),
                            .gamma = 0.5 * (priors.gamma.mean + gamma)});
    Eigen::VectorXd variances(model::kPairSize);
    variances << Eigen::Vector3d::Constant(0.01), 0.5 * sigmas_of(priors).cwiseAbs2();
    set_values(anchor, values_of(anchor), variances.asDiagonal());
    anchor.verdict = AnchorVerdict::kOk;
    return out;
  };
  const Update updated = update(of_drive(0.3, 1.02), of_drive(0.5, 1.01), priors);
  const model::PairBias& pair = updated.calibration.anchors.at(0).pairs.at(0);
  EXPECT_NEAR(pair.beta_m, (0.1 + 0.3 + 0.5) / 3.0, 1e-9);
  EXPECT_NEAR(pair.beta_sigma_m, 0.3 / std::sqrt(3.0), 1e-9);
  EXPECT_NEAR(pair.gamma, (1.0 + 1.02 + 1.01) / 3.0, 1e-9);
  EXPECT_NEAR(pair.gamma_sigma, 0.02 / std::sqrt(3.0), 1e-9);
}

TEST(Comparison, DoesNotTrustAnAmbiguousHeight) {
  Pair pair = draw_pair(6);
  pair.b.anchors[2].position_m.z() += 3.0;
  pair.b.anchors[2].verdict = AnchorVerdict::kWeakZ;
  pair.b.anchors[4].position_m.z() += 3.0;
  const Comparison comparison = compare(pair.a, pair.b);
  for (const AnchorChange& change : comparison.anchors) EXPECT_EQ(change.moved, change.id == 14) << change.id;

  // The trusted height stays.
  const model::Calibration& updated = update(pair.a, pair.b, {}).calibration;
  EXPECT_NEAR(updated.anchors[2].position_m.z(), pair.a.anchors[2].position_m.z(), 0.15);
  EXPECT_EQ(updated.anchors[2].verdict, AnchorVerdict::kOk);
  pair.a.anchors[2].verdict = AnchorVerdict::kWeakZ;
  const model::AnchorCalibration both = update(pair.a, pair.b, {}).calibration.anchors[2];
  EXPECT_EQ(both.verdict, AnchorVerdict::kWeakZ);
  EXPECT_GT(both.covariance(2, 2), 4.0);
}

TEST(Update, IsConsistent) {
  constexpr int kSeeds = 200;
  model::RangePriors priors;
  priors.beta_m = {0.0, 10.0};
  priors.gamma = {1.0, 10.0};
  double nees = 0.0;
  double before = 0.0;
  double after = 0.0;
  for (std::uint64_t seed = 1; seed <= kSeeds; ++seed) {
    const Pair pair = draw_pair(seed);
    const Update updated = update(pair.a, pair.b, priors);
    for (std::size_t i = 0; i < pair.truth.size(); ++i) {
      const auto& anchor = updated.calibration.anchors[i];
      const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
      const Eigen::Vector3d error_m = anchor.position_m - pair.truth[i];
      nees += error_m.dot(covariance.ldlt().solve(error_m)) / 3.0;
      after += error_m.squaredNorm();
      before += (pair.a.anchors[i].position_m - pair.truth[i]).squaredNorm();
    }
  }
  const double n = 12.0 * kSeeds;
  EXPECT_NEAR(nees / n, 0.95, 0.15);
  EXPECT_LT(std::sqrt(after / n), 0.8 * std::sqrt(before / n));
}

test::SimulatedSite drive_past(const test::SiteSettings& settings, std::uint64_t seed,
                               const std::vector<std::pair<std::size_t, Eigen::Vector3d>>& moves,
                               std::uint64_t noise_seed) {
  test::SimulatedSite site = test::simulate_site(settings, seed);
  for (const auto& [index, way_m] : moves) site.anchors[index].position_m += way_m;
  // New noise and new pose errors; the biases are those of the site.
  const test::SimulatedSite other = test::simulate_site(settings, noise_seed);
  site.poses = other.poses;
  test::Random random(noise_seed + 7000);
  for (model::RangeSample& range : site.ranges) {
    std::size_t a = 0;
    while (site.anchors[a].id != range.anchor_id) ++a;
    const std::size_t j = range.tag_id - 1U;
    const Eigen::Vector3d antenna_m =
        test::antenna_of(test::true_pose(range.t_s, settings.route), site.tags[j]);
    range.range_m = site.gamma[a][j] * (antenna_m - site.anchors[a].position_m).norm() + site.beta_m[a][j] +
                    settings.sigma_m * random.gaussian();
    if (random.uniform() < settings.outlier_share) range.range_m += random.uniform(0.5, 3.5);
  }
  return site;
}

Eigen::Vector3d half_a_metre(double angle_rad) {
  return 0.5 * Eigen::Vector3d(std::cos(angle_rad), std::sin(angle_rad), 0.0);
}

// Two anchors were moved by half a metre between two drives.
TEST(Update, FindsTheMovedAnchorsAndNoOther) {
  const test::SiteSettings settings{.outlier_share = 0.1, .pose_sigma_m = 0.02, .pose_yaw_sigma_rad = 0.004};
  for (std::uint64_t seed = 1; seed <= 12; ++seed) {
    const test::SimulatedSite first = test::simulate_site(settings, seed);
    const std::size_t one = seed % 12;
    const std::size_t two = (seed + 5) % 12;
    const test::SimulatedSite second = drive_past(settings, seed,
                                                  {{one, half_a_metre(0.7 * static_cast<double>(seed))},
                                                   {two, half_a_metre(2.1 * static_cast<double>(seed))}},
                                                  seed + 500);
    const model::Calibration earlier = calibrate(first.drive()).calibration;
    const Result later = calibrate(second.drive());
    const Update updated = update(earlier, later.calibration, first.drive().priors);
    std::vector<model::NodeId> expected{first.anchors[one].id, first.anchors[two].id};
    std::sort(expected.begin(), expected.end());
    EXPECT_EQ(updated.moved, expected) << "seed " << seed;
    for (std::size_t a = 0; a < 12; ++a) {
      const model::AnchorCalibration& anchor = updated.calibration.anchors[a];
      EXPECT_EQ(anchor.verdict == AnchorVerdict::kMoved, a == one || a == two);
      if (!model::has_position(anchor)) continue;
      const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
      const Eigen::Vector3d error_m = anchor.position_m - second.anchors[a].position_m;
      EXPECT_LT(error_m.dot(covariance.ldlt().solve(error_m)), 25.0)
          << "seed " << seed << ", anchor " << anchor.id << " off by " << error_m.transpose();
    }
  }
}

TEST(Update, FindsNoMoveWhereNoneMovedOverManyDrives) {
  const test::SiteSettings settings{.outlier_share = 0.15, .pose_sigma_m = 0.02, .pose_yaw_sigma_rad = 0.004};
  for (std::uint64_t seed = 21; seed <= 32; ++seed) {
    const test::SimulatedSite first = test::simulate_site(settings, seed);
    const test::SimulatedSite second = drive_past(settings, seed, {}, seed + 500);
    const Update updated = update(calibrate(first.drive()).calibration, calibrate(second.drive()).calibration,
                                  first.drive().priors);
    EXPECT_THAT(updated.moved, IsEmpty()) << "seed " << seed;
    EXPECT_THAT(updated.added, IsEmpty());
    EXPECT_THAT(updated.kept, IsEmpty());
  }
}

// Accuracy and consistency of the positions of several calibrations.
struct Score {
  double square_m2 = 0.0;
  double nees = 0.0;
  int anchors = 0;

  void add(const model::Calibration& calibration, const test::SimulatedSite& site) {
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const model::AnchorCalibration& anchor = calibration.anchors[a];
      ASSERT_TRUE(model::has_position(anchor));
      const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
      const Eigen::Vector3d error_m = anchor.position_m - site.anchors[a].position_m;
      square_m2 += error_m.squaredNorm();
      nees += error_m.dot(covariance.ldlt().solve(error_m)) / 3.0;
      ++anchors;
    }
  }
  [[nodiscard]] double rmse_m() const { return std::sqrt(square_m2 / anchors); }
  [[nodiscard]] double mean_nees() const { return nees / anchors; }
};

// The part of a drive from begin_s to end_s.
test::SimulatedSite piece_of(test::SimulatedSite site, double begin_s, double end_s) {
  const auto is_outside = [&](const auto& sample) { return sample.t_s < begin_s || sample.t_s > end_s; };
  std::erase_if(site.ranges, is_outside);
  std::erase_if(site.poses, is_outside);
  return site;
}

// A single, nearly straight pass through the hall determines little and may put anchors on the wrong side:
// the earlier calibration decides and is not degraded.
TEST(Update, ByAWeakDriveIsBetterThanEitherAloneOverManyDrives) {
  const test::SiteSettings settings{.outlier_share = 0.1, .pose_sigma_m = 0.01, .pose_yaw_sigma_rad = 0.002};
  for (const bool both_are_weak : {false, true}) {
    Score before;
    Score alone;
    Score updated;
    for (std::uint64_t seed = 1; seed <= 24; ++seed) {
      const double begin_s = 8.0 * static_cast<double>(seed);
      test::SimulatedSite first = test::simulate_site(settings, seed);
      if (both_are_weak) first = piece_of(first, 0.0, 80.0);
      const test::SimulatedSite second =
          piece_of(drive_past(settings, seed, {}, seed + 500), begin_s, begin_s + 25.0);
      const model::Calibration earlier = calibrate(first.drive()).calibration;
      const model::Calibration later = calibrate(second.drive(), {.earlier = &earlier}).calibration;
      const Update both = update(earlier, later, first.drive().priors);
      EXPECT_THAT(both.moved, IsEmpty()) << "seed " << seed;
      before.add(earlier, first);
      alone.add(calibrate(second.drive()).calibration, first);
      updated.add(both.calibration, first);
    }
    EXPECT_LT(updated.rmse_m(), 1.2 * before.rmse_m());
    EXPECT_LT(updated.rmse_m(), 0.3 * alone.rmse_m());
    EXPECT_GT(updated.mean_nees(), 0.6);
    EXPECT_LT(updated.mean_nees(), 1.4);
  }
}

TEST(Update, AddsNewAnchorsAndKeepsThoseThatWereNotHeard) {
  const test::SiteSettings settings;
  const test::SimulatedSite first = test::simulate_site(settings, 1);
  test::SimulatedSite second = drive_past(settings, 1, {}, 501);
  model::Calibration earlier = calibrate(first.drive()).calibration;
  earlier.anchors.erase(earlier.anchors.begin() + 4);  // anchor 8
  earlier.frame = "hall";
  std::erase_if(second.ranges, [](const auto& range) { return range.anchor_id == 13; });
  const Update updated = update(earlier, calibrate(second.drive()).calibration, first.drive().priors);
  EXPECT_THAT(updated.added, ElementsAre(8));
  EXPECT_THAT(updated.kept, ElementsAre(13));
  EXPECT_THAT(updated.moved, IsEmpty());
  EXPECT_EQ(updated.calibration.frame, "hall");
  ASSERT_EQ(updated.calibration.anchors.size(), 12U);
  EXPECT_EQ(updated.calibration.anchors[9].id, 13);
  EXPECT_LT((updated.calibration.anchors[9].position_m - first.anchors[9].position_m).norm(), 0.5);
  EXPECT_LT((updated.calibration.anchors[4].position_m - first.anchors[4].position_m).norm(), 0.5);
}

}  // namespace
}  // namespace groma::calibration
