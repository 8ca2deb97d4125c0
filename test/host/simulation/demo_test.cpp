#include "host/simulation/demo.hpp"

#include <gtest/gtest.h>

#include <string_view>

#include "test/host/simulation/small_site.hpp"

namespace groma::simulation {
namespace {

TEST(Demo, ASeedGivesOneResult) {
  const sim::Scenario site = small_site();
  DemoOptions options;
  options.site.seed = 7;
  double done = 0.0;
  options.progress = [&](std::string_view /*phase*/, double share) {
    EXPECT_GE(share, done);
    done = share;
  };
  const DemoResult once = run_demo(site, options);
  EXPECT_NEAR(done, 1.0, 1e-9);
  options.progress = {};
  const DemoResult again = run_demo(site, options);
  ASSERT_EQ(once.models.size(), filter::kModels.size());
  for (std::size_t i = 0; i < once.models.size(); ++i) {
    const ModelRun& a = once.models[i];
    const ModelRun& b = again.models[i];
    ASSERT_EQ(a.estimate.size(), b.estimate.size());
    EXPECT_EQ(a.evaluation.ate_m.mean, b.evaluation.ate_m.mean);
    for (std::size_t k = 0; k < a.estimate.size(); ++k) {
      ASSERT_EQ(a.estimate[k].x_m, b.estimate[k].x_m);
      ASSERT_EQ(a.estimate[k].covariance, b.estimate[k].covariance);
    }
  }
  EXPECT_EQ(once.anchor_errors_m, again.anchor_errors_m);
  EXPECT_EQ(once.ranges_per_s, again.ranges_per_s);
  ASSERT_EQ(once.calibration.calibration.anchors.size(), again.calibration.calibration.anchors.size());
  EXPECT_EQ(once.calibration.calibration.input_sha256, again.calibration.calibration.input_sha256);

  options.site.seed = 8;
  EXPECT_NE(run_demo(site, options).anchor_errors_m, once.anchor_errors_m);
}

TEST(Demo, TheDrivesAreDataSetsWithTheirTruth) {
  const DemoResult result = run_demo(small_site(), {});
  EXPECT_GT(result.first_drive.ranges.size(), 500U);
  EXPECT_FALSE(result.second_drive.odometry.empty());
  EXPECT_FALSE(result.second_drive.pose_prior.empty());
  // Samples that were still queued at the end of the first drive belong to the second.
  EXPECT_NEAR(result.first_drive.odometry.back().t_s, result.second_drive.odometry.front().t_s, 0.021);
  EXPECT_LE(result.first_drive.ground_truth.back().t_s, result.second_drive.ground_truth.front().t_s);
}

}  // namespace
}  // namespace groma::simulation
