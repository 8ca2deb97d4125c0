#include "host/model/odom_frame.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "test/support/random.hpp"

namespace groma::model {
namespace {

// Against small steps of Euler's method.
TEST(OdomFrame, IntegratesTheVelocitiesThatSamplesHold) {
  test::Random random(3);
  OdomFrame odom;
  PlanarPose expected;
  OdometrySample held{.t_s = 10.0, .vx_mps = 1.0, .omega_radps = 0.0};
  odom.take(held);
  for (int i = 0; i < 50; ++i) {
    OdometrySample next{.t_s = held.t_s + random.uniform(0.01, 0.4),
                        .vx_mps = random.uniform(-2.0, 2.0),
                        .vy_mps = random.uniform(-0.5, 0.5),
                        .omega_radps = random.uniform(-2.0, 2.0)};
    constexpr int kSteps = 2000;
    const double step_s = (next.t_s - held.t_s) / kSteps;
    for (int k = 0; k < kSteps; ++k) {
      const double middle_rad = expected.theta_rad + 0.5 * step_s * held.omega_radps;
      expected.x_m += step_s * (std::cos(middle_rad) * held.vx_mps - std::sin(middle_rad) * held.vy_mps);
      expected.y_m += step_s * (std::sin(middle_rad) * held.vx_mps + std::cos(middle_rad) * held.vy_mps);
      expected.theta_rad += step_s * held.omega_radps;
    }
    odom.take(next);
    held = next;
  }
  const auto pose = odom.pose();
  ASSERT_TRUE(pose);
  EXPECT_EQ(pose->t_s, held.t_s);
  EXPECT_TRUE(pose->is_integrated);
  EXPECT_NEAR(pose->pose.position_m.x(), expected.x_m, 1e-5);
  EXPECT_NEAR(pose->pose.position_m.y(), expected.y_m, 1e-5);
  const double yaw_rad = 2.0 * std::atan2(pose->pose.quaternion.z(), pose->pose.quaternion.w());
  EXPECT_NEAR(wrap_angle(yaw_rad - expected.theta_rad), 0.0, 1e-9);
}

TEST(OdomFrame, AGapOrASetClockMovesItLittle) {
  OdomFrame odom;
  EXPECT_FALSE(odom.pose());
  odom.take({.t_s = 0.0, .vx_mps = 1.0});
  odom.take({.t_s = 60.0, .vx_mps = 1.0});
  EXPECT_DOUBLE_EQ(odom.pose()->pose.position_m.x(), OdomFrame::kLongestHold_s);
  odom.shift_time(3600.0);
  odom.take({.t_s = 3660.1, .vx_mps = 1.0});
  EXPECT_NEAR(odom.pose()->pose.position_m.x(), OdomFrame::kLongestHold_s + 0.1, 1e-9);
  odom.forget_time();
  odom.take({.t_s = 5.0, .vx_mps = 1.0});
  EXPECT_NEAR(odom.pose()->pose.position_m.x(), OdomFrame::kLongestHold_s + 0.1, 1e-9);
}

}  // namespace
}  // namespace groma::model
