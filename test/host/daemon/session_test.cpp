#include "host/daemon/session.hpp"

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/daemon/robot_clock.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::daemon {
namespace {

using clock::kDeviceTicksPerSecond;
using link::test::frame_of;
using link::test::make_range;
using link::test::make_report;

class Recorded : public MeasurementSink {
 public:
  void on_odometry(const model::OdometrySample& sample) override {
    odometry.push_back(sample);
    times_s.push_back(sample.t_s);
  }
  void on_range(const model::RangeSample& range) override {
    ranges.push_back(range);
    times_s.push_back(range.t_s);
  }
  void on_uncorrected_range(const model::RangeSample& range) override { uncorrected_s.push_back(range.t_s); }
  void on_pose_prior(const model::PoseSample& pose) override {
    poses.push_back(pose);
    times_s.push_back(pose.t_s);
  }
  void on_sensor(const model::SensorSample& sample) override {
    sensors.push_back(sample);
    times_s.push_back(model::time_of(sample));
  }
  void on_clock_set() override { ++clock_sets; }
  void on_odometry_ahead(const model::OdometrySample& sample) override { ahead_s.push_back(sample.t_s); }
  void on_sensor_ahead(const model::SensorSample& sample) override {
    sensors_ahead_s.push_back(model::time_of(sample));
  }

  std::vector<double> ahead_s;  // of odometry
  std::vector<double> sensors_ahead_s;
  std::vector<model::SensorSample> sensors;
  std::vector<model::OdometrySample> odometry;
  std::vector<model::RangeSample> ranges;
  std::vector<double> uncorrected_s;  // of ranges
  std::vector<model::PoseSample> poses;
  std::vector<double> times_s;  // of all measurements, in the order of delivery
  int clock_sets = 0;
};

// A robot whose clock reads host time plus an offset, and a tag whose counter runs 20 ppm fast.
struct Site {
  explicit Site(SessionConfig config = {}) : session(std::move(config)) {
    tag = session.add_node("tag-1", 0);
    session.attach(sink);
  }

  void odometry(double host_s, double t_s) {
    const std::string line =
        fmt::format(R"({{"class":"ODOMETRY","t_s":{},"vx_mps":1,"vy_mps":0,"omega_radps":0}})"
                    "\n",
                    t_s);
    session.robot_bytes(std::vector<std::uint8_t>(line.begin(), line.end()), host_s);
  }
  void odometry(double host_s) { odometry(host_s, host_s + robot_offset_s); }
  void pose(double host_s, double t_s) {
    const std::string line =
        fmt::format(R"({{"class":"POSE_PRIOR","t_s":{},"x_m":1,"y_m":0,"z_m":0,"yaw_rad":0}})"
                    "\n",
                    t_s);
    session.robot_bytes(std::vector<std::uint8_t>(line.begin(), line.end()), host_s);
  }
  void zero_velocity(double host_s, double t_s) {
    const std::string line = fmt::format("{{\"class\":\"ZERO_VELOCITY\",\"t_s\":{}}}\n", t_s);
    session.robot_bytes(std::vector<std::uint8_t>(line.begin(), line.end()), host_s);
  }
  // Arrives without delay, with ranges of these ages.
  void report(double host_s, const std::vector<double>& ages_s) {
    const auto dtu = [](double s) { return std::llround(s * kDeviceTicksPerSecond * (1.0 + 20e-6)); };
    std::vector<groma_Range> ranges;
    ranges.reserve(ages_s.size());
    for (const double age_s : ages_s) {
      ranges.push_back(make_range(static_cast<std::uint16_t>(10 + ranges.size()), 5.0, dtu(-age_s)));
    }
    session.node_bytes(
        tag, frame_of(make_report(sequence++, 1, static_cast<std::uint64_t>(dtu(host_s + 50.0)), ranges)),
        host_s);
  }

  Recorded sink;
  Session session;
  std::size_t tag = 0;
  std::uint32_t sequence = 0;
  double robot_offset_s = 1.7e9;
};

TEST(Session, PutsRangesOnTheRobotsClockAndInOrder) {
  Site site;
  double host_s = 100.0;
  for (int i = 0; i < 500; ++i) {
    host_s = 100.0 + 0.02 * i;
    site.odometry(host_s);
    if (i % 5 == 4) site.report(host_s + 0.005, {0.12, 0.11, 0.10});
    site.session.advance(host_s + 0.005);
  }
  site.session.flush();
  EXPECT_TRUE(std::is_sorted(site.sink.times_s.begin(), site.sink.times_s.end()));
  EXPECT_EQ(site.sink.odometry.size(), 500U);
  ASSERT_EQ(site.sink.ranges.size(), 300U);
  EXPECT_NEAR(site.sink.ranges[299].t_s - site.robot_offset_s, host_s + 0.005 - 0.10, 1e-5);
  EXPECT_NEAR(site.sink.ranges[0].t_s - site.robot_offset_s, 100.085 - 0.12, 1e-5);
  EXPECT_EQ(site.session.counters().passed_late, 0U);
  EXPECT_EQ(site.session.counters().dropped_late, 0U);
  EXPECT_EQ(site.session.frames_lost(), 0U);
}

// A range that is late by more than the lag and the largest delay together still comes in its order.
TEST(Session, CorrectsTheClockOfRangesBeforeItOrdersThem) {
  constexpr double kLate_s = 0.9;
  Site site;
  site.session.set_range_clock({.offset_s = kLate_s});
  for (int i = 0; i < 500; ++i) {
    const double host_s = 100.0 + 0.02 * i;
    site.odometry(host_s);
    if (i % 5 == 4) site.report(host_s + 0.005, {0.12, 0.11, 0.10});
    site.session.advance(host_s + 0.005);
  }
  ASSERT_GT(site.sink.ranges.size(), 200U);
  EXPECT_TRUE(std::is_sorted(site.sink.times_s.begin(), site.sink.times_s.end()));
  EXPECT_EQ(site.session.counters().passed_late, 0U);
  EXPECT_EQ(site.session.counters().dropped_late, 0U);
  ASSERT_EQ(site.sink.uncorrected_s.size(), site.sink.ranges.size());
  for (std::size_t i = 0; i < site.sink.ranges.size(); ++i)
    ASSERT_NEAR(site.sink.uncorrected_s[i] - site.sink.ranges[i].t_s, kLate_s, 1e-6);
}

// A drift that has grown for days is not that of this drive.
TEST(Session, DoesNotCorrectTheClockOfRangesByMoreThanItsBound) {
  std::vector<std::string> log;
  Site site({.log = [&](std::string_view text) { log.emplace_back(text); }});
  site.session.set_range_clock({.offset_s = 0.1, .drift = 1e-3});
  for (int i = 0; i < 100; ++i) {
    const double host_s = 100.0 + 0.02 * i;
    site.odometry(host_s);
    if (i % 5 == 4) site.report(host_s + 0.005, {0.12, 0.11});
    site.session.advance(host_s + 0.005);
  }
  ASSERT_FALSE(site.sink.ranges.empty());
  for (std::size_t i = 0; i < site.sink.ranges.size(); ++i)
    EXPECT_EQ(site.sink.uncorrected_s[i], site.sink.ranges[i].t_s);
  EXPECT_EQ(std::count_if(log.begin(), log.end(),
                          [](const auto& line) { return line.find("range_clock") != std::string::npos; }),
            1);
}

TEST(Session, PutsOtherSensorsInOrderToo) {
  Site site;
  site.zero_velocity(9.99, site.robot_offset_s + 9.99);  // the robot's time is not known yet
  site.odometry(10.0);
  site.zero_velocity(10.01, site.robot_offset_s + 10.01);
  site.odometry(10.02);
  site.zero_velocity(10.03, site.robot_offset_s + 10.005);
  site.zero_velocity(10.03, site.robot_offset_s + 20.0);
  site.session.flush();
  EXPECT_TRUE(std::is_sorted(site.sink.times_s.begin(), site.sink.times_s.end()));
  ASSERT_EQ(site.sink.sensors.size(), 2U);
  EXPECT_NEAR(model::time_of(site.sink.sensors[0]) - site.robot_offset_s, 10.005, 1e-6);
  EXPECT_EQ(site.session.counters().sensors, 2U);
  EXPECT_EQ(site.session.counters().without_odometry, 1U);
  EXPECT_EQ(site.session.counters().robot_time_wrong, 1U);
}

TEST(Session, ConvertsTheSteeringOfAConfiguredCar) {
  const auto send = [](Site& site, double host_s) {
    const std::string line = fmt::format(R"({{"class":"STEERING","t_s":{},"speed_mps":2,"steering_rad":0.5}})"
                                         "\n",
                                         host_s);
    site.session.robot_bytes(std::vector<std::uint8_t>(line.begin(), line.end()), host_s);
  };
  Site car({.vehicle = model::Steering{.wheelbase_m = 1.6}});
  for (int i = 0; i < 50; ++i) send(car, 10.0 + 0.02 * i);
  car.session.advance(11.5);
  ASSERT_EQ(car.sink.odometry.size(), 50U);
  EXPECT_EQ(car.sink.odometry[0].vx_mps, 2.0);
  EXPECT_DOUBLE_EQ(car.sink.odometry[0].omega_radps, 2.0 * std::tan(0.5) / 1.6);

  std::vector<std::string> log;
  Site other({.log = [&](std::string_view line) { log.emplace_back(line); }});
  for (int i = 0; i < 50; ++i) send(other, 10.0 + 0.02 * i);
  other.session.advance(11.5);
  EXPECT_TRUE(other.sink.odometry.empty());
  EXPECT_EQ(other.session.counters().steering_unknown, 50U);
  ASSERT_EQ(log.size(), 1U);
  EXPECT_THAT(log[0], ::testing::HasSubstr("the configuration has no 'steering'"));
}

TEST(Session, DelaysMeasurementsByItsLag) {
  Site site({.reorder_lag_s = 0.15});
  site.odometry(10.0);
  site.session.advance(10.149);
  EXPECT_TRUE(site.sink.odometry.empty());
  site.session.advance(10.151);
  EXPECT_EQ(site.sink.odometry.size(), 1U);
}

TEST(Session, AnnouncesWaitingSamplesAtOnceAndNoOthers) {
  Site site;
  for (int i = 0; i <= 100; ++i) {
    const double host_s = 10.0 + 0.02 * i;
    if (i >= 60 && i < 80) continue;  // these come with the 80th
    for (int n = i == 80 ? 60 : i; n <= i; ++n) {
      const double t_s = 10.0 + 0.02 * n + site.robot_offset_s;
      const std::size_t before = site.sink.ahead_s.size() + site.sink.odometry.size();
      site.odometry(host_s, t_s);
      EXPECT_EQ(site.sink.ahead_s.size() + site.sink.odometry.size(), before + 1) << n;
      // Samples 0.2 s old are passed on at once, without an announcement.
      EXPECT_EQ(!site.sink.ahead_s.empty() && site.sink.ahead_s.back() == t_s, n < 60 || n >= 70) << n;
    }
    site.zero_velocity(host_s, host_s + site.robot_offset_s - 0.1);
    site.zero_velocity(host_s, host_s + site.robot_offset_s - 0.3);
    site.report(host_s, {0.1});
    site.odometry(host_s, host_s + site.robot_offset_s - 0.01);  // not newer: dropped
    site.session.advance(host_s);
    if (i == 59) site.session.advance(10.0 + 0.02 * 79.5);
  }
  site.session.flush();
  EXPECT_EQ(site.sink.odometry.size(), 101U);
  EXPECT_EQ(site.sink.ahead_s.size(), 91U);
  EXPECT_TRUE(std::is_sorted(site.sink.ahead_s.begin(), site.sink.ahead_s.end()));
  EXPECT_EQ(site.session.counters().odometry_out_of_order, 81U);
  EXPECT_EQ(site.sink.sensors.size(), 162U);
  EXPECT_LT(site.sink.sensors_ahead_s.size(), 100U);
}

TEST(Session, PassesOnLateRangesAndDropsTooLateOnes) {
  Site site({.reorder_lag_s = 0.15});
  for (int i = 0; i <= 100; ++i) {
    site.odometry(10.0 + 0.02 * i);
    site.session.advance(10.0 + 0.02 * i);
  }
  site.report(12.0, {0.05, 0.3, 0.6});
  EXPECT_EQ(site.sink.ranges.size(), 1U) << "the one of 0.3 s ago, at once";
  EXPECT_EQ(site.session.counters().passed_late, 1U);
  EXPECT_EQ(site.session.counters().dropped_late, 1U);
  site.session.advance(12.2);
  EXPECT_EQ(site.sink.ranges.size(), 2U);
}

TEST(Session, DropsEverythingBeforeTheFirstOdometry) {
  Site site;
  site.report(10.0, {0.1, 0.1});
  site.pose(10.0, -1e6);
  site.session.flush();
  EXPECT_TRUE(site.sink.times_s.empty());
  EXPECT_EQ(site.session.counters().without_odometry, 3U);
  site.odometry(10.1);
  site.report(10.1, {0.05});
  site.session.flush();
  EXPECT_EQ(site.sink.ranges.size(), 1U);
}

TEST(Session, DropsOdometryThatIsNotNewer) {
  Site site;
  site.odometry(10.0);
  site.odometry(10.01, 10.0 + site.robot_offset_s);
  site.odometry(10.02, 9.9 + site.robot_offset_s);
  site.odometry(10.03);
  site.session.flush();
  EXPECT_EQ(site.sink.odometry.size(), 2U);
  EXPECT_EQ(site.session.counters().odometry_out_of_order, 2U);
}

TEST(Session, OneAbsurdTimestampDoesNoHarm) {
  for (const double absurd_s : {0.0, -5.0, 1.7e9 + 4000.0, 1e18, -1e300}) {
    Site site;
    for (int i = 0; i < 100; ++i) {
      const double host_s = 10.0 + 0.02 * i;
      site.odometry(host_s);
      if (i == 50) site.odometry(host_s + 0.001, absurd_s);
      if (i == 60) site.pose(host_s + 0.001, absurd_s);
      site.session.advance(host_s);
    }
    site.session.flush();
    EXPECT_EQ(site.sink.odometry.size(), 100U);
    EXPECT_TRUE(site.sink.poses.empty());
    EXPECT_EQ(site.sink.clock_sets, 0);
    EXPECT_GE(site.session.counters().robot_time_wrong, 1U);
  }
}

// While three samples show that the clock was set, an absurd one comes: it is neither used nor does it hide
// the step.
TEST(Session, AnAbsurdTimestampWithinAClockStepDoesNoHarm) {
  for (const double absurd_s : {0.0, 1e18, -1e300}) {
    Site site;
    for (int i = 0; i < 100; ++i) {
      const double host_s = 10.0 + 0.02 * i;
      if (i == 50) site.robot_offset_s += 3600.0;
      site.odometry(host_s);
      if (i == 50 || i == 51) site.odometry(host_s + 0.001, absurd_s);
      site.session.advance(host_s);
    }
    site.session.flush();
    EXPECT_EQ(site.session.counters().robot_clock_set, 1U);
    EXPECT_EQ(site.session.counters().robot_time_wrong, 2U + 2U)
        << "the absurd ones, and what they interrupted";
    EXPECT_EQ(site.sink.odometry.size(), 98U);
  }
}

TEST(Session, HasThePoseInOdomOfMergedSamples) {
  Session session;
  struct Sink : MeasurementSink {
    void on_odometry(const model::OdometrySample& /*sample*/) override {}
    void on_range(const model::RangeSample& /*range*/) override {}
    void on_pose_prior(const model::PoseSample& /*pose*/) override {}
    void on_odometry_ahead(const model::OdometrySample& sample) override { times_s.push_back(sample.t_s); }
    void on_clock_set() override {}
    std::vector<double> times_s;
  } sink;
  session.attach(sink);
  std::size_t found = 0;
  for (int i = 0; i < 500; ++i) {
    const double t_s = 100.0 + 0.002 * i;
    const std::string line = fmt::format(
        "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":1,\"vy_mps\":0,\"omega_radps\":0,\"odom\":[{},0,0,0,"
        "0,0,1]}}\n",
        t_s, t_s);
    session.robot_bytes({reinterpret_cast<const std::uint8_t*>(line.data()), line.size()}, t_s);
    for (; found < sink.times_s.size(); ++found) {
      const auto odom = session.odom_pose(sink.times_s[found]);
      ASSERT_TRUE(odom) << sink.times_s[found];
      EXPECT_NEAR(odom->pose.position_m.x(), sink.times_s[found], 1e-9);
    }
  }
  EXPECT_GT(found, 100U);
  EXPECT_TRUE(session.gives_odom());
}

TEST(Session, FollowsARobotThatRestarts) {
  for (const double new_offset_s : {-12.0, 3e9}) {
    std::vector<std::string> lines;
    Site site({.log = [&](std::string_view text) { lines.emplace_back(text); }});
    for (int i = 0; i < 100; ++i) {
      site.odometry(10.0 + 0.02 * i);
      site.session.advance(10.0 + 0.02 * i);
    }
    site.robot_offset_s = new_offset_s;
    for (int i = 0; i < 100; ++i) {
      site.odometry(13.0 + 0.02 * i);
      site.session.advance(13.0 + 0.02 * i);
    }
    site.report(15.0, {0.1});
    site.session.flush();
    EXPECT_EQ(site.sink.clock_sets, 1);
    EXPECT_EQ(site.session.counters().robot_clock_set, 1U);
    EXPECT_NEAR(static_cast<double>(site.session.counters().robot_time_wrong), 50.0, 2.0);
    ASSERT_EQ(site.sink.ranges.size(), 1U);
    EXPECT_NEAR(site.sink.ranges[0].t_s - new_offset_s, 14.9, 1e-3);
    EXPECT_THAT(lines, testing::Contains(testing::HasSubstr("robot")));
  }
}

TEST(Session, ReportsBadRobotLinesWithoutFillingTheLog) {
  std::vector<std::string> lines;
  Site site({.log = [&](std::string_view text) { lines.emplace_back(text); }});
  const std::string bad = "{\"class\":\"ODOMETRY\"}\n";
  for (int i = 0; i < 1000; ++i)
    site.session.robot_bytes(std::vector<std::uint8_t>(bad.begin(), bad.end()), 1.0);
  EXPECT_EQ(site.session.robot_counters().bad_value, 1000U);
  EXPECT_EQ(lines.size(), 10U);
}

TEST(Session, QueuesNoMoreThanItsBound) {
  Site site({.max_waiting = 100});
  for (int i = 0; i < 1000; ++i) site.odometry(10.0 + 5e-3 * i);
  EXPECT_EQ(site.sink.odometry.size(), 900U);
  EXPECT_EQ(site.session.counters().waiting_overflows, 900U);
  EXPECT_TRUE(std::is_sorted(site.sink.times_s.begin(), site.sink.times_s.end()));
}

TEST(Session, FeedsEachAttachedSinkAlike) {
  Site site;
  Recorded second;
  site.session.attach(second);
  site.odometry(10.0);
  site.session.flush();
  site.session.detach(site.sink);
  site.odometry(10.1);
  site.session.flush();
  EXPECT_EQ(site.sink.odometry.size(), 1U);
  EXPECT_EQ(second.odometry.size(), 2U);
}

TEST(Session, KeepsAndLogsMessagesOfNodes) {
  std::vector<std::string> lines;
  Site site({.log = [&](std::string_view text) { lines.emplace_back(text); }});
  site.session.node_bytes(site.tag, frame_of(link::test::make_hello(3, "0.1.0")), 1.0);
  site.session.node_bytes(site.tag, frame_of(link::test::make_log(groma_LogLevel_LOG_WARNING, "no beacon")),
                          1.0);
  ASSERT_TRUE(site.session.node(site.tag).hello());
  EXPECT_EQ(site.session.node(site.tag).hello()->id, 3U);
  EXPECT_THAT(lines, testing::ElementsAre(testing::HasSubstr("tag-1: node 3 runs version 0.1.0"),
                                          testing::HasSubstr("tag-1: no beacon")));
}

TEST(Session, LogsTheVersionOfANodeOncePerBoot) {
  std::vector<std::string> lines;
  Site site({.log = [&](std::string_view text) { lines.emplace_back(text); }});
  groma_NodeToHost hello = link::test::make_hello(3, "0.1.0");
  for (const std::uint32_t boot : {7U, 7U, 8U, 0U, 0U}) {
    hello.body.hello.boot_count = boot;
    site.session.node_bytes(site.tag, frame_of(hello), 1.0);
  }
  EXPECT_EQ(lines.size(), 4U);
}

// The result does not depend on how the bytes are cut into pieces.
TEST(Session, TheResultDoesNotDependOnHowBytesAreCut) {
  std::vector<std::vector<model::RangeSample>> results;
  for (const std::size_t piece : {1U, 7U, 10'000U}) {
    Site site;
    for (int i = 0; i < 50; ++i) {
      const double host_s = 10.0 + 0.1 * i;
      site.odometry(host_s);
      const auto frame =
          frame_of(make_report(static_cast<std::uint32_t>(i), 1,
                               static_cast<std::uint64_t>(std::llround(host_s * kDeviceTicksPerSecond)),
                               {make_range(1, 2.0, 0), make_range(2, 3.0, 5)}));
      for (std::size_t at = 0; at < frame.size(); at += piece) {
        site.session.node_bytes(site.tag, std::span(frame).subspan(at, std::min(piece, frame.size() - at)),
                                host_s);
      }
      site.session.advance(host_s);
    }
    site.session.flush();
    results.push_back(site.sink.ranges);
  }
  ASSERT_EQ(results[0].size(), 100U);
  for (std::size_t i = 0; i < 100; ++i) {
    EXPECT_EQ(results[0][i].t_s, results[1][i].t_s);
    EXPECT_EQ(results[0][i].t_s, results[2][i].t_s);
    EXPECT_EQ(results[0][i].anchor_id, results[2][i].anchor_id);
  }
}

// Since 1970, as the clocks of most robots count.
TEST(RobotClock, NamesTheUnitOfEpochTimes) {
  for (const auto& [factor, unit] :
       {std::pair{1e3, "milliseconds"}, {1e6, "microseconds"}, {1e9, "nanoseconds"}}) {
    SCOPED_TRACE(unit);
    RobotClock clock;
    for (double now_s = 10.0; now_s < 12.0; now_s += 0.02) {
      EXPECT_EQ(clock.judge(factor * (1.76e9 + now_s), now_s), Timestamp::kWrong);
    }
    ASSERT_TRUE(clock.fault());
    EXPECT_EQ(clock.fault()->cause, TimestampFault::Cause::kTimeUnit);
    EXPECT_NEAR(clock.fault()->value / factor, 1.0, 0.01);
    EXPECT_THAT(evidence(*clock.fault()), testing::HasSubstr(unit));
    EXPECT_FALSE(clock.robot_time_s(12.0));
    EXPECT_EQ(clock.judge(1.76e9 + 12.0, 12.0), Timestamp::kGood);
  }
}

}  // namespace
}  // namespace groma::daemon
