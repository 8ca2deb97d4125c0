#include "proto/compact_report.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>

namespace groma::wire {
namespace {

// 1/(499.2 MHz x 128): 63897.6 ticks per microsecond.
constexpr std::int64_t kTicksPer10us = 638'976;
constexpr float kStepsPerMetre = 10'000.0F;
constexpr std::uint32_t kLargest24 = 0xFF'FFFF;
constexpr std::int32_t kPowerStep_cdbm = -50;
constexpr std::uint8_t kWeakest = 0xFE;
constexpr std::uint8_t kUnknownPower = 0xFF;
constexpr std::uint16_t kLargestNoise = 0xFF;

using Record = std::array<std::uint8_t, kCompactRangeBytes>;

static_assert(sizeof(groma_CompactReport{}.ranges.bytes) ==
              kCompactRangeBytes * sizeof(groma_SlotReport{}.ranges) / sizeof(groma_Range));
static_assert(sizeof(groma_CompactReport{}.traits.bytes) ==
              kCompactTraitBytes * sizeof(groma_SlotReport{}.ranges) / sizeof(groma_Range));

void store(std::uint8_t* out, unsigned bytes, std::uint32_t value) noexcept {
  for (unsigned i = 0; i < bytes; ++i) out[i] = static_cast<std::uint8_t>(value >> (8 * i));
}

std::uint32_t load(const std::uint8_t* in, unsigned bytes) noexcept {
  std::uint32_t value = 0;
  for (unsigned i = 0; i < bytes; ++i) value |= std::uint32_t{in[i]} << (8 * i);
  return value;
}

std::uint32_t distance_steps(float range_m) noexcept {
  const float steps = range_m * kStepsPerMetre + 0.5F;
  if (!(steps >= 0.0F)) return 0;
  if (steps >= static_cast<float>(kLargest24)) return kLargest24;
  return static_cast<std::uint32_t>(steps);
}

std::uint32_t age_us(std::int64_t instant_offset_dtu) noexcept {
  if (instant_offset_dtu >= 0) return 0;
  const std::int64_t limit = -static_cast<std::int64_t>(kLargest24) * kTicksPer10us / 10;
  if (instant_offset_dtu <= limit) return kLargest24;
  return static_cast<std::uint32_t>((-instant_offset_dtu * 10 + kTicksPer10us / 2) / kTicksPer10us);
}

std::uint8_t power_steps(bool known, std::int32_t power_cdbm) noexcept {
  if (!known) return kUnknownPower;
  if (power_cdbm >= 0) return 0;
  if (power_cdbm <= kWeakest * kPowerStep_cdbm) return kWeakest;
  return static_cast<std::uint8_t>((power_cdbm + kPowerStep_cdbm / 2) / kPowerStep_cdbm);
}

void expand_power(std::uint8_t steps, bool& known, std::int16_t& power_cdbm) noexcept {
  known = steps != kUnknownPower;
  power_cdbm = known ? static_cast<std::int16_t>(steps * kPowerStep_cdbm) : std::int16_t{0};
}

}  // namespace

void compact_report(const groma_SlotReport& report, groma_CompactReport& out) noexcept {
  out = groma_CompactReport_init_zero;
  out.sequence = report.sequence;
  out.superframe = report.superframe;
  out.slot = report.slot;
  out.tag_id = report.tag_id;
  out.device_time_dtu = report.device_time_dtu;
  out.network_time_dtu = report.network_time_dtu;
  out.network_rate_ppb = report.network_rate_ppb;
  for (pb_size_t i = 0; i < report.ranges_count; ++i) {
    const groma_Range& range = report.ranges[i];
    std::uint8_t* record = out.ranges.bytes + out.ranges.size;
    store(record, 2, range.anchor_id);
    record[2] = static_cast<std::uint8_t>(range.status);
    store(record + 3, 3, range.status == groma_RangeStatus_RANGE_OK ? distance_steps(range.range_m) : 0);
    store(record + 6, 3, age_us(range.instant_offset_dtu));
    record[9] = power_steps(range.has_first_path_power_cdbm, range.first_path_power_cdbm);
    record[10] = power_steps(range.has_receive_power_cdbm, range.receive_power_cdbm);
    out.ranges.size = static_cast<pb_size_t>(out.ranges.size + kCompactRangeBytes);
    std::uint8_t* traits = out.traits.bytes + out.traits.size;
    traits[0] = range.flags;
    traits[1] = static_cast<std::uint8_t>(std::min(range.noise, kLargestNoise));
    out.traits.size = static_cast<pb_size_t>(out.traits.size + kCompactTraitBytes);
  }
}

bool expand_report(const groma_CompactReport& report, groma_SlotReport& out) noexcept {
  if (report.ranges.size % kCompactRangeBytes != 0) return false;
  out = groma_SlotReport_init_zero;
  out.sequence = report.sequence;
  out.superframe = report.superframe;
  out.slot = report.slot;
  out.tag_id = report.tag_id;
  out.device_time_dtu = report.device_time_dtu;
  out.network_time_dtu = report.network_time_dtu;
  out.network_rate_ppb = report.network_rate_ppb;
  out.ranges_count = static_cast<pb_size_t>(report.ranges.size / kCompactRangeBytes);
  const bool has_traits = report.traits.size == out.ranges_count * kCompactTraitBytes;
  for (pb_size_t i = 0; i < out.ranges_count; ++i) {
    const std::uint8_t* record = report.ranges.bytes + i * kCompactRangeBytes;
    groma_Range& range = out.ranges[i];
    range.anchor_id = static_cast<std::uint16_t>(load(record, 2));
    // Copied unchecked: a reader has to expect any number, as from the wire.
    const std::uint32_t status = record[2];
    static_assert(sizeof(range.status) == sizeof(status));
    std::memcpy(&range.status, &status, sizeof(status));
    range.range_m = static_cast<float>(load(record + 3, 3)) / kStepsPerMetre;
    range.instant_offset_dtu = -static_cast<std::int64_t>(load(record + 6, 3)) * kTicksPer10us / 10;
    expand_power(record[9], range.has_first_path_power_cdbm, range.first_path_power_cdbm);
    expand_power(record[10], range.has_receive_power_cdbm, range.receive_power_cdbm);
    if (!has_traits) continue;
    range.flags = report.traits.bytes[i * kCompactTraitBytes];
    range.noise = report.traits.bytes[i * kCompactTraitBytes + 1];
  }
  return true;
}

}  // namespace groma::wire
