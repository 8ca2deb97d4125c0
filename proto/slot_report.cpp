#include "proto/slot_report.hpp"

#include <bit>
#include <cstddef>

namespace groma::wire {
namespace {

// put() below encodes these messages by hand. A new field in the schema changes these sizes.
static_assert(groma_RawStamps_size == 34 && groma_Range_size == 79 && groma_SlotReport_size == 1348,
              "groma.proto: a field of SlotReport has been added that is not encoded here");

enum class WireType : std::uint32_t { kVarint = 0, kLength = 2, kFixed32 = 5 };

// Writes Protocol Buffers from the last byte to the first, so that a message's length is known before it is
// written. Put the fields in reverse order.
class BackwardWriter {
 public:
  // The bytes of `out` from `at` on have been written already.
  BackwardWriter(std::span<std::uint8_t> out, std::size_t at, bool overflow) noexcept
      : begin_(out.data()), at_(out.data() + at), end_(out.data() + out.size()), overflow_(overflow) {}

  [[nodiscard]] std::span<const std::uint8_t> written() const noexcept {
    if (overflow_) return {};
    return {at_, end_};
  }
  [[nodiscard]] std::size_t size() const noexcept { return static_cast<std::size_t>(end_ - at_); }
  [[nodiscard]] bool overflow() const noexcept { return overflow_; }

  // Omits a field that has its type's default value.
  template <class T>
  void number(std::uint32_t field, T value) noexcept {
    if (value != 0) put_number(field, value);
  }
  template <class T>
  void put_number(std::uint32_t field, T value) noexcept {
    varint(value);
    key(field, WireType::kVarint);
  }
  void optional_signed(std::uint32_t field, bool has, std::int32_t value) noexcept {
    if (has) put_number(field, zigzag(value));
  }
  void float32(std::uint32_t field, float value) noexcept {
    const auto bits = std::bit_cast<std::uint32_t>(value);
    if (bits == 0) return;
    if (std::uint8_t* byte = take(4); byte != nullptr) {
      for (unsigned shift = 0; shift < 32; shift += 8) *byte++ = static_cast<std::uint8_t>(bits >> shift);
    }
    key(field, WireType::kFixed32);
  }
  // `size_after` is size() before the message's own fields were put.
  void message(std::uint32_t field, std::size_t size_after) noexcept {
    varint(static_cast<std::uint32_t>(size() - size_after));
    key(field, WireType::kLength);
  }

  [[nodiscard]] static std::uint32_t zigzag(std::int32_t value) noexcept {
    return static_cast<std::uint32_t>(value) << 1 ^ static_cast<std::uint32_t>(value >> 31);
  }
  [[nodiscard]] static std::uint64_t zigzag(std::int64_t value) noexcept {
    return static_cast<std::uint64_t>(value) << 1 ^ static_cast<std::uint64_t>(value >> 63);
  }

 private:
  void key(std::uint32_t field, WireType type) noexcept {
    varint(field << 3 | static_cast<std::uint32_t>(type));
  }
  template <class T>
  void varint(T value) noexcept {
    const unsigned groups = (static_cast<unsigned>(std::bit_width(value | 1U)) + 6) / 7;
    std::uint8_t* byte = take(groups);
    if (byte == nullptr) return;
    for (; value >= 0x80; value >>= 7) *byte++ = static_cast<std::uint8_t>(value | 0x80);
    *byte = static_cast<std::uint8_t>(value);
  }
  // Reserves `bytes` before those already written; returns nullptr on overflow.
  std::uint8_t* take(std::size_t bytes) noexcept {
    if (overflow_ || static_cast<std::size_t>(at_ - begin_) < bytes) {
      overflow_ = true;
      return nullptr;
    }
    return at_ -= bytes;
  }

  std::uint8_t* begin_;
  std::uint8_t* at_;
  std::uint8_t* end_;
  bool overflow_;
};

void put(BackwardWriter& out, const groma_RawStamps& raw) noexcept {
  out.number(groma_RawStamps_tag_reply_dtu_tag, raw.tag_reply_dtu);
  out.number(groma_RawStamps_anchor_round_dtu_tag, raw.anchor_round_dtu);
  out.number(groma_RawStamps_anchor_reply_dtu_tag, raw.anchor_reply_dtu);
  out.number(groma_RawStamps_tag_round_dtu_tag, raw.tag_round_dtu);
}

void put(BackwardWriter& out, const groma_Range& range) noexcept {
  out.number(groma_Range_flags_tag, std::uint32_t{range.flags});
  out.number(groma_Range_noise_tag, std::uint32_t{range.noise});
  if (range.has_raw) {
    const std::size_t size_after = out.size();
    put(out, range.raw);
    out.message(groma_Range_raw_tag, size_after);
  }
  out.optional_signed(groma_Range_clock_offset_ppb_tag, range.has_clock_offset_ppb, range.clock_offset_ppb);
  out.optional_signed(groma_Range_receive_power_cdbm_tag, range.has_receive_power_cdbm,
                      range.receive_power_cdbm);
  out.optional_signed(groma_Range_first_path_power_cdbm_tag, range.has_first_path_power_cdbm,
                      range.first_path_power_cdbm);
  out.float32(groma_Range_range_m_tag, range.range_m);
  out.number(groma_Range_instant_offset_dtu_tag, BackwardWriter::zigzag(range.instant_offset_dtu));
  out.number(groma_Range_status_tag, static_cast<std::uint32_t>(range.status));
  out.number(groma_Range_anchor_id_tag, std::uint32_t{range.anchor_id});
}

}  // namespace

void SlotReportWriter::begin(const groma_SlotReport& report, std::span<std::uint8_t> out) noexcept {
  out_ = out;
  BackwardWriter writer(out_, out_.size(), false);
  writer.number(groma_SlotReport_network_rate_ppb_tag, BackwardWriter::zigzag(report.network_rate_ppb));
  writer.number(groma_SlotReport_network_time_dtu_tag, report.network_time_dtu);
  at_ = out_.size() - writer.size();
  overflow_ = writer.overflow();
}

void SlotReportWriter::put_range(const groma_Range& range) noexcept {
  BackwardWriter writer(out_, at_, overflow_);
  const std::size_t size_after = writer.size();
  put(writer, range);
  writer.message(groma_SlotReport_ranges_tag, size_after);
  at_ = out_.size() - writer.size();
  overflow_ = writer.overflow();
}

std::span<const std::uint8_t> SlotReportWriter::finish(const groma_SlotReport& report) noexcept {
  BackwardWriter writer(out_, at_, overflow_);
  writer.number(groma_SlotReport_device_time_dtu_tag, report.device_time_dtu);
  writer.number(groma_SlotReport_tag_id_tag, report.tag_id);
  writer.number(groma_SlotReport_slot_tag, report.slot);
  writer.number(groma_SlotReport_superframe_tag, report.superframe);
  writer.number(groma_SlotReport_sequence_tag, report.sequence);
  writer.message(groma_NodeToHost_slot_report_tag, 0);
  return writer.written();
}

std::span<const std::uint8_t> encode_slot_report(const groma_SlotReport& report,
                                                 std::span<std::uint8_t> out) noexcept {
  SlotReportWriter writer;
  writer.begin(report, out);
  for (pb_size_t i = report.ranges_count; i != 0; --i) writer.put_range(report.ranges[i - 1]);
  return writer.finish(report);
}

}  // namespace groma::wire
