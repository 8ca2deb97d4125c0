#include "host/calibration/anchor_links.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

Eigen::MatrixXd random_covariance(Eigen::Index size, double scale, test::Random& random) {
  Eigen::MatrixXd root(size, size);
  for (Eigen::Index column = 0; column < size; ++column) root.col(column) = random.gaussians(size);
  return scale * scale *
         (root * root.transpose() / static_cast<double>(size) + 0.2 * Eigen::MatrixXd::Identity(size, size));
}

// Reference: one covariance of all unknowns of all anchors, updated with all links at once as in a Kalman
// filter, linearized at the estimate.
TEST(AnchorLinks, EqualADenseUpdateOfAllUnknowns) {
  test::Random random(1);
  constexpr std::size_t kAnchors = 4;
  constexpr Eigen::Index kSize = 7;
  constexpr Eigen::Index kShared = 5;
  model::RangePriors priors;
  priors.beta_m = {0.1, 0.05};
  AnchorBelief belief;
  belief.shared = random_covariance(kShared, 0.1, random);
  Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(kAnchors * kSize, kAnchors * kSize);
  Eigen::VectorXd mean(kAnchors * kSize);
  std::vector<model::NodeId> ids;
  for (std::size_t a = 0; a < kAnchors; ++a) {
    ids.push_back(static_cast<model::NodeId>(a));
    belief.mean.emplace_back(random.gaussians(kSize));
    belief.mean[a].head<3>() *= 6.0;
    Eigen::MatrixXd gain(kSize, kShared);
    for (Eigen::Index column = 0; column < kShared; ++column) gain.col(column) = random.gaussians(kSize);
    belief.gain.push_back(gain);
    belief.covariance.emplace_back(random_covariance(kSize, 0.1, random) +
                                   gain * belief.shared * gain.transpose());
  }
  for (std::size_t a = 0; a < kAnchors; ++a) {
    const Eigen::Index at = static_cast<Eigen::Index>(a) * kSize;
    mean.segment<kSize>(at) = belief.mean[a];
    for (std::size_t b = 0; b < kAnchors; ++b) {
      dense.block<kSize, kSize>(at, static_cast<Eigen::Index>(b) * kSize) =
          a == b ? belief.covariance[a]
                 : Eigen::MatrixXd(belief.gain[a] * belief.shared * belief.gain[b].transpose());
    }
  }
  std::vector<model::AnchorRange> ranges;
  for (std::size_t a = 0; a < kAnchors; ++a) {
    for (std::size_t b = a + 1; b < kAnchors; ++b) {
      const double distance_m = (belief.mean[a] - belief.mean[b]).head<3>().norm();
      ranges.push_back({ids[b], ids[a], distance_m + 0.1 + 0.1 * random.gaussian(), 0.05, 20});
    }
  }
  const std::vector<AnchorLink> links = gather_links(ranges, ids, priors);
  ASSERT_EQ(links.size(), ranges.size());
  const AnchorBelief found = fuse_links(belief, links, priors);

  const auto count = static_cast<Eigen::Index>(links.size());
  Eigen::MatrixXd jacobian = Eigen::MatrixXd::Zero(count, mean.size());
  Eigen::VectorXd innovation(count);
  Eigen::MatrixXd noise = Eigen::MatrixXd::Zero(count, count);
  Eigen::VectorXd there(mean.size());
  for (std::size_t a = 0; a < kAnchors; ++a) {
    there.segment<kSize>(static_cast<Eigen::Index>(a) * kSize) = found.mean[a];
  }
  for (Eigen::Index l = 0; l < count; ++l) {
    const AnchorLink& link = links[static_cast<std::size_t>(l)];
    const Eigen::Vector3d way_m = found.mean[link.from].head<3>() - found.mean[link.to].head<3>();
    jacobian.block<1, 3>(l, static_cast<Eigen::Index>(link.from) * kSize) = way_m.normalized().transpose();
    jacobian.block<1, 3>(l, static_cast<Eigen::Index>(link.to) * kSize) = -way_m.normalized().transpose();
    const double residual_m = link.range_m - 0.1 - way_m.norm();
    const KernelValue value =
        RobustKernel(KernelShape{.scale_m = std::sqrt(link.variance_m2)}).at(residual_m);
    noise(l, l) = 1.0 / value.weight;
    innovation(l) = value.slope / value.weight;
  }
  const Eigen::MatrixXd cross = dense * jacobian.transpose();
  const Eigen::LDLT<Eigen::MatrixXd> scatter(jacobian * cross + noise);
  const Eigen::VectorXd expected = mean + cross * scatter.solve(innovation + jacobian * (there - mean));
  const Eigen::MatrixXd covariance = dense - cross * scatter.solve(cross.transpose());
  for (std::size_t a = 0; a < kAnchors; ++a) {
    const Eigen::Index at = static_cast<Eigen::Index>(a) * kSize;
    EXPECT_LT((found.mean[a] - expected.segment<kSize>(at)).norm(), 1e-5);
    EXPECT_LT((found.covariance[a] - covariance.block<kSize, kSize>(at, at)).norm(), 1e-6);
  }
}

TEST(AnchorLinks, LeaveOutInvalidRangesAndUnknownAnchors) {
  const std::vector<model::NodeId> ids{3, 5, 8};
  const std::vector<model::AnchorRange> ranges{
      {3, 5, 4.0, 0.1, 10}, {5, 3, 4.2, 0.1, 30}, {3, 3, 1.0, 0.1, 5},         {3, 9, 4.0, 0.1, 5},
      {5, 8, -1.0, 0.1, 5}, {5, 8, 4.0, 0.1, 0},  {5, 8, std::nan(""), 0.1, 5}};
  const std::vector<AnchorLink> links = gather_links(ranges, ids, {});
  ASSERT_EQ(links.size(), 1U);
  EXPECT_NEAR(links[0].range_m, 4.15, 1e-12);
}

struct Errors {
  double square_xy_m2 = 0.0;
  double square_z_m2 = 0.0;
  double nees = 0.0;
  double anchors = 0.0;
  std::size_t not_ok = 0;

  void add(const test::SimulatedSite& site, const Result& result) {
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const model::AnchorCalibration& found = result.calibration.anchors[a];
      const Eigen::Vector3d error_m = found.position_m - site.anchors[a].position_m;
      square_xy_m2 += error_m.head<2>().squaredNorm();
      square_z_m2 += error_m.z() * error_m.z();
      nees += error_m.dot(found.covariance.topLeftCorner<3, 3>().ldlt().solve(error_m)) / 3.0;
      anchors += 1.0;
      if (found.verdict != model::AnchorVerdict::kOk) ++not_ok;
    }
  }
};

// Anchors that a short drive leaves poorly determined, with ranges between them: positions and heights
// improve, and the covariance stays consistent.
TEST(AnchorLinks, ImproveAPoorlyDeterminedSite) {
  Errors without;
  Errors with;
  for (std::uint64_t seed = 1; seed <= 8; ++seed) {
    const test::SimulatedSite site =
        test::simulate_site({.duration_s = 20.0, .ranges_per_pair = 100, .beta_sigma_m = 0.1}, seed);
    test::Random random(100 + seed);
    std::vector<model::AnchorRange> survey;
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      for (std::size_t b = a + 1; b < site.anchors.size(); ++b) {
        const double distance_m = (site.anchors[a].position_m - site.anchors[b].position_m).norm();
        const double gamma = 1.0 + 0.005 * random.gaussian();
        const double range_m = gamma * distance_m + 0.1 * random.gaussian() + 0.1 / 7.0 * random.gaussian();
        survey.push_back({site.anchors[a].id, site.anchors[b].id, range_m, 0.1, 49});
      }
    }
    Drive drive = site.drive();
    without.add(site, calibrate(drive));
    drive.anchor_ranges = survey;
    with.add(site, calibrate(drive));
  }
  RecordProperty("xy_rmse_m", std::to_string(std::sqrt(with.square_xy_m2 / with.anchors)));
  RecordProperty("xy_rmse_without_m", std::to_string(std::sqrt(without.square_xy_m2 / without.anchors)));
  RecordProperty("z_rmse_m", std::to_string(std::sqrt(with.square_z_m2 / with.anchors)));
  RecordProperty("z_rmse_without_m", std::to_string(std::sqrt(without.square_z_m2 / without.anchors)));
  RecordProperty("nees", std::to_string(with.nees / with.anchors));
  RecordProperty("not_ok", std::to_string(with.not_ok) + " of " + std::to_string(without.not_ok));
  EXPECT_LT(with.square_xy_m2, 0.6 * without.square_xy_m2);
  EXPECT_LT(with.square_z_m2, 0.8 * without.square_z_m2);
  EXPECT_LE(with.not_ok, without.not_ok);
  EXPECT_NEAR(with.nees / with.anchors, 1.0, 0.4);
}

}  // namespace
}  // namespace groma::calibration
