#include "host/daemon/pipeline.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "test/host/daemon/circle_drive.hpp"
#include "test/support/allocations.hpp"

namespace groma::daemon {
namespace {

using test::CircleDrive;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class PipelineTest : public ::testing::Test {
 protected:
  PipelineTest() { poses_.reserve(10'000); }

  std::unique_ptr<Pipeline> make() {
    return std::make_unique<Pipeline>(
        config_, [this](std::string_view text) { log_.emplace_back(text); },
        [this](const PoseEstimate& pose) { poses_.push_back(pose); },
        [this](const PoseEstimate& /*pose*/) { ++settled_; });
  }

  static void give(Pipeline& pipeline, const CircleDrive::Arrival& arrival) {
    if (arrival.robot) {
      pipeline.robot_bytes(arrival.bytes, arrival.host_s);
    } else {
      pipeline.node_bytes(0, arrival.bytes, arrival.host_s);
    }
  }

  static double error_m(const PoseEstimate& pose) {
    const auto truth = CircleDrive::truth(pose.t_s);
    return std::hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m);
  }

  CircleDrive drive_;
  Config config_ = drive_.config();
  std::vector<std::string> log_;
  std::vector<PoseEstimate> poses_;
  std::size_t settled_ = 0;
};

TEST_F(PipelineTest, GivesAPoseForEachOdometrySampleAtOnce) {
  const auto pipeline = make();
  EXPECT_EQ(pipeline->state(CircleDrive::kBegin_s), "CALIBRATION_DRIVE");
  pipeline->adopt(drive_.surveyed());
  EXPECT_EQ(pipeline->state(CircleDrive::kBegin_s), "UNINITIALIZED");
  std::size_t late = 0;
  const auto arrivals = drive_.arrivals(10.0);
  for (const CircleDrive::Arrival& arrival : arrivals) {
    const std::size_t before = poses_.size();
    give(*pipeline, arrival);
    const bool started = arrival.host_s > CircleDrive::kBegin_s + 1.0;
    if (started && arrival.robot && poses_.size() != before + 1) ++late;
  }
  EXPECT_EQ(late, 0U);
  EXPECT_EQ(poses_.back().state, filter::State::kTracking);
  EXPECT_LT(error_m(poses_.back()), 0.1);
  EXPECT_GT(settled_, 900U);
  const double end_s = arrivals.back().host_s;
  EXPECT_EQ(pipeline->state(end_s), "TRACKING");
  EXPECT_EQ(pipeline->state(end_s + 2.0), "WAITING_FOR_ODOMETRY");
  EXPECT_GE(pipeline->status(end_s).odometry, settled_);
  EXPECT_EQ(pipeline->status(end_s).dropped, 0U);
  EXPECT_THAT(log_, testing::Contains(HasSubstr("localizes with model")));
}

// From the bytes of a link to the pose that the outputs are given, and the work of the filter after that.
TEST_F(PipelineTest, UsesNoHeapForBytesAndPoses) {
  const auto pipeline = make();
  pipeline->adopt(drive_.surveyed());
  const auto arrivals = drive_.arrivals(15.0);
  const auto middle = arrivals.begin() + static_cast<std::ptrdiff_t>(arrivals.size() / 2);
  std::for_each(arrivals.begin(), middle, [&](const auto& arrival) { give(*pipeline, arrival); });
  ASSERT_EQ(poses_.back().state, filter::State::kTracking);
  const std::size_t poses_before = poses_.size();
  const std::size_t ranges_before = pipeline->session().counters().ranges;
  const std::size_t before = groma::test::allocations();
  std::for_each(middle, arrivals.end(), [&](const auto& arrival) {
    give(*pipeline, arrival);
    pipeline->advance(arrival.host_s + 0.001);
  });
  EXPECT_EQ(groma::test::allocations(), before);
  EXPECT_GE(poses_.size(), poses_before + 700);
  EXPECT_GE(pipeline->session().counters().ranges, ranges_before + 400);
}

// The same calls give the same poses, however long they take.
TEST_F(PipelineTest, RepeatsItselfBitForBit) {
  std::vector<std::string> runs;
  for (int run = 0; run < 2; ++run) {
    poses_.clear();
    const auto pipeline = make();
    pipeline->adopt(drive_.surveyed());
    for (const CircleDrive::Arrival& arrival : drive_.arrivals(5.0)) give(*pipeline, arrival);
    std::string lines;
    for (const PoseEstimate& pose : poses_) lines += pose_line(pose, pipeline->frame(), "schmidt");
    runs.push_back(lines);
  }
  EXPECT_GT(std::count(runs[0].begin(), runs[0].end(), '\n'), 400);
  EXPECT_EQ(runs[0], runs[1]);
}

TEST_F(PipelineTest, LogsTwoLinksThatReportOneTag) {
  config_.nodes.push_back({"tag-1-again", 1'000'000});
  const auto pipeline = make();
  const auto run = [&](const std::vector<CircleDrive::Arrival>& arrivals, const auto& takes) {
    double checked_s = arrivals.front().host_s;
    for (const CircleDrive::Arrival& arrival : arrivals) {
      const double since_s = arrival.host_s - arrivals.front().host_s;
      for (const std::size_t node : {0U, 1U}) {
        if (!arrival.robot && takes(node, since_s)) pipeline->node_bytes(node, arrival.bytes, arrival.host_s);
      }
      if (arrival.host_s < checked_s + Pipeline::kStatusPeriod_s) continue;
      checked_s = arrival.host_s;
      pipeline->log_faults();
    }
  };
  const auto arrivals = drive_.arrivals(20.0);
  const auto middle = arrivals.begin() + static_cast<std::ptrdiff_t>(arrivals.size() / 2);
  // The tag changes its port.
  run({arrivals.begin(), middle}, [](std::size_t node, double t_s) { return node == (t_s < 4.5 ? 0U : 1U); });
  EXPECT_THAT(log_, ElementsAre());
  run({middle, arrivals.end()}, [](std::size_t /*node*/, double /*t_s*/) { return true; });
  EXPECT_THAT(log_,
              ElementsAre("tag-1 and tag-1-again: both report tag 1, so that its ranges count twice; remove "
                          "one of them from `nodes`"));
}

// Also before the first calibration, the first odometry and the first range.
TEST_F(PipelineTest, ContinuesFromAStateThatWasReadBackBitForBit) {
  const auto arrivals = drive_.arrivals(5.0);
  const auto whole = make();
  constexpr std::array<std::size_t, 9> kBegins{0, 1, 2, 3, 4, 50, 51, 200, 301};
  std::map<std::size_t, std::string> states;  // before these arrivals
  std::vector<std::size_t> poses;
  for (std::size_t i = 0; i < arrivals.size(); ++i) {
    poses.push_back(poses_.size());
    if (std::find(kBegins.begin(), kBegins.end(), i) != kBegins.end()) {
      model::StateArchive archive(states[i]);
      archive(*whole);
    }
    if (i == 1) whole->adopt(drive_.surveyed());
    give(*whole, arrivals[i]);
  }
  const std::vector<PoseEstimate> expected = poses_;
  ASSERT_GT(expected.size(), 400U);
  for (const auto& [begin, state] : states) {
    poses_.clear();
    const auto pipeline = make();
    model::StateArchive archive{std::string_view(state)};
    archive(*pipeline);
    EXPECT_TRUE(archive.at_end());
    for (std::size_t i = begin; i < arrivals.size(); ++i) {
      if (i == 1) pipeline->adopt(drive_.surveyed());
      give(*pipeline, arrivals[i]);
    }
    ASSERT_EQ(poses_.size(), expected.size() - poses[begin]) << begin;
    for (std::size_t i = 0; i < poses_.size(); ++i) {
      ASSERT_EQ(pose_line(poses_[i], "map", "schmidt"),
                pose_line(expected[poses[begin] + i], "map", "schmidt"))
          << begin << ' ' << i;
    }
  }
}

TEST_F(PipelineTest, RefusesAStateThatIsNotWhole) {
  const auto pipeline = make();
  pipeline->adopt(drive_.surveyed());
  std::string state;
  model::StateArchive(state).operator()(*pipeline);
  for (std::size_t size = 0; size < state.size(); size += 1 + state.size() / 50) {
    const auto other = make();
    model::StateArchive archive{std::string_view(state).substr(0, size)};
    EXPECT_THROW(archive(*other), model::StateArchive::Mismatch) << size;
  }
}

TEST_F(PipelineTest, ContinuesWithTheCalibrationThatItAdopts) {
  const auto pipeline = make();
  model::Calibration part = drive_.surveyed();
  part.anchors.pop_back();
  pipeline->adopt(part);
  const auto arrivals = drive_.arrivals(10.0);
  const auto middle = arrivals.begin() + static_cast<std::ptrdiff_t>(arrivals.size() / 2);
  std::for_each(arrivals.begin(), middle, [&](const auto& arrival) { give(*pipeline, arrival); });
  ASSERT_EQ(poses_.back().state, filter::State::kTracking);
  const std::size_t count = poses_.size();
  pipeline->adopt(drive_.surveyed());
  EXPECT_EQ(pipeline->calibrations_adopted(), 2U);
  EXPECT_EQ(pipeline->localizer()->filter().anchors(), 6U);
  std::for_each(middle, arrivals.end(), [&](const auto& arrival) { give(*pipeline, arrival); });
  EXPECT_EQ(poses_.size(), count + static_cast<std::size_t>(std::count_if(
                                       middle, arrivals.end(), [](const auto& of) { return of.robot; })));
  for (std::size_t i = count; i < poses_.size(); ++i) EXPECT_LT(error_m(poses_[i]), 0.1) << i;
}

}  // namespace
}  // namespace groma::daemon
