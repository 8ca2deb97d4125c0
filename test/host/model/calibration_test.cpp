#include "host/model/calibration.hpp"

#include <gtest/gtest.h>

#include <vector>

namespace groma::model {
namespace {

TEST(SurveyedCalibration, TakesPositionsAsSurveyedAndBiasesAsExpected) {
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
    Eigen::VectorXd variances(7);
    variances << 0.0004, 0.0004, 0.0004, 0.09, 0.09, 0.000025, 0.000025;
    EXPECT_LT((anchor.covariance - Eigen::MatrixXd(variances.asDiagonal())).cwiseAbs().maxCoeff(), 1e-15);
  }
}

}  // namespace
}  // namespace groma::model
