#include "host/daemon/mistake_watch.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <cmath>
#include <thread>

#include "test/host/daemon/circle_drive.hpp"

namespace groma::daemon {
namespace {

using test::CircleDrive;

class MistakeWatchTest : public ::testing::Test {
 protected:
  explicit MistakeWatchTest(bool learns = false)
      : watch_({.priors = priors(),
                .surface = model::Plane(0.0, {0.0, 0.0, 1.0}),
                .learns = learns,
                .search_niceness = 0}) {
    watch_.use(model::surveyed_calibration(drive_.anchors, tags_, priors(), 0.02), tags_);
  }

  static model::RangePriors priors() {
    model::RangePriors out;
    out.sigma_m = 0.05;
    out.beta_m = {0.0, 0.05};
    return out;
  }

  // Drives on for this long, with odometry at 50 Hz and 60 ranges a second.
  void drive(double duration_s) {
    for (const double end_s = t_s_ + duration_s; t_s_ < end_s; t_s_ += 0.02) {
      watch_.on_odometry({t_s_, speed_scale_ * CircleDrive::kRadius_m * CircleDrive::kOmega_radps, 0.0,
                          CircleDrive::kOmega_radps});
      if (++ticks_ % 5 != 0) continue;
      const CircleDrive::Point at = CircleDrive::truth(t_s_);
      const Eigen::Vector3d tag_m(at.x_m, at.y_m, CircleDrive::kTagHeight_m);
      for (std::size_t i = 0; i < drive_.anchors.size(); ++i) {
        const double ripple_m = 0.03 * std::sin(1.7 * ticks_ + 2.3 * static_cast<double>(i));
        watch_.on_range({.t_s = t_s_,
                         .tag_id = 1,
                         .anchor_id = drive_.anchors[i].id,
                         .range_m = (tag_m - drive_.anchors[i].position_m).norm() + ripple_m});
      }
    }
  }
  // Services for this long, of the loop's time, and waits for what it started.
  void service(double duration_s) {
    for (const double end_s = now_s_ + duration_s; now_s_ < end_s; now_s_ += 1.0) watch_.service(now_s_);
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  // Until two searches are over, which under a sanitizer on a busy machine take a minute.
  bool names(const char* cause) {
    const auto deadline = std::chrono::steady_clock::now() + std::chrono::minutes(5);
    while (std::chrono::steady_clock::now() < deadline) {
      service(10.0);
      if (!watch_.findings().empty()) return watch_.findings().front().cause == cause;
      drive(1.0);
    }
    return false;
  }

  CircleDrive drive_;
  std::vector<model::Tag> tags_{{1, {0.0, 0.0, CircleDrive::kTagHeight_m}}};
  MistakeWatch watch_;
  double speed_scale_ = 1.0;
  double t_s_ = CircleDrive::kRobotOrigin_s;
  double now_s_ = 0.0;
  int ticks_ = 0;
};

TEST_F(MistakeWatchTest, NamesWhatTwoSearchesFindLogsItOnceAndForgetsItWithTheClock) {
  speed_scale_ = 1.2;
  drive(MistakeWatch::kLeast_s - 5.0);
  service(200.0);
  EXPECT_TRUE(watch_.findings().empty());
  ASSERT_TRUE(names("odometry-scale"));
  EXPECT_NEAR(watch_.findings().front().value.front(), 1.2, 0.02);
  ASSERT_EQ(watch_.take_news().size(), 1U);
  EXPECT_TRUE(watch_.take_news().empty());
  watch_.on_clock_set();
  EXPECT_TRUE(watch_.findings().empty());
}

TEST_F(MistakeWatchTest, NamesAnAnchorThatTheCalibrationLacks) {
  model::Calibration calibration = model::surveyed_calibration(drive_.anchors, tags_, priors(), 0.02);
  calibration.anchors.pop_back();
  watch_.use(calibration, tags_);
  drive(100.0);
  ASSERT_TRUE(names("unknown-anchor"));
  EXPECT_EQ(watch_.findings().front().of, std::vector<model::NodeId>{105});
}

TEST_F(MistakeWatchTest, NamesNothingOfAGoodDrive) {
  drive(200.0);
  for (int i = 0; i < 40; ++i) {
    service(10.0);
    drive(1.0);
  }
  EXPECT_TRUE(watch_.findings().empty());
}

class LearningMistakeWatchTest : public MistakeWatchTest {
 protected:
  LearningMistakeWatchTest() : MistakeWatchTest(/*learns=*/true) {}
};

TEST_F(LearningMistakeWatchTest, LeavesOutAnchorsThatAreLearned) {
  model::Calibration calibration = model::surveyed_calibration(drive_.anchors, tags_, priors(), 0.02);
  calibration.anchors.pop_back();
  watch_.use(calibration, tags_);
  drive(200.0);
  for (int i = 0; i < 60; ++i) {
    service(10.0);
    drive(1.0);
  }
  EXPECT_TRUE(watch_.findings().empty());
}

}  // namespace
}  // namespace groma::daemon
