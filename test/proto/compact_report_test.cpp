#include "proto/compact_report.hpp"

#include <gtest/gtest.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <limits>

#include "proto/frame_codec.hpp"

namespace groma::wire {
namespace {

constexpr double kTicksPerMicrosecond = 63'897.6;

groma_Range range_of(std::uint16_t anchor, float range_m, double age_us) {
  groma_Range range = groma_Range_init_zero;
  range.anchor_id = anchor;
  range.range_m = range_m;
  range.instant_offset_dtu = -static_cast<std::int64_t>(age_us * kTicksPerMicrosecond);
  return range;
}

groma_SlotReport full_report(std::size_t ranges) {
  groma_SlotReport report = groma_SlotReport_init_zero;
  report.sequence = 123'456;
  report.superframe = 234'567;
  report.slot = 2;
  report.tag_id = 3;
  report.device_time_dtu = 9'123'456'789'012'345;
  report.network_time_dtu = 8'123'456'789'012'345;
  report.network_rate_ppb = -12'345;
  for (std::size_t i = 0; i < ranges; ++i) {
    groma_Range range = range_of(static_cast<std::uint16_t>(101 + i), 12.3456F + static_cast<float>(i),
                                 8'000.0 + 317.3 * static_cast<double>(i));
    range.has_first_path_power_cdbm = range.has_receive_power_cdbm = true;
    range.first_path_power_cdbm = -8'123;
    range.receive_power_cdbm = -7'950;
    range.has_clock_offset_ppb = true;
    range.clock_offset_ppb = -4'321;
    range.flags = static_cast<std::uint8_t>(groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS + i % 4);
    range.noise = static_cast<std::uint16_t>(30 * i);
    report.ranges[report.ranges_count++] = range;
  }
  return report;
}

groma_SlotReport there_and_back(const groma_SlotReport& report) {
  groma_CompactReport compact = groma_CompactReport_init_zero;
  compact_report(report, compact);
  groma_SlotReport back = groma_SlotReport_init_zero;
  EXPECT_TRUE(expand_report(compact, back));
  return back;
}

TEST(CompactReport, KeepsWhatAMeasurementNeeds) {
  const groma_SlotReport report = full_report(16);
  const groma_SlotReport back = there_and_back(report);
  EXPECT_EQ(back.sequence, report.sequence);
  EXPECT_EQ(back.superframe, report.superframe);
  EXPECT_EQ(back.slot, report.slot);
  EXPECT_EQ(back.tag_id, report.tag_id);
  EXPECT_EQ(back.device_time_dtu, report.device_time_dtu);
  ASSERT_EQ(back.ranges_count, 16U);
  for (std::size_t i = 0; i < 16; ++i) {
    const groma_Range& a = report.ranges[i];
    const groma_Range& b = back.ranges[i];
    EXPECT_EQ(b.anchor_id, a.anchor_id);
    EXPECT_EQ(b.status, a.status);
    EXPECT_NEAR(static_cast<double>(b.range_m), static_cast<double>(a.range_m), 0.000'051);
    EXPECT_NEAR(static_cast<double>(b.instant_offset_dtu), static_cast<double>(a.instant_offset_dtu),
                0.5 * kTicksPerMicrosecond + 1.0);
    ASSERT_TRUE(b.has_first_path_power_cdbm);
    EXPECT_NEAR(b.first_path_power_cdbm, a.first_path_power_cdbm, 25);
    ASSERT_TRUE(b.has_receive_power_cdbm);
    EXPECT_NEAR(b.receive_power_cdbm, a.receive_power_cdbm, 25);
    EXPECT_EQ(b.flags, a.flags);
    EXPECT_EQ(b.noise, std::min<std::uint16_t>(a.noise, 255));
    EXPECT_FALSE(b.has_clock_offset_ppb);
    EXPECT_FALSE(b.has_raw);
  }
}

TEST(CompactReport, KeepsEachStatusAndUnknownValues) {
  groma_SlotReport report = groma_SlotReport_init_zero;
  for (int status = 0; status <= _groma_RangeStatus_MAX; ++status) {
    groma_Range range = range_of(0xFFFF, 5.0F, 1'000.0);
    range.status = static_cast<groma_RangeStatus>(status);
    report.ranges[report.ranges_count++] = range;
  }
  const groma_SlotReport back = there_and_back(report);
  for (pb_size_t i = 0; i < report.ranges_count; ++i) {
    EXPECT_EQ(back.ranges[i].status, report.ranges[i].status);
    EXPECT_EQ(back.ranges[i].anchor_id, 0xFFFF);
    EXPECT_FALSE(back.ranges[i].has_first_path_power_cdbm);
    EXPECT_FALSE(back.ranges[i].has_receive_power_cdbm);
    EXPECT_EQ(back.ranges[i].range_m, i == 0 ? 5.0F : 0.0F);
  }
}

TEST(CompactReport, ClampsValuesOutOfRange) {
  groma_SlotReport report = groma_SlotReport_init_zero;
  for (const float range_m :
       {-0.3F, 0.0F, 1'677.7F, 1'700.0F, 300'000.0F, std::numeric_limits<float>::quiet_NaN(),
        std::numeric_limits<float>::infinity()}) {
    report.ranges[report.ranges_count++] = range_of(1, range_m, 0.0);
  }
  report.ranges[0].instant_offset_dtu = 1'000;
  report.ranges[1].instant_offset_dtu = std::numeric_limits<std::int64_t>::min();
  report.ranges[2].instant_offset_dtu = -static_cast<std::int64_t>(16'777'215.0 * kTicksPerMicrosecond);
  report.ranges[0].has_receive_power_cdbm = report.ranges[1].has_receive_power_cdbm = true;
  report.ranges[0].receive_power_cdbm = std::numeric_limits<std::int16_t>::max();
  report.ranges[1].receive_power_cdbm = std::numeric_limits<std::int16_t>::min();
  const groma_SlotReport back = there_and_back(report);
  EXPECT_EQ(back.ranges[0].range_m, 0.0F);
  EXPECT_EQ(back.ranges[1].range_m, 0.0F);
  EXPECT_NEAR(static_cast<double>(back.ranges[2].range_m), 1'677.7, 0.0002);
  EXPECT_NEAR(static_cast<double>(back.ranges[3].range_m), 1'677.7215, 0.0002);
  EXPECT_NEAR(static_cast<double>(back.ranges[4].range_m), 1'677.7215, 0.0002);
  EXPECT_EQ(back.ranges[5].range_m, 0.0F);
  EXPECT_NEAR(static_cast<double>(back.ranges[6].range_m), 1'677.7215, 0.0002);
  EXPECT_EQ(back.ranges[0].instant_offset_dtu, 0);
  const double longest = -16'777'215.0 * kTicksPerMicrosecond;
  EXPECT_NEAR(static_cast<double>(back.ranges[1].instant_offset_dtu), longest, 1.0);
  EXPECT_NEAR(static_cast<double>(back.ranges[2].instant_offset_dtu), longest, 1.0);
  EXPECT_EQ(back.ranges[0].receive_power_cdbm, 0);
  EXPECT_EQ(back.ranges[1].receive_power_cdbm, -12'700);
}

// A node with older firmware sends no traits.
TEST(CompactReport, IsReadWithoutTraits) {
  groma_CompactReport compact = groma_CompactReport_init_zero;
  compact_report(full_report(5), compact);
  compact.traits.size = 0;
  groma_SlotReport back = groma_SlotReport_init_zero;
  ASSERT_TRUE(expand_report(compact, back));
  ASSERT_EQ(back.ranges_count, 5U);
  for (std::size_t i = 0; i < 5; ++i) {
    EXPECT_EQ(back.ranges[i].anchor_id, 101 + i);
    EXPECT_EQ(back.ranges[i].flags, 0);
    EXPECT_EQ(back.ranges[i].noise, 0);
  }
}

TEST(CompactReport, RejectsATruncatedRecord) {
  groma_CompactReport compact = groma_CompactReport_init_zero;
  compact_report(full_report(3), compact);
  groma_SlotReport back = groma_SlotReport_init_zero;
  --compact.ranges.size;
  EXPECT_FALSE(expand_report(compact, back));
  compact.ranges.size = 0;
  EXPECT_TRUE(expand_report(compact, back));
  EXPECT_EQ(back.ranges_count, 0U);
}

TEST(CompactReport, TakesAtMost14BytesPerRangeAndUnder56PercentOfAFullReport) {
  const auto encoded = [](const groma_NodeToHost& message) {
    std::array<std::uint8_t, groma_NodeToHost_size> payload{};
    std::array<std::uint8_t, max_encoded_size(groma_NodeToHost_size)> frame{};
    pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
    EXPECT_TRUE(pb_encode(&stream, groma_NodeToHost_fields, &message));
    return encode_frame(std::span(payload).first(stream.bytes_written), frame);
  };
  const auto sizes = [&](std::size_t ranges) {
    groma_NodeToHost message = groma_NodeToHost_init_zero;
    message.which_body = groma_NodeToHost_slot_report_tag;
    message.body.slot_report = full_report(ranges);
    const std::size_t full = encoded(message);
    groma_CompactReport compact = groma_CompactReport_init_zero;
    compact_report(full_report(ranges), compact);
    message.which_body = groma_NodeToHost_compact_report_tag;
    message.body.compact_report = compact;
    return std::pair(full, encoded(message));
  };
  const auto [full, compact] = sizes(12);
  EXPECT_LT(compact * 9, full * 5);
  EXPECT_LE(compact - sizes(0).second, 12U * 14U);
  EXPECT_LE(sizes(0).second, 48U);
}

}  // namespace
}  // namespace groma::wire
