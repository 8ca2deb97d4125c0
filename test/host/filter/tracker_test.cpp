#include "host/filter/tracker.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <numbers>
#include <utility>
#include <vector>

#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"

namespace groma::filter {
namespace {

using model::square;
using test::Random;

constexpr testing::DriveOptions kMinute{.duration_s = 60.0, .range_s = 0.01};

// One site for all drives of a test.
class TrackerTest : public ::testing::TestWithParam<std::uint64_t> {
 protected:
  TrackerTest() : random_(GetParam()) {
    Config config;
    config.odometry = {0.03, 0.03, 0.01};
    tracker_ = std::make_unique<Tracker>(surface_, testing::three_tags(), calibration_, config);
  }

  testing::Drive drive(const model::PlanarPose& start, const testing::DriveOptions& options = kMinute) {
    return testing::drive(surface_, calibration_, start, options, random_);
  }

  // Feeds all inputs by time, odometry first, and only the ranges that `keep` accepts. Records the tracker's
  // state and error after each odometry sample.
  void run(const testing::Drive& drive, double shift_s = 0.0,
           const std::function<bool(const model::RangeSample&)>& keep = {}) {
    std::size_t next = 0;
    for (std::size_t i = 0; i < drive.odometry.size(); ++i) {
      model::OdometrySample row = drive.odometry[i];
      for (; next < drive.ranges.size() && drive.ranges[next].t_s < row.t_s; ++next) {
        if (keep && !keep(drive.ranges[next])) continue;
        model::RangeSample range = drive.ranges[next];
        range.t_s += shift_s;
        tracker_->process(range);
      }
      const double now_s = elapsed_s_ + row.t_s;
      row.t_s += shift_s;
      tracker_->process(row);
      note(now_s, drive.truth[i]);
    }
    elapsed_s_ += drive.odometry.back().t_s + 0.05;
  }

  void note(double now_s, const model::PlanarPose& truth) {
    Moment moment{now_s, tracker_->state(), tracker_->reason(), 0.0, 0.0};
    if (tracker_->started()) {
      const Estimate estimate = tracker_->estimate();
      moment.squared = testing::squared_error(estimate, truth);
      moment.error_m = std::hypot(estimate.pose.x_m - truth.x_m, estimate.pose.y_m - truth.y_m);
    }
    wrong_s_ = moment.state == State::kTracking && moment.squared > 34.6 ? wrong_s_ + 0.05 : 0.0;
    longest_wrong_s_ = std::max(longest_wrong_s_, wrong_s_);
    moments_.push_back(moment);
  }

  struct Moment {
    double t_s;
    State state;
    Reason reason;
    double squared;  // e' P^-1 e
    double error_m;
  };

  [[nodiscard]] bool was(State state, double from_s, double to_s) const {
    return std::any_of(moments_.begin(), moments_.end(), [&](const Moment& moment) {
      return moment.state == state && moment.t_s >= from_s && moment.t_s < to_s;
    });
  }
  [[nodiscard]] bool was(Reason reason, double from_s, double to_s) const {
    return std::any_of(moments_.begin(), moments_.end(), [&](const Moment& moment) {
      return moment.state == State::kDegraded && moment.reason == reason && moment.t_s >= from_s &&
             moment.t_s < to_s;
    });
  }
  // Time from which the state is TRACKING until the end; infinity if it is not at the end.
  [[nodiscard]] double tracks_from_s() const {
    double from_s = std::numeric_limits<double>::infinity();
    for (const Moment& moment : moments_) {
      if (moment.state != State::kTracking) from_s = std::numeric_limits<double>::infinity();
      if (moment.state == State::kTracking && std::isinf(from_s)) from_s = moment.t_s;
    }
    return from_s;
  }
  // TRACKING for more than 2 s with an error above 34.6 (the probability of 5 sigma in one dimension).
  [[nodiscard]] bool was_overconfident() const { return longest_wrong_s_ > 2.0; }

  Random random_;
  model::Surface surface_ = testing::hills(0.2);
  model::Calibration calibration_ = testing::six_anchors(0.3);
  std::unique_ptr<Tracker> tracker_;
  std::vector<Moment> moments_;
  double elapsed_s_ = 0.0;
  double wrong_s_ = 0.0;
  double longest_wrong_s_ = 0.0;
};

constexpr model::PlanarPose kHere{2.0, -3.0, 0.5};

TEST_P(TrackerTest, TracksFromAKnownStart) {
  const testing::Drive known = drive(kHere);
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(known);
  EXPECT_LT(tracks_from_s(), 2.0);
  EXPECT_FALSE(was_overconfident());
  EXPECT_EQ(tracker_->relocations(), 0U);
}

TEST_P(TrackerTest, StartsWithoutAPrior) {
  run(drive({random_.uniform(-6.0, 6.0), random_.uniform(-6.0, 6.0), random_.uniform(-3.0, 3.0)}));
  EXPECT_EQ(moments_.front().state, State::kUninitialized);
  EXPECT_TRUE(was(State::kConverging, 0.0, 10.0));
  EXPECT_LT(tracks_from_s(), 10.0);
  EXPECT_LT(moments_.back().error_m, 0.5);
  EXPECT_FALSE(was_overconfident());
}

TEST_P(TrackerTest, RecoversFromAWrongStart) {
  const testing::Drive wrong = drive(kHere);
  tracker_->start(
      {.t_s = 0.0, .pose = {kHere.x_m + 3.0, kHere.y_m + 4.0, kHere.theta_rad + 0.5 * std::numbers::pi}});
  run(wrong);
  EXPECT_LT(tracks_from_s(), 10.0);
  EXPECT_FALSE(was_overconfident());
  EXPECT_LT(moments_.back().error_m, 0.5);
}

TEST_P(TrackerTest, FindsAKidnappedRobot) {
  tracker_->start({.t_s = 0.0, .pose = kHere});
  const testing::Drive before = drive(kHere, {.duration_s = 20.0, .range_s = 0.01});
  run(before);
  run(drive({-6.0, 5.0, -2.0}, {.duration_s = 30.0, .range_s = 0.01}), 20.0);
  EXPECT_LT(tracks_from_s(), 30.0);
  EXPECT_TRUE(was(State::kDegraded, 20.0, 24.0) || was(State::kLost, 20.0, 24.0));
  EXPECT_FALSE(was_overconfident());
  EXPECT_LT(moments_.back().error_m, 0.5);
}

// Passing a gate: for seconds the ranges of all tags are too long, much as if the robot were a step aside.
TEST_P(TrackerTest, DoesNotRelocateDuringNlos) {
  tracker_->start({.t_s = 0.0, .pose = kHere});
  testing::Drive nlos = drive(kHere);
  const Eigen::Vector2d aside(0.0, 0.8);
  for (model::RangeSample& range : nlos.ranges) {
    if (range.t_s < 20.0 || range.t_s > 30.0) continue;
    const auto anchor = std::find_if(calibration_.anchors.begin(), calibration_.anchors.end(),
                                     [&](const auto& of) { return of.id == range.anchor_id; });
    const model::PlanarPose& pose = nlos.truth.at(static_cast<std::size_t>(range.t_s / 0.05));
    const Eigen::Vector2d from = Eigen::Vector2d(pose.x_m, pose.y_m) - anchor->position_m.head<2>();
    range.range_m += std::max((from + aside).norm() - from.norm(), 0.0);
  }
  run(nlos);
  EXPECT_TRUE(was(Reason::kRangesDisagree, 20.0, 30.0));
  EXPECT_FALSE(was(State::kLost, 0.0, 60.0));
  EXPECT_EQ(tracker_->relocations(), 0U);
  EXPECT_FALSE(was_overconfident());
  EXPECT_LT(moments_.back().error_m, 0.3);
}

TEST_P(TrackerTest, ReportsMissingRangesAndRecovers) {
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(drive(kHere), 0.0,
      [](const model::RangeSample& range) { return range.t_s < 10.0 || range.t_s > 40.0; });
  EXPECT_TRUE(was(Reason::kNoRanges, 10.0, 12.0));
  EXPECT_FALSE(was(State::kTracking, 12.0, 40.0));
  EXPECT_LT(tracks_from_s(), 50.0);
  EXPECT_GE(tracks_from_s(), 40.0);
  EXPECT_FALSE(was_overconfident());
}

// Odometry pauses for a while; ranges continue or pause, too.
TEST_P(TrackerTest, AfterAnOdometryPauseTracksOnlyOnceRangesAgree) {
  for (const bool ranges : {true, false}) {
    SCOPED_TRACE(ranges);
    moments_.clear();
    elapsed_s_ = 0.0;
    Config config;
    config.odometry = {0.03, 0.03, 0.01};
    tracker_ = std::make_unique<Tracker>(surface_, testing::three_tags(), calibration_, config);
    tracker_->start({.t_s = 0.0, .pose = kHere});
    testing::Drive paused = drive(kHere, {.duration_s = 40.0, .range_s = 0.01});
    const auto in_pause = [](double t_s) { return t_s >= 20.0 && t_s < 25.0; };
    testing::Drive left = paused;
    left.odometry.clear();
    left.truth.clear();
    for (std::size_t i = 0; i < paused.odometry.size(); ++i) {
      if (in_pause(paused.odometry[i].t_s)) continue;
      left.odometry.push_back(paused.odometry[i]);
      left.truth.push_back(paused.truth[i]);
    }
    run(left, 0.0, [&](const model::RangeSample& range) { return ranges || !in_pause(range.t_s); });
    // The first inputs after such a jump in time are not accepted yet and change nothing.
    EXPECT_FALSE(was(State::kTracking, 25.04, 25.5));
    EXPECT_LT(tracks_from_s(), 35.0);
    EXPECT_FALSE(was_overconfident());
    EXPECT_LT(moments_.back().error_m, 0.5);
  }
}

TEST_P(TrackerTest, ReportsASilentTagAndContinues) {
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(drive(kHere), 0.0, [](const model::RangeSample& range) {
    return range.tag_id != 2 || range.t_s < 20.0 || range.t_s > 40.0;
  });
  EXPECT_TRUE(was(Reason::kTagSilent, 20.0, 24.0));
  EXPECT_FALSE(was(State::kLost, 0.0, 60.0));
  EXPECT_LT(tracks_from_s(), 41.0);
  EXPECT_FALSE(was_overconfident());
}

TEST_P(TrackerTest, ContinuesAfterAClockStep) {
  for (const double step_s : {1000.0, -1000.0}) {
    SCOPED_TRACE(step_s);
    moments_.clear();
    elapsed_s_ = 0.0;
    const testing::Drive whole = drive(kHere, {.duration_s = 40.0, .range_s = 0.01});
    testing::Drive before = whole;
    testing::Drive after = whole;
    before.odometry.resize(400);
    before.truth.resize(400);
    std::erase_if(before.ranges, [](const auto& range) { return range.t_s >= 20.0; });
    after.odometry.erase(after.odometry.begin(), after.odometry.begin() + 400);
    after.truth.erase(after.truth.begin(), after.truth.begin() + 400);
    std::erase_if(after.ranges, [](const auto& range) { return range.t_s < 20.0; });
    Config config;
    config.odometry = {0.03, 0.03, 0.01};
    tracker_ = std::make_unique<Tracker>(surface_, testing::three_tags(), calibration_, config);
    tracker_->start({.t_s = 2000.0, .pose = kHere});
    run(before, 2000.0);
    elapsed_s_ = 0.0;
    run(after, 2000.0 + step_s);
    EXPECT_LT(tracks_from_s(), 30.0);
    EXPECT_FALSE(was_overconfident());
    EXPECT_LT(moments_.back().error_m, 0.5);
  }
}

TEST_P(TrackerTest, AcceptsInputsOutOfOrder) {
  const testing::Drive whole = drive(kHere);
  std::vector<std::pair<double, std::size_t>> order;  // odometry samples, then ranges
  for (std::size_t i = 0; i < whole.odometry.size(); ++i)
    order.emplace_back(whole.odometry[i].t_s + random_.uniform(0.0, 0.4), i);
  for (std::size_t i = 0; i < whole.ranges.size(); ++i)
    order.emplace_back(whole.ranges[i].t_s + random_.uniform(0.0, 0.4), whole.odometry.size() + i);
  std::sort(order.begin(), order.end());
  for (const auto& [arrival_s, i] : order) {
    if (i < whole.odometry.size()) {
      tracker_->process(whole.odometry[i]);
      if (whole.odometry[i].t_s >= tracker_->estimate().t_s) note(whole.odometry[i].t_s, whole.truth[i]);
    } else {
      tracker_->process(whole.ranges[i - whole.odometry.size()]);
    }
  }
  EXPECT_LT(tracks_from_s(), 12.0);
  EXPECT_FALSE(was_overconfident());
}

// Anchor ids permuted cyclically: the ranges are metres off at any pose.
std::vector<model::RangeSample> renumbered(std::vector<model::RangeSample> ranges, double until_s) {
  for (model::RangeSample& range : ranges) {
    if (range.t_s < until_s)
      range.anchor_id = static_cast<model::NodeId>(11 + (range.anchor_id - 11 + 2) % 6);
  }
  return ranges;
}

constexpr double kNamedWithin_s = 30.0;

TEST_P(TrackerTest, ReportsAWrongMapAndContinuesByOdometryOnly) {
  testing::Drive two_minutes = drive(kHere, {.duration_s = 120.0, .range_s = 0.01});
  two_minutes.ranges = renumbered(two_minutes.ranges, 120.0);
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(two_minutes);
  std::size_t tracking = 0;
  double squared = 0.0;
  for (const Moment& moment : moments_) {
    if (moment.state == State::kTracking) ++tracking;
    if (moment.t_s < kNamedWithin_s) continue;
    EXPECT_EQ(moment.reason, Reason::kMapMismatch);
    EXPECT_TRUE(moment.state == State::kDegraded || moment.state == State::kLost);
    squared += moment.squared;
  }
  EXPECT_LT(tracking, moments_.size() / 20);
  // As accurate as the same odometry without ranges.
  Config config;
  config.model = Model::kOdometry;
  config.odometry = {0.03, 0.03, 0.01};
  Filter alone(surface_, testing::three_tags(), calibration_, config);
  alone.start({.t_s = 0.0, .pose = kHere});
  double squared_alone = 0.0;
  for (std::size_t i = 0; i < two_minutes.odometry.size(); ++i) {
    alone.process(two_minutes.odometry[i]);
    if (moments_[i].t_s >= kNamedWithin_s)
      squared_alone += testing::squared_error(alone.estimate(), two_minutes.truth[i]);
  }
  EXPECT_NEAR(squared, squared_alone, 0.1 * squared_alone);
}

TEST_P(TrackerTest, IsLostOnAWrongMapWithoutAPrior) {
  testing::Drive minute = drive(kHere);
  minute.ranges = renumbered(minute.ranges, 60.0);
  run(minute);
  EXPECT_EQ(tracker_->reason(), Reason::kMapMismatch);
  EXPECT_EQ(tracker_->state(), State::kLost);
  EXPECT_FALSE(was_overconfident());
  if (!tracker_->started()) return;
  EXPECT_LT(moments_.back().squared / 3.0, 4.0);
}

TEST_P(TrackerTest, TracksAgainWhenTheMapIsRightAgain) {
  testing::Drive long_one = drive(kHere, {.duration_s = 240.0, .range_s = 0.01});
  long_one.ranges = renumbered(long_one.ranges, 40.0);
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(long_one);
  EXPECT_TRUE(was(Reason::kMapMismatch, 30.0, 40.0) || was(State::kLost, 30.0, 40.0));
  EXPECT_LT(tracks_from_s(), 180.0);
  EXPECT_LT(moments_.back().error_m, 0.5);
  EXPECT_FALSE(was_overconfident());
}

TEST_P(TrackerTest, OneMovedAnchorIsNoWrongMap) {
  testing::Drive minute = drive(kHere);
  for (model::RangeSample& range : minute.ranges) {
    if (range.anchor_id == 12) range.range_m += 2.5;
  }
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(minute);
  EXPECT_FALSE(was(Reason::kMapMismatch, 0.0, 60.0));
  EXPECT_FALSE(was_overconfident());
}

// The original model of the source paper has no biases: unmodelled biases must not be reported as a wrong
// map.
TEST_P(TrackerTest, UnmodelledBiasesAreNoWrongMap) {
  Config config;
  config.model = Model::kOriginal;
  config.odometry = {0.03, 0.03, 0.01};
  for (model::AnchorCalibration& anchor : calibration_.anchors) {
    for (model::PairBias& pair : anchor.pairs) pair.beta_m += anchor.id % 2 == 0 ? 1.2 : 0.2;
  }
  tracker_ = std::make_unique<Tracker>(surface_, testing::three_tags(), calibration_, config);
  tracker_->start({.t_s = 0.0, .pose = kHere});
  run(drive(kHere));
  for (const Moment& moment : moments_) EXPECT_NE(moment.reason, Reason::kMapMismatch);
}

TEST_P(TrackerTest, AllocatesNothing) {
  const testing::Drive first = drive(kHere, {.duration_s = 5.0, .range_s = 0.01});
  const testing::Drive second = drive({-6.0, 5.0, -2.0}, {.duration_s = 10.0, .range_s = 0.01});
  const std::size_t before = test::allocations();
  for (const auto* one : {&first, &second}) {
    std::size_t next = 0;
    for (const model::OdometrySample& row : one->odometry) {
      for (; next < one->ranges.size() && one->ranges[next].t_s < row.t_s; ++next)
        tracker_->process(one->ranges[next]);
      tracker_->process(row);
    }
  }
  EXPECT_EQ(test::allocations(), before);
  EXPECT_TRUE(tracker_->started());
}

// An input whose time is far off is refused, unless several agree: see ContinuesAfterAClockStep.
TEST_P(TrackerTest, IgnoresASingleWrongTime) {
  Config config;
  config.odometry = {0.03, 0.03, 0.01};
  Tracker undisturbed(surface_, testing::three_tags(), calibration_, config);
  const testing::Drive ten_seconds = drive(kHere, {.duration_s = 10.0, .range_s = 0.01});
  for (Tracker* tracker : {tracker_.get(), &undisturbed}) tracker->start({.t_s = 0.0, .pose = kHere});
  std::size_t next = 0;
  for (std::size_t i = 0; i < ten_seconds.odometry.size(); ++i) {
    const model::OdometrySample& row = ten_seconds.odometry[i];
    for (; next < ten_seconds.ranges.size() && ten_seconds.ranges[next].t_s < row.t_s; ++next) {
      tracker_->process(ten_seconds.ranges[next]);
      undisturbed.process(ten_seconds.ranges[next]);
    }
    tracker_->process(row);
    undisturbed.process(row);
    if (i % 20 != 10) continue;
    for (const double off_s : {-1000.0, 1000.0}) {
      model::OdometrySample wrong = row;
      wrong.t_s += off_s;
      EXPECT_EQ(tracker_->process(wrong), OdometryOutcome::kOutOfOrder);
      model::RangeSample range = ten_seconds.ranges[next];
      range.t_s -= off_s;
      EXPECT_EQ(tracker_->process(range).outcome, RangeOutcome::kOutOfOrder);
    }
  }
  EXPECT_EQ(tracker_->state(), undisturbed.state());
  EXPECT_EQ(tracker_->filter().filter().core(), undisturbed.filter().filter().core());
  EXPECT_EQ(tracker_->estimate().covariance, undisturbed.estimate().covariance);
}

// GNSS or another localization, without any range.
TEST_P(TrackerTest, PositionsOfAnotherSensorReplaceRanges) {
  const testing::Drive silent = drive(kHere, {.duration_s = 5.0});
  for (const bool poses : {false, true}) {
    SCOPED_TRACE(poses);
    Config config;
    config.odometry = {0.03, 0.03, 0.01};
    Tracker tracker(surface_, testing::three_tags(), calibration_, config);
    tracker.start({.t_s = 0.0, .pose = kHere}, State::kTracking);
    for (std::size_t i = 0; i < silent.odometry.size(); ++i) {
      const double t_s = silent.odometry[i].t_s;
      tracker.process(silent.odometry[i]);
      if (t_s < 3.9) EXPECT_EQ(tracker.state(), State::kTracking) << t_s;
      if (t_s > 4.1) EXPECT_EQ(tracker.reason(), Reason::kNoRanges) << t_s;
      if (i % 4 != 0 || t_s > 3.01) continue;
      const model::PlanarPose& truth = silent.truth[i];
      if (poses) {
        tracker.process(
            model::PoseSample{.t_s = t_s,
                              .x_m = truth.x_m,
                              .y_m = truth.y_m,
                              .yaw_rad = truth.theta_rad,
                              .covariance = model::PoseCovariance{0.01, 0.0, 0.0, 0.01, 0.0, 0.0025}});
      } else {
        tracker.process(model::PositionSample{
            .t_s = t_s, .x_m = truth.x_m, .y_m = truth.y_m, .covariance_m2 = {0.01, 0.0, 0.01}});
      }
    }
  }
}

TEST(Tracker, IsUncertainWhileTheHeadingIs) {
  for (const double heading_sigma_rad : {0.1, 0.6}) {
    Tracker tracker(model::Surface(), testing::three_tags(), testing::six_anchors(),
                    testing::config_of(Model::kSchmidt));
    tracker.start({.t_s = 0.0, .heading_sigma_rad = heading_sigma_rad}, State::kTracking);
    tracker.process(model::OdometrySample{0.05, 0.0, 0.0, 0.0});
    const bool is_uncertain = heading_sigma_rad > 0.3;
    EXPECT_EQ(tracker.state(), is_uncertain ? State::kDegraded : State::kTracking);
    EXPECT_EQ(tracker.reason(), is_uncertain ? Reason::kUncertain : Reason::kNone);
  }
}

TEST(Tracker, GivesTheEstimateAtALateOdometrySample) {
  Tracker tracker(model::Surface(), testing::three_tags(), testing::six_anchors(),
                  testing::config_of(Model::kSchmidt));
  tracker.start({});
  for (const double t_s : {0.0, 0.1, 0.3, 0.2}) tracker.process(model::OdometrySample{t_s, 1.0, 0.0, 0.0});
  EXPECT_EQ(tracker.estimate().t_s, 0.3);
  EXPECT_EQ(tracker.sample_estimate().t_s, 0.2);
  EXPECT_NEAR(tracker.sample_estimate().pose.x_m, 0.2, 1e-12);
}

INSTANTIATE_TEST_SUITE_P(Seeds, TrackerTest, ::testing::Values(1, 2, 3, 4, 5, 6));

}  // namespace
}  // namespace groma::filter
