#include "host/link/report_decoder.hpp"

#include <gtest/gtest.h>
#include <pb_decode.h>

#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include "proto/compact_report.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::link {
namespace {

using clock::kDeviceTicksPerSecond;
using test::frame_of;
using test::make_range;
using test::make_report;

class Collected : public NodeSink {
 public:
  void on_range(const model::RangeSample& range) override { ranges.push_back(range); }
  void on_hello(const groma_Hello& hello) override { hellos.push_back(hello); }
  void on_network_status(const groma_NetworkStatus& status) override { statuses.push_back(status); }
  void on_counters(const groma_Counters& counters) override { node_counters.push_back(counters); }
  void on_log(const groma_Log& log) override { logs.push_back(log); }
  void on_reply(const groma_Reply& reply) override { replies.push_back(reply); }

  std::vector<model::RangeSample> ranges;
  std::vector<groma_Hello> hellos;
  std::vector<groma_NetworkStatus> statuses;
  std::vector<groma_Counters> node_counters;
  std::vector<groma_Log> logs;
  std::vector<groma_Reply> replies;
};

std::int64_t dtu(double seconds) {
  return std::llround(seconds * kDeviceTicksPerSecond);
}

TEST(ReportDecoder, GivesEachRangeItsOwnHostTime) {
  constexpr unsigned kBaud = 1'000'000;
  ReportDecoder decoder(kBaud);
  Collected got;
  // Fifty reports 0.1 s apart; the node's counter started at host time 100 s.
  for (std::uint32_t i = 0; i < 50; ++i) {
    const double handed_over_s = 105.0 + 0.1 * i;
    const auto frame =
        frame_of(make_report(i, 3, static_cast<std::uint64_t>(dtu(handed_over_s - 100.0)),
                             {make_range(11, 4.5, -dtu(0.080)), make_range(12, 7.25, -dtu(0.075))}));
    decoder.take(frame, handed_over_s + 10.0 * static_cast<double>(frame.size()) / kBaud, got);
  }
  ASSERT_EQ(got.ranges.size(), 100U);
  const model::RangeSample& last = got.ranges.back();
  EXPECT_NEAR(last.t_s, 105.0 + 4.9 - 0.075, 1e-7);
  EXPECT_NEAR(got.ranges[98].t_s, 105.0 + 4.9 - 0.080, 1e-7);
  EXPECT_EQ(last.tag_id, 3);
  EXPECT_EQ(last.anchor_id, 12);
  EXPECT_DOUBLE_EQ(last.range_m, 7.25);
  EXPECT_TRUE(std::isnan(last.first_path_power_dbm));
  EXPECT_EQ(decoder.counters().reports, 50U);
  EXPECT_EQ(decoder.counters().ranges, 100U);
  EXPECT_EQ(decoder.counters().frames_lost, 0U);
}

TEST(ReportDecoder, ACompactReportGivesTheSameMeasurement) {
  std::vector<groma_Range> ranges{make_range(11, 4.5, -dtu(0.080)), make_range(12, 7.2503, -dtu(0.075))};
  ranges[0].has_first_path_power_cdbm = true;
  ranges[0].first_path_power_cdbm = -8150;
  ranges.push_back(make_range(13, 0.0, 0));
  ranges.back().status = groma_RangeStatus_RANGE_NO_RESPONSE;
  ReportDecoder full(0);
  ReportDecoder compact(0);
  Collected by_full;
  Collected by_compact;
  for (std::uint32_t i = 0; i < 20; ++i) {
    groma_NodeToHost message = make_report(2 * i, 3, static_cast<std::uint64_t>(dtu(5.0 + 0.1 * i)), ranges);
    full.take(frame_of(message), 100.0 + 0.1 * i, by_full);
    groma_CompactReport report = groma_CompactReport_init_zero;
    wire::compact_report(message.body.slot_report, report);
    message.which_body = groma_NodeToHost_compact_report_tag;
    message.body.compact_report = report;
    compact.take(frame_of(message), 100.0 + 0.1 * i, by_compact);
  }
  ASSERT_EQ(by_full.ranges.size(), 40U);
  ASSERT_EQ(by_compact.ranges.size(), 40U);
  for (std::size_t i = 0; i < 40; ++i) {
    EXPECT_EQ(by_compact.ranges[i].tag_id, by_full.ranges[i].tag_id);
    EXPECT_EQ(by_compact.ranges[i].anchor_id, by_full.ranges[i].anchor_id);
    EXPECT_NEAR(by_compact.ranges[i].t_s, by_full.ranges[i].t_s, 0.6e-6);
    EXPECT_NEAR(by_compact.ranges[i].range_m, by_full.ranges[i].range_m, 1e-4);
  }
  EXPECT_FLOAT_EQ(by_compact.ranges[0].first_path_power_dbm, -81.5F);
  EXPECT_TRUE(std::isnan(by_compact.ranges[1].first_path_power_dbm));
  EXPECT_EQ(compact.counters().reports, 20U);
  EXPECT_EQ(compact.counters().frames_lost, 19U);
  EXPECT_EQ(compact.counters().ranges_not_ok, 20U);
}

TEST(ReportDecoder, CountsATornCompactReportAsMalformed) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_compact_report_tag;
  message.body.compact_report.ranges.size = 12;
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(message), 1.0, got);
  EXPECT_EQ(decoder.counters().messages, 0U);
  EXPECT_EQ(decoder.counters().messages_malformed, 1U);
  EXPECT_EQ(decoder.counters().reports, 0U);
}

TEST(ReportDecoder, PassesOnKnownPowers) {
  groma_Range range = make_range(1, 2.0, 0);
  range.has_first_path_power_cdbm = true;
  range.first_path_power_cdbm = -8123;
  range.has_receive_power_cdbm = true;
  range.receive_power_cdbm = -7900;
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(make_report(0, 1, 1000, {range})), 5.0, got);
  ASSERT_EQ(got.ranges.size(), 1U);
  EXPECT_FLOAT_EQ(got.ranges[0].first_path_power_dbm, -81.23F);
  EXPECT_FLOAT_EQ(got.ranges[0].receive_power_dbm, -79.0F);
}

TEST(ReportDecoder, PassesOnTheQualityOfARange) {
  groma_Range range = make_range(1, 2.0, -1'000'000'000);
  range.has_clock_offset_ppb = true;
  range.clock_offset_ppb = -4'321;
  range.noise = 57;
  range.flags = 2 | groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS | groma_RangeFlag_RANGE_FLAG_SUPPLY;
  groma_NodeToHost message = make_report(0, 1, 5'000'000'000, {range, make_range(2, 3.0, 0)});
  message.body.slot_report.network_time_dtu = 1'000'000'000'000'000;
  message.body.slot_report.network_rate_ppb = 20'000;
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(message), 5.0, got);
  message.body.slot_report.network_time_dtu = 0;
  message.body.slot_report.sequence = 1;
  decoder.take(frame_of(message), 5.1, got);
  ASSERT_EQ(got.ranges.size(), 4U);
  EXPECT_FLOAT_EQ(got.ranges[0].clock_offset_ppm, -4.321F);
  EXPECT_EQ(got.ranges[0].noise, 57.0F);
  EXPECT_EQ(got.ranges[0].line_of_sight, model::LineOfSight::kUncertain);
  EXPECT_EQ(got.ranges[0].corrections, model::kAntennaDelaysApplied | model::kSupplyCorrected);
  EXPECT_EQ(got.ranges[0].network_time_dtu, 1'000'000'000'000'000 - 1'000'000'000 - 20'000);
  EXPECT_TRUE(std::isnan(got.ranges[1].clock_offset_ppm));
  EXPECT_TRUE(std::isnan(got.ranges[1].noise));
  EXPECT_EQ(got.ranges[1].line_of_sight, model::LineOfSight::kNotKnown);
  EXPECT_EQ(got.ranges[1].network_time_dtu, 1'000'000'000'000'000);
  EXPECT_EQ(got.ranges[2].network_time_dtu, 0);
}

// The node's counter started at host time 100 s. Beside the transmission its link delays 3 ms to the host and
// 5 ms to the node.
TEST(ReportDecoder, EstimatesTheLinksDelayFromTimeReplies) {
  constexpr unsigned kBaud = 1'000'000;
  constexpr double kToHost_s = 0.003;
  constexpr double kToNode_s = 0.005;
  const auto taking = [](const std::vector<std::uint8_t>& bytes) {
    return 10.0 * static_cast<double>(bytes.size()) / kBaud;
  };
  ReportDecoder decoder(kBaud);
  Collected got;
  for (std::uint32_t i = 0; i < 100; ++i) {
    const double handed_over_s = 105.0 + 0.1 * i;
    const auto report = frame_of(
        make_report(i, 3, static_cast<std::uint64_t>(dtu(handed_over_s - 100.0)), {make_range(11, 4.5, 0)}));
    decoder.take(report, handed_over_s + kToHost_s + taking(report), got);
    if (i % 10 != 5) continue;
    const double asked_s = handed_over_s + 0.02;
    const std::vector<std::uint8_t> request = time_request(asked_s);
    groma_HostToNode heard = groma_HostToNode_init_zero;
    wire::FrameDecoder at_node;
    bool whole = false;
    for (const std::uint8_t byte : request) whole = at_node.push(byte) || whole;
    ASSERT_TRUE(whole);
    pb_istream_t stream = pb_istream_from_buffer(at_node.payload().data(), at_node.payload().size());
    ASSERT_TRUE(pb_decode(&stream, groma_HostToNode_fields, &heard));
    ASSERT_EQ(heard.which_body, groma_HostToNode_time_request_tag);
    const double received_s = asked_s + taking(request) + kToNode_s;
    groma_NodeToHost answer = groma_NodeToHost_init_zero;
    answer.which_body = groma_NodeToHost_time_reply_tag;
    answer.body.time_reply = {.host_time_ns = heard.body.time_request.host_time_ns,
                              .received_dtu = static_cast<std::uint64_t>(dtu(received_s - 100.0)),
                              .transmitted_dtu = static_cast<std::uint64_t>(dtu(received_s + 0.001 - 100.0))};
    const auto reply = frame_of(answer);
    decoder.take(reply, received_s + 0.001 + kToHost_s + taking(reply), got);
  }
  EXPECT_EQ(decoder.counters().time_replies, 10U);
  EXPECT_EQ(decoder.counters().time_replies_unmatched, 0U);
  ASSERT_TRUE(decoder.time().round_trip_s());
  EXPECT_NEAR(*decoder.time().round_trip_s(), kToHost_s + kToNode_s, 1e-6);
  EXPECT_NEAR(got.ranges.back().t_s, 105.0 + 9.9 + 0.5 * (kToHost_s - kToNode_s), 1e-6);
}

// Replies to an earlier program, or replies of another node over the air.
TEST(ReportDecoder, IgnoresRepliesToOthers) {
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(make_report(0, 3, 1'000'000, {make_range(11, 4.5, 0)})), 105.0, got);
  groma_NodeToHost answer = groma_NodeToHost_init_zero;
  answer.which_body = groma_NodeToHost_time_reply_tag;
  const auto take = [&](double asked_s, std::uint64_t received, std::uint64_t sent, std::uint16_t source) {
    answer.body.time_reply = {.host_time_ns = static_cast<std::uint64_t>(asked_s * 1e9),
                              .received_dtu = received,
                              .transmitted_dtu = sent};
    answer.source_id = source;
    decoder.take(frame_of(answer), 105.1, got);
  };
  take(103.0, 1'000, 2'000, 0);
  take(106.0, 1'000, 2'000, 0);
  take(105.0, 3'000, 2'000, 0);
  take(105.0, 1'000, ~std::uint64_t{0}, 0);
  take(105.0, 1'000, 2'000, 7);
  EXPECT_EQ(decoder.counters().time_replies, 0U);
  EXPECT_EQ(decoder.counters().time_replies_unmatched, 4U);  // the one over the air is passed on
  EXPECT_FALSE(decoder.time().round_trip_s());
}

TEST(ReportDecoder, DropsBadRangesAndCountsEachOnce) {
  std::vector<groma_Range> ranges{
      make_range(1, 5.0, 0),
      make_range(2, 0.0, 0),
      make_range(3, -1.0, 0),
      make_range(4, 300'000.0, 0),
      make_range(5, std::numeric_limits<double>::quiet_NaN(), 0),
      make_range(6, std::numeric_limits<double>::infinity(), 0),
      make_range(7, 5.0, dtu(-60.0)),
      make_range(8, 5.0, std::numeric_limits<std::int64_t>::max()),
      make_range(9, 5.0, 0),
      make_range(10, 1000.0, 0),
  };
  ranges[8].status = groma_RangeStatus_RANGE_NO_CLOSING_STAMP;
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(make_report(0, 1, static_cast<std::uint64_t>(dtu(100.0)), ranges)), 5.0, got);
  ASSERT_EQ(got.ranges.size(), 2U);
  EXPECT_EQ(got.ranges[0].anchor_id, 1);
  EXPECT_EQ(got.ranges[1].anchor_id, 10);
  EXPECT_EQ(decoder.counters().ranges, 2U);
  EXPECT_EQ(decoder.counters().ranges_out_of_bounds, 5U);
  EXPECT_EQ(decoder.counters().ranges_bad_instant, 2U);
  EXPECT_EQ(decoder.counters().ranges_not_ok, 1U);
}

TEST(ReportDecoder, CountsLostReportsByTheirSequence) {
  ReportDecoder decoder(0);
  Collected got;
  std::uint64_t device_dtu = 1'000'000'000;
  double host_s = 1.0;
  const auto send = [&](std::uint32_t sequence) {
    device_dtu += static_cast<std::uint64_t>(dtu(0.1));
    host_s += 0.1;
    decoder.take(frame_of(make_report(sequence, 1, device_dtu, {})), host_s, got);
  };
  send(0xFFFFFFFDU);
  send(0xFFFFFFFEU);
  send(1);  // 0xFFFFFFFF and 0 are missing
  EXPECT_EQ(decoder.counters().frames_lost, 2U);
  send(2);
  send(7);
  EXPECT_EQ(decoder.counters().frames_lost, 6U);
  // The node restarts: counter and sequence start again, which is not a loss.
  device_dtu = 0;
  send(0);
  send(1);
  EXPECT_EQ(decoder.counters().frames_lost, 6U);
  EXPECT_EQ(decoder.time().counters().counter_restarts, 1U);
}

// Frames that are received again, as from a recording, cost nothing and are no loss.
TEST(ReportDecoder, DropsRepeatedReportsAndCountsThemApart) {
  ReportDecoder decoder(0);
  Collected got;
  std::vector<std::vector<std::uint8_t>> frames;
  for (std::uint32_t i = 0; i < 900; ++i) {
    const auto device_dtu = static_cast<std::uint64_t>(dtu(50.0 + 0.0035 * i));
    frames.push_back(frame_of(make_report(70 + i, 1, device_dtu, {make_range(1, 2.0, 0)})));
  }
  double now_s = 1.0;
  const auto send = [&](std::size_t from, std::size_t to) {
    for (std::size_t i = from; i < to; ++i) decoder.take(frames[i], now_s += 0.0035, got);
  };
  send(0, 850);
  now_s -= 0.0035 * 850;  // at once
  for (int i = 0; i < 3; ++i) decoder.take(frames[849], now_s + 0.0035 * 850, got);
  send(0, 850);
  EXPECT_EQ(decoder.counters().reports_repeated, 853U);
  send(850, 900);
  EXPECT_EQ(decoder.counters().reports, 900U);
  EXPECT_EQ(decoder.counters().frames_lost, 0U);
  EXPECT_EQ(decoder.time().counters().counter_restarts, 0U);
  ASSERT_EQ(got.ranges.size(), 900U);
}

TEST(ReportDecoder, AnImpossibleGapIsNoLoss) {
  ReportDecoder decoder(0);
  Collected got;
  std::uint32_t sequence = 0;
  for (std::uint32_t i = 0; i < 200; ++i) {
    sequence = i % 2 == 0 ? 0x1234'5678U * i : sequence + 2;  // each other report is really missing
    decoder.take(frame_of(make_report(sequence, 1, static_cast<std::uint64_t>(dtu(1.0 + 0.01 * i)), {})),
                 1.0 + 0.01 * i, got);
  }
  EXPECT_EQ(decoder.counters().frames_lost, 100U);
}

TEST(ReportDecoder, ADamagedFrameIsALostReport) {
  ReportDecoder decoder(0);
  Collected got;
  for (std::uint32_t i = 0; i < 10; ++i) {
    auto frame =
        frame_of(make_report(i, 1, static_cast<std::uint64_t>(dtu(1.0 + 0.1 * i)), {make_range(1, 2.0, 0)}));
    if (i == 4) frame[frame.size() / 2] ^= 0x10U;
    decoder.take(frame, 1.0 + 0.1 * i, got);
  }
  EXPECT_EQ(got.ranges.size(), 9U);
  EXPECT_EQ(decoder.counters().frames_lost, 1U);
  EXPECT_EQ(decoder.frame_counters().crc_errors + decoder.frame_counters().cobs_errors, 1U);
}

TEST(ReportDecoder, SeparatesTagsOnOneCable) {
  ReportDecoder decoder(0);
  Collected got;
  decoder.take(frame_of(make_report(500, 1, static_cast<std::uint64_t>(dtu(900.0)), {make_range(1, 2.0, 0)})),
               10.0, got);
  // Another tag was plugged in; its counter is ahead.
  decoder.take(
      frame_of(make_report(900, 2, static_cast<std::uint64_t>(dtu(5000.0)), {make_range(1, 2.0, 0)})), 11.0,
      got);
  ASSERT_EQ(got.ranges.size(), 2U);
  EXPECT_DOUBLE_EQ(got.ranges[1].t_s, 11.0);
  EXPECT_EQ(decoder.counters().frames_lost, 0U);
}

TEST(ReportDecoder, PassesOnMessagesAboutTheNode) {
  ReportDecoder decoder(115200);
  Collected got;
  decoder.take(frame_of(test::make_hello(7, "0.1.0")), 1.0, got);
  decoder.take(frame_of(test::make_log(groma_LogLevel_LOG_WARNING, "no beacon")), 1.0, got);
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_counters_tag;
  message.body.counters.crc_errors = 5;
  decoder.take(frame_of(message), 1.0, got);
  message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_network_status_tag;
  message.body.network_status.skew_ppb = -1234;
  decoder.take(frame_of(message), 1.0, got);
  message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_reply_tag;
  message.body.reply.request_id = 77;
  decoder.take(frame_of(message), 1.0, got);
  ASSERT_EQ(got.hellos.size(), 1U);
  EXPECT_STREQ(got.hellos[0].version, "0.1.0");
  ASSERT_EQ(got.logs.size(), 1U);
  EXPECT_STREQ(got.logs[0].text, "no beacon");
  EXPECT_EQ(got.node_counters.at(0).crc_errors, 5U);
  EXPECT_EQ(got.statuses.at(0).skew_ppb, -1234);
  EXPECT_EQ(got.replies.at(0).request_id, 77U);
  EXPECT_EQ(decoder.counters().messages, 5U);
}

TEST(ReportDecoder, CountsFramesWithoutAMessage) {
  ReportDecoder decoder(0);
  Collected got;
  for (const std::vector<std::uint8_t>& payload :
       {std::vector<std::uint8_t>{}, {0xFF, 0xFF, 0xFF}, {0x0A, 0x7F}, {0xF8, 0x01, 0x01}}) {
    std::vector<std::uint8_t> frame(wire::max_encoded_size(payload.size()));
    frame.resize(wire::encode_frame(payload, frame));
    decoder.take(frame, 1.0, got);
  }
  decoder.take(frame_of(make_report(0, 70'000, 5, {})), 1.0, got);
  decoder.take(frame_of(make_report(0, 1, std::numeric_limits<std::uint64_t>::max(), {})), 1.0, got);
  EXPECT_EQ(decoder.counters().messages, 0U);
  EXPECT_EQ(decoder.counters().messages_malformed, 6U);
  EXPECT_EQ(decoder.frame_counters().frames, 6U);
}

TEST(ReportDecoder, RestartsTheClockEstimateAfterReopening) {
  ReportDecoder decoder(0);
  Collected got;
  const auto first =
      frame_of(make_report(0, 1, static_cast<std::uint64_t>(dtu(10.0)), {make_range(1, 2.0, 0)}));
  decoder.take(first, 100.0, got);
  decoder.take(std::span(first).first(first.size() / 2), 100.1, got);
  decoder.link_reopened();
  // The node restarted while it was unplugged, and has run for longer than before.
  decoder.take(frame_of(make_report(1, 1, static_cast<std::uint64_t>(dtu(50.0)), {make_range(1, 2.0, 0)})),
               200.0, got);
  ASSERT_EQ(got.ranges.size(), 2U);
  EXPECT_DOUBLE_EQ(got.ranges[1].t_s, 200.0);
  EXPECT_EQ(decoder.time().counters().host_jumps, 0U);
  EXPECT_EQ(decoder.frame_counters().crc_errors, 0U);
}

// Intact frames with damaged messages: all output is within its bounds, and each message is counted.
TEST(ReportDecoder, StaysWithinItsBoundsForAnyFrame) {
  std::uint64_t state = 12345;
  const auto random = [&state] {
    state = state * 6364136223846793005U + 1442695040888963407U;
    return static_cast<std::size_t>(state >> 33);
  };
  std::vector<groma_Range> ranges;
  for (std::uint16_t i = 0; i < 6; ++i) ranges.push_back(make_range(i, 3.0 + i, -dtu(0.01 * i)));
  wire::FrameDecoder unpacked;

  ReportDecoder decoder(115200);
  Collected got;
  constexpr std::uint64_t kTries = 200'000;
  for (std::uint64_t i = 0; i < kTries; ++i) {
    const auto device_dtu = static_cast<std::uint64_t>(dtu(100.0 + 1e-3 * static_cast<double>(i)));
    const auto good = frame_of(make_report(static_cast<std::uint32_t>(i), 1, device_dtu, ranges));
    for (const std::uint8_t byte : good) unpacked.push(byte);
    std::vector<std::uint8_t> damaged(unpacked.payload().begin(), unpacked.payload().end());
    for (std::size_t n = 1 + random() % 4; n > 0; --n) {
      damaged[random() % damaged.size()] = static_cast<std::uint8_t>(random());
    }
    if (random() % 8 == 0) damaged.resize(random() % (damaged.size() + 1));
    std::vector<std::uint8_t> frame(wire::max_encoded_size(damaged.size()));
    frame.resize(wire::encode_frame(damaged, frame));
    got.ranges.clear();
    decoder.take(frame, 1e-3 * static_cast<double>(i), got);
    for (const model::RangeSample& range : got.ranges) {
      ASSERT_TRUE(range.range_m > 0.0 && range.range_m <= ReportDecoder::kMaxRange_m);
      ASSERT_TRUE(std::isfinite(range.t_s));
    }
  }
  const ReportCounters& counters = decoder.counters();
  EXPECT_EQ(counters.messages + counters.messages_malformed, kTries);
  EXPECT_EQ(decoder.frame_counters().frames, kTries);
  EXPECT_GT(counters.messages_malformed, 1000U);
  EXPECT_GT(counters.ranges, 100'000U);
  EXPECT_GT(counters.ranges_out_of_bounds, 1000U);
}

}  // namespace
}  // namespace groma::link
