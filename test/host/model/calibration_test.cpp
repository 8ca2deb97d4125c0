#include "host/model/calibration.hpp"

#include <gtest/gtest.h>

#include <vector>

#include <Eigen/Eigenvalues>

#include "test/support/random.hpp"

namespace groma::model {
namespace {

TEST(SurveyedCalibration, HasSurveyedPositionsAndPriorBiases) {
  const std::vector<Anchor> anchors{{9, {1.0, 2.0, 3.0}}, {4, {-5.0, 6.0, 0.5}}};
  const std::vector<Tag> tags{{2, Eigen::Vector3d::Zero()}, {1, Eigen::Vector3d::Ones()}};
  const RangePriors priors{.sigma_m = 0.1, .beta_m = {0.2, 0.3}, .gamma = {1.01, 0.005}};
  const Calibration calibration = surveyed_calibration(anchors, tags, priors, 0.02);

  ASSERT_EQ(calibration.anchors.size(), 2U);
  EXPECT_EQ(calibration.anchors[0].id, 4);
  EXPECT_EQ(calibration.anchors[1].id, 9);
  EXPECT_EQ(calibration.anchors[1].position_m, Eigen::Vector3d(1.0, 2.0, 3.0));
  EXPECT_EQ(calibration.common_frame_covariance, Eigen::Matrix4d::Zero());
  for (const AnchorCalibration& anchor : calibration.anchors) {
    ASSERT_EQ(anchor.pairs.size(), 2U);
    EXPECT_EQ(anchor.pairs[0].tag_id, 1);
    EXPECT_EQ(anchor.pairs[1].tag_id, 2);
    EXPECT_EQ(anchor.pairs[1].beta_m, 0.2);
    EXPECT_EQ(anchor.pairs[1].gamma, 1.01);
    Eigen::Matrix<double, 7, 1> variances;
    variances << 0.0004, 0.0004, 0.0004, 0.09, 0.09, 0.000025, 0.000025;
    EXPECT_LT((anchor.covariance.diagonal().head<7>() - variances).cwiseAbs().maxCoeff(), 1e-15);
    EXPECT_TRUE(anchor.covariance.isDiagonal(0.0));
    EXPECT_EQ(values_of(anchor.pairs[1]), means_of(priors));
  }
}

Eigen::MatrixXd drawn_covariance(test::Random& random, Eigen::Index size, double sigma) {
  Eigen::MatrixXd root(size, size);
  for (Eigen::Index i = 0; i < size; ++i) root.row(i) = random.gaussians(size).transpose();
  return sigma * sigma * (root * root.transpose());
}

double least_eigenvalue(const Eigen::MatrixXd& matrix) {
  return Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(matrix, Eigen::EigenvaluesOnly).eigenvalues()(0);
}

// The block is the sum of its own covariance and the frame's, and own_covariance() recovers the former.
TEST(OwnCovariance, IsTheBlockWithoutTheFrame) {
  test::Random random(1);
  for (int i = 0; i < 50; ++i) {
    AnchorCalibration anchor;
    anchor.position_m = 10.0 * random.gaussians(3);
    const Eigen::MatrixXd own = drawn_covariance(random, 7, 0.1);
    const Eigen::Matrix4d frame = drawn_covariance(random, 4, 0.03);
    anchor.covariance = own;
    add_common_frame(anchor, frame);
    // The displacement of the anchor by a small shift and yaw of the frame.
    const auto moved = [&](const Eigen::Vector4d& by) -> Eigen::Vector3d {
      return by.head<3>() + by(3) * Eigen::Vector3d::UnitZ().cross(anchor.position_m);
    };
    const Eigen::Matrix4d root = frame.llt().matrixL();
    Eigen::Matrix3d shared = Eigen::Matrix3d::Zero();
    for (Eigen::Index k = 0; k < 4; ++k) shared += moved(root.col(k)) * moved(root.col(k)).transpose();
    EXPECT_LT((anchor.covariance.topLeftCorner<3, 3>() - own.topLeftCorner<3, 3>() - shared).norm(), 1e-12);
    EXPECT_LT((own_covariance(anchor, frame) - own).norm(), 1e-9);
    EXPECT_EQ(own_covariance(anchor, Eigen::Matrix4d::Zero()), anchor.covariance);
  }
}

TEST(OwnCovariance, StaysPositiveSemidefiniteForALargeFrameCovariance) {
  test::Random random(2);
  for (int i = 0; i < 50; ++i) {
    AnchorCalibration anchor;
    anchor.position_m = 10.0 * random.gaussians(3);
    anchor.covariance = drawn_covariance(random, 5, 0.05);
    // Larger than the block along some directions, zero along others.
    Eigen::Matrix4d frame = Eigen::Matrix4d::Zero();
    frame.diagonal() << 1.0, 1e-8, 0.0, 1e-6;
    const Eigen::MatrixXd own = own_covariance(anchor, frame);
    EXPECT_EQ(own, own.transpose());
    EXPECT_GT(least_eigenvalue(own), -1e-12);
    EXPECT_GT(least_eigenvalue(anchor.covariance - own), -1e-12) << "nothing is added";
    AnchorCalibration again = anchor;
    again.covariance = own;
    add_common_frame(again, frame);
    EXPECT_GT(least_eigenvalue(again.covariance - anchor.covariance), -1e-12)
        << "the sum is not smaller than the block";
    EXPECT_EQ(own.rightCols<2>(), anchor.covariance.rightCols<2>());
  }
  // With exactly known biases, the whole covariance of the position is available.
  AnchorCalibration exact;
  exact.covariance = Eigen::MatrixXd::Zero(5, 5);
  exact.covariance.topLeftCorner<3, 3>() = drawn_covariance(random, 3, 0.1);
  const Eigen::Matrix4d frame = 1e-6 * Eigen::Matrix4d::Identity();
  Eigen::MatrixXd expected = exact.covariance;
  expected.diagonal().head<3>().array() -= 1e-6;
  EXPECT_LT((own_covariance(exact, frame) - expected).norm(), 1e-12);
}

}  // namespace
}  // namespace groma::model
