#include "host/daemon/last_pose.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "host/io/input_file.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

LastPose some_pose() {
  LastPose pose;
  pose.time = {1.7e9 + 0.125, 1000.5, "boot-1"};
  pose.calibration = "abc";
  pose.floor = "upper \"deck\"";
  pose.x_m = 1.0 / 3.0;
  pose.y_m = -2.5e-7;
  pose.yaw_rad = 3.1;
  pose.covariance << 0.04, 0.01, 0.001, 0.01, 0.09, -0.002, 0.001, -0.002, 0.0025;
  return pose;
}

model::Surface two_floors() {
  return model::Surface({{"lower", model::Plane(0.0, {0.0, 0.0, 1.0}), {}, {}},
                         {"upper \"deck\"", model::Plane(3.0, {0.0, 0.0, 1.0}), {}, {}}});
}

TEST(LastPose, IsReadAsItWasWritten) {
  const LastPose pose = some_pose();
  const auto read = parse_last_pose(format_last_pose(pose));
  ASSERT_TRUE(read);
  EXPECT_EQ(read->time.unix_s, pose.time.unix_s);
  EXPECT_EQ(read->time.since_boot_s, pose.time.since_boot_s);
  EXPECT_EQ(read->time.boot, pose.time.boot);
  EXPECT_EQ(read->calibration, pose.calibration);
  EXPECT_EQ(read->floor, pose.floor);
  EXPECT_EQ(read->x_m, pose.x_m);
  EXPECT_EQ(read->y_m, pose.y_m);
  EXPECT_EQ(read->yaw_rad, pose.yaw_rad);
  EXPECT_EQ(read->covariance, pose.covariance);
}

TEST(LastPose, IsRefusedIfDamaged) {
  const std::string good = format_last_pose(some_pose());
  for (std::size_t size = 0; size + 1 < good.size(); ++size)
    EXPECT_FALSE(parse_last_pose(std::string_view(good).substr(0, size))) << size;
  for (const auto& [from, to] : {std::pair<std::string, std::string>{"\"schema\":1", "\"schema\":2"},
                                 {"3.1", "null"},
                                 {"3.1", "1e300"},
                                 {"[0.04", "[-0.04"},
                                 {"[0.04,", "["},
                                 {"\"boot-1\"", "7"},
                                 {"-2.5e-07", "1e12"}}) {
    std::string text = good;
    ASSERT_NE(text.find(from), std::string::npos) << from << " in " << good;
    text.replace(text.find(from), from.size(), to);
    EXPECT_FALSE(parse_last_pose(text)) << text;
  }
}

TEST(LastPose, AgesByTheClockOfTheBootOrByTheDate) {
  const LastPose pose = some_pose();
  // The date was set within one boot.
  EXPECT_EQ(age_s(pose, {1.8e9, 1003.0, "boot-1"}), 2.5);
  EXPECT_EQ(age_s(pose, {1.7e9 + 60.125, 12.0, "boot-2"}), 60.0);
  EXPECT_FALSE(age_s(pose, {1000.0, 12.0, "boot-2"})) << "the clock is not set yet";
  const HostTime now = host_time();
  EXPECT_GT(now.unix_s, 1.6e9);
  EXPECT_GT(now.since_boot_s, 0.0);
}

TEST(LastPose, IsLessCertainTheOlderItIs) {
  const LastPose pose = some_pose();
  const model::Surface surface = two_floors();
  const double largest_m = std::sqrt(0.065 + std::hypot(0.025, 0.01));
  const auto fresh = start_from(pose, 0.0, surface);
  ASSERT_TRUE(fresh);
  EXPECT_EQ(fresh->pose.chart, 1);
  EXPECT_EQ(fresh->pose.theta_rad, 3.1);
  EXPECT_NEAR(fresh->position_sigma_m, largest_m, 1e-12);
  EXPECT_NEAR(fresh->heading_sigma_rad, 0.05, 1e-12);
  const auto later = start_from(pose, 2.0, surface);
  EXPECT_NEAR(later->position_sigma_m, std::hypot(largest_m, 1.0), 1e-12);
  EXPECT_NEAR(later->heading_sigma_rad, std::hypot(0.05, 0.2), 1e-12);
  const auto old = start_from(pose, 1e6, surface);
  EXPECT_NEAR(old->position_sigma_m, std::hypot(largest_m, 3.0), 1e-12);
  EXPECT_EQ(start_from(pose, std::nullopt, surface)->position_sigma_m, old->position_sigma_m);

  LastPose elsewhere = pose;
  elsewhere.floor = "gone";
  EXPECT_FALSE(start_from(elsewhere, 0.0, surface));
  EXPECT_TRUE(start_from(elsewhere, 0.0, model::Surface())) << "one floor needs no name";
}

class PoseFile : public ::testing::Test {
 protected:
  LastPoseFile make() {
    return {folder_ / "last-pose.json", [this](std::string_view text) { log_.emplace_back(text); }};
  }
  static PoseEstimate at(double x_m) {
    PoseEstimate pose;
    pose.x_m = x_m;
    pose.planar_covariance.diagonal() << 0.01, 0.01, 0.0004;
    return pose;
  }
  // x_m in the file.
  double written() const {
    const auto pose = parse_last_pose(io::read_file(folder_ / "last-pose.json"));
    return pose ? pose->x_m : std::numeric_limits<double>::quiet_NaN();
  }

  TemporaryFolder folder_;
  model::Calibration calibration_;
  model::Surface surface_;
  std::vector<std::string> log_;
};

TEST_F(PoseFile, StartsFromThePoseOfTheRunBefore) {
  {
    LastPoseFile file = make();
    EXPECT_FALSE(file.read(calibration_, surface_));
    file.take(at(1.0), 0.0);
    file.take(at(1.5), 0.02);
    file.finish();
  }
  EXPECT_THAT(log_, IsEmpty());
  EXPECT_EQ(written(), 1.5);
  const auto start = make().read(calibration_, surface_);
  ASSERT_TRUE(start);
  EXPECT_EQ(start->pose.x_m, 1.5);
  EXPECT_GE(start->position_sigma_m, 0.1);
  EXPECT_LT(start->position_sigma_m, 3.1);
  EXPECT_THAT(log_, ElementsAre(HasSubstr("starts from the last pose, ")));
}

TEST_F(PoseFile, RefusesAPoseOfAnotherCalibrationOrADamagedFile) {
  {
    LastPoseFile file = make();
    EXPECT_FALSE(file.read(calibration_, surface_));
    file.take(at(1.0), 0.0);
    file.finish();
  }
  model::Calibration other = calibration_;
  other.frame = "elsewhere";
  EXPECT_FALSE(make().read(other, surface_));
  folder_.write("last-pose.json", "{\"schema\":1");
  EXPECT_FALSE(make().read(calibration_, surface_));
  std::filesystem::remove(folder_ / "last-pose.json");
  std::filesystem::create_directory(folder_ / "last-pose.json");
  EXPECT_FALSE(make().read(calibration_, surface_));
  ASSERT_EQ(log_.size(), 3U);
  EXPECT_THAT(log_[0], HasSubstr("the last pose is not used: the calibration has changed since"));
  EXPECT_THAT(log_[1], HasSubstr("the last pose is not used: the file is damaged"));
  EXPECT_THAT(log_[2], HasSubstr("cannot be read"));
}

TEST_F(PoseFile, IsWrittenOnceASecondAndSeldomWhileTheRobotIsStationary) {
  LastPoseFile file = make();
  EXPECT_FALSE(file.read(calibration_, surface_));
  std::size_t writes = 0;
  double last = -1.0;
  // A finished write shows as new content; each pose has content of its own.
  const auto count = [&] {
    if (!std::filesystem::exists(folder_ / "last-pose.json")) return;
    const double now = written();
    writes += now != last ? 1U : 0U;
    last = now;
  };
  for (int i = 0; i < 500; ++i) {
    file.take(at(0.03 * i), 0.02 * i);
    count();
  }
  file.finish();
  count();
  EXPECT_LE(writes, 11U);
  EXPECT_EQ(last, 0.03 * 499);
  writes = 0;
  for (int i = 500; i < 3000; ++i) {
    file.take(at(0.03 * 499 + 1e-6 * i), 0.02 * i);
    count();
  }
  EXPECT_EQ(writes, 0U);
}

TEST_F(PoseFile, SaysOnceThatItCannotBeWritten) {
  LastPoseFile file(folder_ / "none" / "last-pose.json",
                    [this](std::string_view text) { log_.emplace_back(text); });
  EXPECT_FALSE(file.read(calibration_, surface_));
  for (int i = 0; i < 3; ++i) {
    file.take(at(i), 2.0 * i);
    file.finish();
  }
  EXPECT_THAT(log_, ElementsAre(HasSubstr("cannot be written")));
}

}  // namespace
}  // namespace groma::daemon
