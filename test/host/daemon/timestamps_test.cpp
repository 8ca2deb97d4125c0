// Wrong timestamps, pauses and rates of the robot's messages, through a session and a localizer.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "host/daemon/odometry_merger.hpp"
#include "host/daemon/robot_clock.hpp"
#include "test/host/daemon/lock_step_drive.hpp"

namespace groma::daemon {
namespace {

using filter::Reason;
using filter::State;
using test::Kind;
using test::LockStepDrive;
using Sent = LockStepDrive::Sent;
using ::testing::Contains;
using ::testing::HasSubstr;

constexpr double kEvent_s = 18.0;
constexpr double kEnd_s = 30.0;
constexpr std::array kSizes_s{0.05, 0.12, 0.3, 0.5, 0.7, 0.95, 1.5, 3.0, 10.0, 100.0, 3600.0};

// Poses are scored from here on: the filter has converged.
constexpr double kSettled_s = 13.0;

double plain_error_m(bool sensors) {
  static const std::array<double, 2> kErrors = [] {
    std::array<double, 2> errors{};
    for (const bool with : {false, true}) {
      LockStepDrive drive({.sensors = with});
      drive.run(kEnd_s);
      EXPECT_EQ(drive.wrong_tracking(), 0);
      EXPECT_GT(drive.tracking_share(kSettled_s), 0.999);
      errors[with ? 1 : 0] = drive.mean_error_m(kSettled_s);
    }
    return errors;
  }();
  return kErrors[sensors ? 1 : 0];
}

enum class How { kAdded, kReplaced };

// Wrong timestamps of one kind of message, once at the event or each 5 s from then on.
LockStepDrive::Timestamps wrong_timestamps(Kind kind, double by_s, How how, bool repeated) {
  auto next_s = std::make_shared<double>(kEvent_s);
  return [=](Kind of, double t_s) -> std::vector<Sent> {
    if (of != kind || t_s < *next_s) return {t_s};
    *next_s = repeated ? *next_s + 5.0 : 1e9;
    if (how == How::kAdded) return {t_s, t_s + by_s};
    return {t_s + by_s};
  };
}

TEST(Timestamps, OneWrongOdometryTimestampCostsNothing) {
  for (const double size_s : kSizes_s) {
    for (const double by_s : {size_s, -size_s}) {
      for (const How how : {How::kAdded, How::kReplaced}) {
        for (const bool repeated : {false, true}) {
          SCOPED_TRACE(fmt::format("{} s, {}{}", by_s, how == How::kAdded ? "added" : "replaced",
                                   repeated ? ", each 5 s" : ""));
          LockStepDrive drive;
          drive.timestamps = wrong_timestamps(Kind::kOdometry, by_s, how, repeated);
          drive.run(kEnd_s);
          EXPECT_LT(drive.mean_error_m(kSettled_s), 1.2 * plain_error_m(false));
          EXPECT_EQ(drive.wrong_tracking(), 0);
          EXPECT_LT(drive.largest_gap_s(kSettled_s), 0.2);
          EXPECT_GT(drive.tracking_share(kSettled_s), 0.99);
          EXPECT_EQ(drive.session().counters().robot_clock_set, 0U);
        }
      }
    }
  }
}

TEST(Timestamps, OneWrongTimestampOfAnotherKindCostsNothing) {
  for (const Kind kind : {Kind::kImu, Kind::kGnss, Kind::kAbsolutePose, Kind::kPosePrior}) {
    for (const double size_s : {0.05, 0.3, 0.95, 3.0, 100.0}) {
      for (const double by_s : {size_s, -size_s}) {
        SCOPED_TRACE(fmt::format("kind {}, {} s", static_cast<int>(kind), by_s));
        LockStepDrive drive({.sensors = true});
        drive.timestamps = wrong_timestamps(kind, by_s, How::kReplaced, /*repeated=*/true);
        drive.run(kEnd_s);
        EXPECT_LT(drive.mean_error_m(kSettled_s), 1.2 * plain_error_m(true));
        EXPECT_EQ(drive.wrong_tracking(), 0);
        EXPECT_LT(drive.largest_gap_s(kSettled_s), 0.2);
      }
    }
  }
}

// A step of one sensor's clock only.
TEST(Timestamps, ASensorWhoseClockStepsCostsLittle) {
  for (const Kind kind : {Kind::kImu, Kind::kGnss, Kind::kAbsolutePose}) {
    for (const double by_s : {-100.0, -0.95, -0.3, -0.05, 0.05, 0.3, 0.95, 100.0}) {
      SCOPED_TRACE(fmt::format("kind {}, {} s", static_cast<int>(kind), by_s));
      LockStepDrive drive({.sensors = true});
      drive.timestamps = [&](Kind of, double t_s) {
        return std::vector<Sent>{of == kind && t_s >= kEvent_s ? t_s + by_s : t_s};
      };
      drive.run(kEnd_s);
      // A step within the slack looks like a small delay of the sensor.
      if (std::abs(by_s) > RobotClock::kSlack_s) {
        EXPECT_LT(drive.mean_error_m(kSettled_s), 1.2 * std::max(plain_error_m(true), plain_error_m(false)));
      }
      EXPECT_EQ(drive.wrong_tracking(), 0);
      EXPECT_LT(drive.largest_gap_s(kSettled_s), 0.2);
    }
  }
}

// The clock of all the robot's messages steps.
TEST(Timestamps, AClockThatStepsIsFollowedAndNeverTrackedWrong) {
  for (const double size_s : kSizes_s) {
    for (const double by_s : {size_s, -size_s}) {
      SCOPED_TRACE(by_s);
      LockStepDrive drive;
      drive.timestamps = [&](Kind, double t_s) {
        if (t_s < kEvent_s) return std::vector<Sent>{t_s};
        drive.set_robot_clock(by_s);
        return std::vector<Sent>{t_s + by_s};
      };
      drive.run(kEnd_s);
      EXPECT_EQ(drive.session().counters().robot_clock_set, 1U);
      // The pose continues. A step beyond the slack is found by the third sample, and none is lost.
      EXPECT_LT(drive.mean_error_m(kSettled_s), 1.2 * plain_error_m(false));
      EXPECT_EQ(drive.wrong_tracking(), 0);
      EXPECT_LT(drive.largest_gap_s(kSettled_s), size_s > 0.1 ? 0.07 : 0.21);
      EXPECT_EQ(drive.tracking_share(kEvent_s + 1.5), 1.0);
      const SessionCounters& counters = drive.session().counters();
      if (size_s > 0.1) {
        EXPECT_EQ(counters.robot_time_wrong + counters.robot_time_early + counters.odometry_out_of_order, 0U);
      }
      EXPECT_THAT(drive.log(), Contains(HasSubstr("clock-offset")));
      const auto fault = drive.session().timestamp_fault(kEvent_s + 5.0);
      ASSERT_TRUE(fault);
      EXPECT_EQ(fault->cause, TimestampFault::Cause::kClockOffset);
      EXPECT_NEAR(fault->value, by_s, 0.001);
    }
  }
}

TEST(Timestamps, WhileAStepIsSuspectedNothingIsTracked) {
  // The clock is set back, and samples come in bursts, so that offsets do not agree.
  LockStepDrive drive;
  drive.run(kEvent_s);
  const std::size_t before = drive.moments().size();
  std::vector<Sent> held;
  drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
    if (kind != Kind::kOdometry) return {};
    held.emplace_back(t_s - 0.3, t_s);
    if (held.size() < 10) return {};
    return std::exchange(held, {});
  };
  drive.set_robot_clock(-0.3);
  drive.run(kEvent_s + 3.0);
  EXPECT_EQ(drive.session().counters().robot_clock_set, 1U);
  EXPECT_GT(drive.moments().size(), before + 30);
  EXPECT_EQ(drive.wrong_tracking(), 0);
}

// Effects of queues, not clock steps.
TEST(Timestamps, BurstsRepeatsAndJitterAreNoClockSteps) {
  for (const double burst_s : {0.3, 0.6, 1.0}) {
    SCOPED_TRACE(burst_s);
    LockStepDrive drive;
    std::vector<Sent> held;
    double next_s = kEvent_s;
    drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
      if (kind != Kind::kOdometry || t_s < kEvent_s) return {t_s};
      held.emplace_back(t_s, t_s);
      if (t_s < next_s) return {};
      next_s = t_s + burst_s;
      return std::exchange(held, {});
    };
    drive.run(kEnd_s);
    EXPECT_EQ(drive.session().counters().robot_clock_set, 0U);
    EXPECT_LT(drive.worst_tracking_m(kSettled_s), 0.07);
    EXPECT_GT(drive.tracking_share(kSettled_s), 0.95);
    // In longer bursts some samples are too late to be used.
    if (burst_s > 0.5) continue;
    EXPECT_EQ(drive.wrong_tracking(), 0);
    EXPECT_LT(drive.mean_error_m(kSettled_s), 1.01 * plain_error_m(false));
  }
  for (const double before_s : {0.0, 0.3}) {
    SCOPED_TRACE(before_s);
    LockStepDrive drive;
    drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
      if (kind != Kind::kOdometry || t_s < kEvent_s) return {t_s};
      return {t_s, t_s - before_s};
    };
    drive.run(kEnd_s);
    EXPECT_EQ(drive.session().counters().robot_clock_set, 0U);
    EXPECT_GT(drive.session().counters().odometry_out_of_order, 500U);
    EXPECT_EQ(drive.wrong_tracking(), 0);
    EXPECT_LT(drive.mean_error_m(kSettled_s), 1.01 * plain_error_m(false));
    EXPECT_LT(drive.largest_gap_s(kSettled_s), 0.03);
    EXPECT_EQ(drive.tracking_share(kSettled_s), 1.0);
  }
  LockStepDrive drive;
  groma::test::Random random(3);
  drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
    if (kind != Kind::kOdometry || t_s < kEvent_s) return {t_s};
    return {t_s + random.uniform(-0.05, 0.05)};
  };
  drive.run(kEnd_s);
  EXPECT_EQ(drive.session().counters().robot_clock_set, 0U);
  EXPECT_EQ(drive.wrong_tracking(), 0);
  EXPECT_LT(drive.worst_tracking_m(kSettled_s), 0.07);
  EXPECT_GT(drive.tracking_share(kSettled_s), 0.9);
  const auto late = static_cast<double>(std::count_if(drive.moments().begin(), drive.moments().end(),
                                                      [](const auto& of) { return of.host_s > kEvent_s; }));
  EXPECT_GT(late / (kEnd_s - kEvent_s), 25.0) << "poses a second";
}

TEST(Timestamps, AnotherUnitIsNamedAndCostsNoClockStep) {
  for (const double factor : {1000.0, 0.001}) {
    SCOPED_TRACE(factor);
    LockStepDrive drive;
    drive.timestamps = [&](Kind, double t_s) {
      return std::vector<Sent>{t_s >= kEvent_s && t_s < kEvent_s + 5.0 ? t_s * factor : t_s};
    };
    drive.run(kEvent_s + 4.9);
    const auto fault = drive.session().timestamp_fault(drive.now_s());
    ASSERT_TRUE(fault);
    EXPECT_EQ(fault->cause, TimestampFault::Cause::kTimeUnit);
    EXPECT_NEAR(fault->value / factor, 1.0, 0.1);
    EXPECT_GT(drive.session().odometry_dropped_for_s(drive.now_s()), 4.5);
    EXPECT_THAT(drive.log(), Contains(HasSubstr("time-unit")));
    EXPECT_LT(drive.log().size(), 20U);
    drive.run(kEnd_s);
    EXPECT_EQ(drive.session().counters().robot_clock_set, 0U);
    EXPECT_EQ(drive.wrong_tracking(), 0);
    EXPECT_EQ(drive.tracking_share(kEvent_s + 6.5), 1.0);
  }
}

TEST(RobotClock, AStalledLinkIsNotAUnitError) {
  RobotClock clock;
  double now_s = 10.0;
  for (; now_s < 12.0; now_s += 0.02) EXPECT_EQ(clock.judge(now_s, now_s), Timestamp::kGood);
  // Sent at 50 Hz, received at 2 Hz: later and later.
  for (int i = 0; i < 40; ++i) clock.judge(12.0 + 0.02 * i, now_s += 0.5);
  ASSERT_TRUE(clock.fault());
  EXPECT_EQ(clock.fault()->cause, TimestampFault::Cause::kClockOffset);
  EXPECT_TRUE(clock.suspected());
}

// Odometry pauses, with the ranges (as if the daemon was stopped) or without.
TEST(Timestamps, AfterAPauseTheRangesHaveToAgreeFirst) {
  for (const double pause_s : {1.3, 2.5, 5.0, 20.0}) {
    for (const bool all : {false, true}) {
      SCOPED_TRACE(fmt::format("{} s{}", pause_s, all ? ", ranges too" : ""));
      LockStepDrive drive;
      drive.run(kEvent_s);
      drive.timestamps = [](Kind, double) { return std::vector<Sent>{}; };
      drive.pause_ranges(all);
      drive.run(kEvent_s + pause_s);
      drive.timestamps = [](Kind, double t_s) { return std::vector<Sent>{t_s}; };
      drive.pause_ranges(false);
      const double resumed_s = drive.now_s();
      drive.run(resumed_s + 6.0);
      EXPECT_EQ(drive.wrong_tracking(), 0);
      EXPECT_EQ(drive.tracking_share(resumed_s, resumed_s + 0.5), 0.0);
      EXPECT_EQ(drive.tracking_share(resumed_s + 2.5), 1.0);
      EXPECT_LT(drive.mean_error_m(resumed_s + 2.5), 0.03);
    }
  }
}

TEST(Timestamps, ALateInputIsDegradedWithItsCause) {
  LockStepDrive drive;
  std::vector<Sent> queue;
  // From the event on all odometry arrives 0.3 s late.
  drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
    if (kind != Kind::kOdometry || t_s < kEvent_s) return {t_s};
    queue.emplace_back(t_s, t_s);
    if (queue.size() <= 15) return {};
    const Sent first = queue.front();
    queue.erase(queue.begin());
    return {first};
  };
  drive.run(kEvent_s + 1.8);
  EXPECT_EQ(drive.wrong_tracking(), 0);
  EXPECT_EQ(drive.moments().back().pose.state, State::kDegraded);
  EXPECT_EQ(drive.moments().back().pose.reason, Reason::kOdometryTimes);
  EXPECT_THAT(drive.log(), Contains(HasSubstr("late")));
}

class ClockSets : public MeasurementSink {
 public:
  void on_odometry(const model::OdometrySample& sample) override {
    falls_back_ = falls_back_ || sample.t_s <= last_s_;
    last_s_ = sample.t_s;
  }
  void on_range(const model::RangeSample& /*range*/) override {}
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_clock_set() override {
    ++count;
    last_s_ = -1e300;
  }
  [[nodiscard]] bool falls_back() const { return falls_back_; }
  int count = 0;

 private:
  bool falls_back_ = false;
  double last_s_ = -1e300;
};

// A recording or a calibration drive does not restart for this, nor for a step forward.
TEST(Timestamps, ALinkThatDelaysForAWhileCostsNoRecording) {
  LockStepDrive drive;
  ClockSets recorder;
  drive.session().attach(recorder);
  std::vector<Sent> queue;
  drive.timestamps = [&](Kind kind, double t_s) -> std::vector<Sent> {
    if (kind != Kind::kOdometry || t_s < kEvent_s) return {t_s};
    queue.emplace_back(t_s, t_s);
    if (t_s >= kEvent_s + 4.0) return std::exchange(queue, {});
    if (queue.size() <= 5) return {};
    const Sent first = queue.front();
    queue.erase(queue.begin());
    return {first};
  };
  drive.run(kEnd_s);
  EXPECT_EQ(drive.session().counters().robot_clock_set, 2U);
  EXPECT_EQ(recorder.count, 0);
  EXPECT_FALSE(recorder.falls_back());
  EXPECT_EQ(drive.wrong_tracking(), 0);
  EXPECT_EQ(drive.tracking_share(kEvent_s + 6.0), 1.0);

  for (const double by_s : {0.3, -0.3}) {
    SCOPED_TRACE(by_s);
    LockStepDrive stepped;
    ClockSets other;
    stepped.session().attach(other);
    stepped.timestamps = [&](Kind, double t_s) {
      return std::vector<Sent>{t_s < kEvent_s ? t_s : t_s + by_s};
    };
    stepped.run(kEnd_s);
    EXPECT_EQ(other.count, by_s < 0.0 ? 1 : 0);
    EXPECT_FALSE(other.falls_back());
  }
}

TEST(Timestamps, AnUncertainPoseIsNotTracked) {
  // After a pause, until the sample's lag is over, the state is that before the pause but the pose is
  // current.
  LockStepDrive drive;
  drive.run(kEvent_s);
  drive.timestamps = [](Kind, double) { return std::vector<Sent>{}; };
  drive.pause_ranges(true);
  drive.run(kEvent_s + 0.95);
  const std::size_t before = drive.moments().size();
  drive.timestamps = [](Kind, double t_s) { return std::vector<Sent>{t_s}; };
  drive.run(kEvent_s + 1.0);
  ASSERT_GT(drive.moments().size(), before);
  for (const auto& moment : drive.moments()) {
    if (moment.pose.state != State::kTracking) continue;
    EXPECT_LT(moment.pose.planar_covariance(0, 0), 1.0);
    EXPECT_LT(moment.pose.planar_covariance(1, 1), 1.0);
    EXPECT_LT(moment.pose.planar_covariance(2, 2), 0.09);
  }
}

// ---- rates ------------------------------------------------------------------------------------------

TEST(Timestamps, FastOdometryIsMergedAndAsGood) {
  for (const double rate_hz : {200.0, 1000.0, 5000.0, 10000.0}) {
    SCOPED_TRACE(rate_hz);
    LockStepDrive drive({.odometry_hz = rate_hz});
    drive.run(20.0);
    EXPECT_EQ(drive.wrong_tracking(), 0);
    LockStepDrive plain;
    plain.run(20.0);
    EXPECT_LT(drive.mean_error_m(kSettled_s), 1.2 * plain.mean_error_m(kSettled_s));
    EXPECT_GT(drive.tracking_share(kSettled_s), 0.999);
    EXPECT_EQ(drive.session().counters().waiting_overflows, 0U);
    const double poses_hz = static_cast<double>(drive.moments().size()) / 10.0;
    EXPECT_LT(poses_hz, 201.0);
    EXPECT_GT(poses_hz, 150.0);
    EXPECT_EQ(drive.session().counters().odometry_merged > 0, rate_hz > 200.0);
    const auto said = std::count_if(drive.log().begin(), drive.log().end(), [](const std::string& line) {
      return line.find("and is merged to") != std::string::npos;
    });
    EXPECT_EQ(said, rate_hz > 200.0 ? 1 : 0);
  }
}

std::vector<model::OdometrySample> merged(const std::vector<model::OdometrySample>& samples) {
  OdometryMerger merger;
  std::vector<model::OdometrySample> out;
  for (const auto& sample : samples) {
    const auto now = merger.take(sample);
    out.insert(out.end(), now.begin(), now.end());
  }
  const auto last = merger.flush();
  out.insert(out.end(), last.begin(), last.end());
  return out;
}

// A sample holds until the next.
std::array<double, 3> integral(const std::vector<model::OdometrySample>& samples, double to_s) {
  std::array<double, 3> sum{};
  for (std::size_t i = 0; i < samples.size(); ++i) {
    const double end_s = i + 1 < samples.size() ? samples[i + 1].t_s : to_s;
    const double held_s = end_s - samples[i].t_s;
    sum[0] += samples[i].vx_mps * held_s;
    sum[1] += samples[i].vy_mps * held_s;
    sum[2] += samples[i].omega_radps * held_s;
  }
  return sum;
}

TEST(OdometryMerger, KeepsSlowOdometryUnchanged) {
  for (const double period_s : {0.1, 0.02, 0.005}) {
    std::vector<model::OdometrySample> samples;
    samples.reserve(100);
    for (int i = 0; i < 100; ++i) samples.push_back({period_s * i, 0.1 * i, -0.2 * i, 0.3 * i});
    OdometryMerger merger;
    for (const auto& sample : samples) {
      const auto out = merger.take(sample);
      ASSERT_EQ(out.size(), 1U);
      EXPECT_EQ(out[0].t_s, sample.t_s);
      EXPECT_EQ(out[0].vx_mps, sample.vx_mps);
      EXPECT_TRUE(merger.flush_until(sample.t_s + 1.0).empty());
    }
    EXPECT_EQ(merger.merged(), 0U);
  }
}

TEST(OdometryMerger, KeepsTheDisplacementOfUnevenSamples) {
  groma::test::Random random(5);
  std::vector<model::OdometrySample> samples;
  double t_s = 100.0;
  for (int i = 0; i < 5000; ++i) {
    samples.push_back({t_s, random.gaussian(), random.gaussian(), random.gaussian()});
    t_s += i % 50 == 49 ? 0.02 : random.uniform(0.0001, 0.003);
  }
  const auto out = merged(samples);
  EXPECT_LT(out.size(), samples.size() / 2);
  const auto before = integral(samples, t_s);
  const auto after = integral(out, t_s);
  for (std::size_t i = 0; i < 3; ++i) EXPECT_NEAR(after[i], before[i], 1e-9);
  for (std::size_t i = 1; i < out.size(); ++i) EXPECT_GT(out[i].t_s, out[i - 1].t_s);
}

TEST(OdometryMerger, DoesNotMergeImpossibleSamples) {
  // At 1 kHz: the mean of five samples would hide it from the filter's gate.
  for (const double wrong : {15.0, 60.0, 1e300}) {
    std::vector<model::OdometrySample> samples;
    samples.reserve(100);
    for (int i = 0; i < 100; ++i) samples.push_back({0.001 * i, i == 42 ? wrong : 1.0, 0.0, 0.0});
    int alone = 0;
    for (const model::OdometrySample& sample : merged(samples)) {
      if (sample.vx_mps == wrong) {
        ++alone;
      } else {
        EXPECT_DOUBLE_EQ(sample.vx_mps, 1.0);
      }
    }
    EXPECT_EQ(alone, 1);
  }
}

TEST(OdometryMerger, ReleasesTheLastSampleWhenNoneFollows) {
  OdometryMerger merger;
  static_cast<void>(merger.take({1.000, 1.0, 0.0, 0.0}));
  EXPECT_TRUE(merger.take({1.001, 2.0, 0.0, 0.0}).empty());
  EXPECT_TRUE(merger.take({1.002, 0.0, 0.0, 0.0}).empty());
  EXPECT_TRUE(merger.flush_until(1.005).empty());
  const auto out = merger.flush_until(1.013);
  ASSERT_EQ(out.size(), 2U);
  EXPECT_EQ(out[0].t_s, 1.001);
  EXPECT_DOUBLE_EQ(out[0].vx_mps, 2.0);
  EXPECT_EQ(out[1].t_s, 1.002);
  EXPECT_EQ(out[1].vx_mps, 0.0);
  EXPECT_TRUE(merger.flush().empty());
}

}  // namespace
}  // namespace groma::daemon
