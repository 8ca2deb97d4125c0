#include "proto/slot_report.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <pb_encode.h>

#include <array>
#include <cstdint>
#include <limits>
#include <random>
#include <span>
#include <vector>

namespace groma::wire {
namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes by_nanopb(const groma_SlotReport& report) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_slot_report_tag;
  message.body.slot_report = report;
  Bytes bytes(groma_NodeToHost_size);
  pb_ostream_t stream = pb_ostream_from_buffer(bytes.data(), bytes.size());
  EXPECT_TRUE(pb_encode(&stream, groma_NodeToHost_fields, &message));
  bytes.resize(stream.bytes_written);
  return bytes;
}

Bytes by_hand(const groma_SlotReport& report) {
  std::array<std::uint8_t, groma_NodeToHost_size> buffer{};
  const auto bytes = encode_slot_report(report, buffer);
  return {bytes.begin(), bytes.end()};
}

// Random numbers of every encoded length, including the limits of each type.
class Draw {
 public:
  explicit Draw(unsigned seed) : generator_(seed) {}

  [[nodiscard]] bool flag() { return (generator_() & 1U) != 0; }
  template <class T>
  [[nodiscard]] T number() {
    switch (generator_() % 8) {
      case 0:
        return 0;
      case 1:
        return std::numeric_limits<T>::max();
      case 2:
        return std::numeric_limits<T>::min();
      default:
        return static_cast<T>(generator_() >> (generator_() % 64));
    }
  }
  [[nodiscard]] float real() { return flag() ? 0.0F : static_cast<float>(number<std::int32_t>()) * 1e-4F; }

  groma_Range range() {
    groma_Range range = groma_Range_init_zero;
    range.anchor_id = number<std::uint16_t>();
    range.status = static_cast<groma_RangeStatus>(generator_() % (_groma_RangeStatus_MAX + 1));
    range.instant_offset_dtu = number<std::int64_t>();
    range.range_m = real();
    range.has_first_path_power_cdbm = flag();
    range.first_path_power_cdbm = number<std::int16_t>();
    range.has_receive_power_cdbm = flag();
    range.receive_power_cdbm = number<std::int16_t>();
    range.has_clock_offset_ppb = flag();
    range.clock_offset_ppb = number<std::int32_t>();
    range.has_raw = flag();
    range.noise = number<std::uint16_t>();
    range.flags = number<std::uint8_t>();
    range.raw = {.tag_round_dtu = number<std::uint32_t>(),
                 .anchor_reply_dtu = number<std::uint32_t>(),
                 .anchor_round_dtu = number<std::uint64_t>(),
                 .tag_reply_dtu = number<std::uint64_t>()};
    return range;
  }

  groma_SlotReport report() {
    groma_SlotReport report = groma_SlotReport_init_zero;
    report.sequence = number<std::uint32_t>();
    report.superframe = number<std::uint32_t>();
    report.slot = number<std::uint32_t>();
    report.tag_id = number<std::uint32_t>();
    report.device_time_dtu = number<std::uint64_t>();
    report.network_time_dtu = number<std::uint64_t>();
    report.network_rate_ppb = number<std::int32_t>();
    report.ranges_count = static_cast<pb_size_t>(generator_() % 17);
    for (groma_Range& each : std::span(report.ranges).first(report.ranges_count)) each = range();
    return report;
  }

 private:
  std::mt19937_64 generator_;
};

TEST(SlotReport, IsWrittenAsNanopbWritesIt) {
  Draw draw(1);
  for (int i = 0; i < 2'000; ++i) {
    const groma_SlotReport report = draw.report();
    ASSERT_THAT(by_hand(report), testing::ElementsAreArray(by_nanopb(report))) << "draw " << i;
  }
}

TEST(SlotReport, AnEmptyReportIsEncoded) {
  const groma_SlotReport report = groma_SlotReport_init_zero;
  EXPECT_THAT(by_hand(report), testing::ElementsAreArray(by_nanopb(report)));
  EXPECT_THAT(by_hand(report), testing::ElementsAre(groma_NodeToHost_slot_report_tag << 3 | 2, 0));
}

TEST(SlotReport, TheLargestReportFitsAndOneByteLessIsRejected) {
  groma_SlotReport report = groma_SlotReport_init_zero;
  report.sequence = report.superframe = report.slot = report.tag_id =
      std::numeric_limits<std::uint32_t>::max();
  report.device_time_dtu = report.network_time_dtu = std::numeric_limits<std::uint64_t>::max();
  report.network_rate_ppb = std::numeric_limits<std::int32_t>::min();
  report.ranges_count = 16;
  for (groma_Range& range : report.ranges) {
    constexpr std::uint32_t kMost32 = std::numeric_limits<std::uint32_t>::max();
    constexpr std::uint64_t kMost = std::numeric_limits<std::uint64_t>::max();
    range = {.anchor_id = 65'535,
             .status = groma_RangeStatus_RANGE_BAD_STAMP,
             .instant_offset_dtu = std::numeric_limits<std::int64_t>::min(),
             .range_m = -1.0F,
             .has_first_path_power_cdbm = true,
             .first_path_power_cdbm = std::numeric_limits<std::int16_t>::min(),
             .has_receive_power_cdbm = true,
             .receive_power_cdbm = std::numeric_limits<std::int16_t>::min(),
             .has_clock_offset_ppb = true,
             .clock_offset_ppb = std::numeric_limits<std::int32_t>::min(),
             .has_raw = true,
             .raw = {kMost32, kMost32, kMost, kMost},
             .noise = std::numeric_limits<std::uint16_t>::max(),
             .flags = std::numeric_limits<std::uint8_t>::max()};
  }
  const Bytes whole = by_nanopb(report);
  EXPECT_THAT(by_hand(report), testing::ElementsAreArray(whole));
  Bytes room(whole.size());
  EXPECT_EQ(encode_slot_report(report, room).size(), whole.size());
  EXPECT_TRUE(encode_slot_report(report, std::span(room).subspan(1)).empty());
}

}  // namespace
}  // namespace groma::wire
