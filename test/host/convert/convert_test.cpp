// Recordings as MCAP files, read by the test's own reader. test/npm decodes every message by the viewers'
// packages.
#include "host/convert/convert.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <initializer_list>
#include <set>
#include <string>
#include <vector>

#include "host/convert/proto_writer.hpp"
#include "test/support/mcap_reader.hpp"
#include "test/support/small_run.hpp"

namespace groma::convert {
namespace {

using test::McapFile;
using test::McapMessage;
using testing::HasSubstr;
using testing::UnorderedElementsAre;

std::string bytes(std::initializer_list<int> values) {
  std::string out;
  for (const int value : values) out += static_cast<char>(value);
  return out;
}

TEST(ProtoWriter, EncodesEachKindOfField) {
  EXPECT_EQ(ProtoWriter().integer(1, 300).message(), bytes({0x08, 0xAC, 0x02}));
  EXPECT_EQ(ProtoWriter().integer(16, 0).message(), bytes({0x80, 0x01, 0x00}));
  EXPECT_EQ(ProtoWriter().number(2, 1.0).message(), bytes({0x11, 0, 0, 0, 0, 0, 0, 0xF0, 0x3F}));
  EXPECT_EQ(ProtoWriter().number(2, 1.0F).message(), bytes({0x15, 0, 0, 0x80, 0x3F}));
  EXPECT_EQ(ProtoWriter().bytes(3, "ab").message(), bytes({0x1A, 2, 'a', 'b'}));
  const std::vector<double> one{1.0};
  EXPECT_EQ(ProtoWriter().numbers(4, one).message(), bytes({0x22, 8, 0, 0, 0, 0, 0, 0, 0xF0, 0x3F}));
}

// With the estimates of the filter.
McapFile with_estimates(const io::Dataset& run, Format format) {
  const model::Calibration calibration =
      model::surveyed_calibration(run.surveyed_anchors, run.tags, run.range_priors, 0.02);
  filter::ReplayOptions options;
  options.start = *filter::start_from_prior(run.pose_prior, 0.0, run.surface);
  const filter::ReplayResult result = filter::replay(
      {run.odometry, run.ranges, run.tags, &run.surface, &calibration, &run.sensor_samples}, options);
  return test::McapReader::read(
      to_mcap({.dataset = &run, .calibration = &calibration, .result = &result}, format).bytes);
}

class Convert : public testing::TestWithParam<Format> {
 protected:
  static std::set<std::string> topics(const McapFile& file) {
    std::set<std::string> out;
    for (const auto& [id, channel] : file.channels) out.insert(channel.topic);
    return out;
  }

  io::Dataset run_ = test::make_small_run(10.0, 1);
};

TEST_P(Convert, WritesInputsWithoutACalibration) {
  const Converted converted = to_mcap({.dataset = &run_}, GetParam());
  const McapFile file = test::McapReader::read(converted.bytes);
  EXPECT_THAT(topics(file),
              UnorderedElementsAre("/groma/ranges", "/groma/input/odometry", "/groma/input/pose_prior"));
  EXPECT_EQ(file.of("/groma/input/odometry").size(), run_.odometry.size());
  EXPECT_EQ(file.of("/groma/input/pose_prior").size(), run_.pose_prior.size());
  EXPECT_EQ(converted.messages, file.messages.size());
  EXPECT_EQ(converted.topics, 3U);
  EXPECT_EQ(converted.without_timestamp, 0U);
  EXPECT_THAT(file.library, testing::StartsWith("groma "));
}

TEST_P(Convert, WritesAnEstimateForEachOdometrySample) {
  const McapFile file = with_estimates(run_, GetParam());
  EXPECT_EQ(file.of("/groma/pose").size(), run_.odometry.size());
  EXPECT_EQ(file.of("/tf").size(), run_.odometry.size());
}

TEST_P(Convert, OrdersMessagesByTime) {
  const McapFile file = with_estimates(run_, GetParam());
  std::uint64_t last_ns = 0;
  for (const McapMessage& message : file.messages) {
    EXPECT_LE(last_ns, message.log_time_ns);
    last_ns = message.log_time_ns;
  }
}

// Ranges come every 10 ms: those at 0 to 40 ms are one message, with the time of the last one.
TEST_P(Convert, CollectsTheRangesOf50Milliseconds) {
  const McapFile file = test::McapReader::read(to_mcap({.dataset = &run_}, GetParam()).bytes);
  const std::vector<McapMessage> messages = file.of("/groma/ranges");
  EXPECT_EQ(messages.size(), (run_.ranges.size() + 4) / 5);
  EXPECT_EQ(messages.at(0).log_time_ns, 40'000'000U);
  EXPECT_EQ(messages.at(1).log_time_ns, 90'000'000U);
}

TEST_P(Convert, WritesTheChosenTimeOnly) {
  const McapFile file =
      test::McapReader::read(to_mcap({.dataset = &run_, .from_s = 2.0, .to_s = 3.0}, GetParam()).bytes);
  ASSERT_FALSE(file.messages.empty());
  EXPECT_GE(file.messages.front().log_time_ns, 2'000'000'000U);
  EXPECT_LE(file.messages.back().log_time_ns, 3'000'000'000U);
}

TEST_P(Convert, WritesEachSensor) {
  model::samples_of<model::YawRateSample>(run_.sensor_samples) = {{1.0, 0.1}, {1.1, 0.2}};
  model::samples_of<model::PositionSample>(run_.sensor_samples) = {{1.0, 2.0, 3.0, {0.1, 0.0, 0.1}}};
  model::samples_of<model::ZeroVelocitySample>(run_.sensor_samples) = {{1.5}};
  model::PoseSample pose{.t_s = 1.2, .x_m = 1.0};
  pose.covariance = {0.1, 0.0, 0.0, 0.1, 0.0, 0.01};
  model::samples_of<model::PoseSample>(run_.sensor_samples) = {pose};
  const McapFile file = test::McapReader::read(to_mcap({.dataset = &run_}, GetParam()).bytes);
  EXPECT_EQ(file.of("/groma/input/imu").size(), 2U);
  EXPECT_EQ(file.of("/groma/input/gnss").size(), 1U);
  EXPECT_EQ(file.of("/groma/input/zero_velocity").size(), 1U);
  EXPECT_EQ(file.of("/groma/input/absolute_pose").size(), 1U);
}

TEST_P(Convert, LeavesOutAndCountsSamplesWithoutATimestamp) {
  const std::size_t odometry = run_.odometry.size();
  run_.odometry.insert(run_.odometry.begin(), model::OdometrySample{.t_s = -0.5});
  run_.ranges.insert(run_.ranges.begin(),
                     model::RangeSample{.t_s = -1.0, .tag_id = 1, .anchor_id = 4, .range_m = 3.0});
  run_.pose_prior.push_back({.t_s = 3e9});
  const Converted converted = to_mcap({.dataset = &run_}, GetParam());
  EXPECT_EQ(converted.without_timestamp, 3U);
  const McapFile file = test::McapReader::read(converted.bytes);
  EXPECT_EQ(file.of("/groma/input/odometry").size(), odometry);
  EXPECT_EQ(file.of("/groma/ranges").at(0).log_time_ns, 40'000'000U);
}

TEST_P(Convert, KeepsMicrosecondsOfTimesSince1970) {
  run_.odometry = {{.t_s = 1'790'000'000.123456}};
  run_.ranges.clear();
  run_.pose_prior.clear();
  const McapFile file = test::McapReader::read(to_mcap({.dataset = &run_}, GetParam()).bytes);
  EXPECT_NEAR(static_cast<double>(file.messages.at(0).log_time_ns % 1'000'000'000U), 123'456'000.0, 300.0);
}

INSTANTIATE_TEST_SUITE_P(Formats, Convert, testing::Values(Format::kFoxglove, Format::kRos2),
                         [](const auto& of) { return of.param == Format::kRos2 ? "Ros2" : "Foxglove"; });

TEST(Foxglove, ShowsTheSceneOnce) {
  const McapFile file = with_estimates(test::make_small_run(10.0, 1), Format::kFoxglove);
  EXPECT_EQ(file.of("/groma/scene").size(), 1U);
  EXPECT_EQ(file.of("/groma/uncertainty").size(), 100U) << "ten a second";
  EXPECT_THAT(file.of("/groma/log").at(0).data, HasSubstr("CONVERGING"));
  EXPECT_EQ(file.profile, "");
}

}  // namespace
}  // namespace groma::convert
