#include "firmware/core/mac/exchange.hpp"

#include <cstdlib>

namespace groma::mac {
namespace {

constexpr std::int32_t kClockTolerance_ppb = 100'000;
// The carrier's offset has about 0.1 ppm of noise; drift within an exchange adds less.
constexpr std::int32_t kCarrierTolerance_ppb = 5'000;
constexpr ranging::FlightTime kShortest{std::int64_t{-2131} * 256};   // -10 m
constexpr ranging::FlightTime kLongest{std::int64_t{213'140} * 256};  // 1 km

// The noise of two timestamps in a short exchange looks like a clock offset: half a nanosecond over its
// length.
std::int32_t timestamp_tolerance_ppb(Ticks length) noexcept {
  constexpr std::int64_t kNoise_ticks = 32;
  return static_cast<std::int32_t>(kNoise_ticks * 1'000'000'000 / length.count());
}

bool plausible(const Range& range, const Leg& leg) noexcept {
  const std::int32_t offset_ppb = range.clock_offset_ppb;
  if (std::abs(offset_ppb) > kClockTolerance_ppb) return false;
  const Ticks length = range.intervals.tag_round + range.intervals.tag_reply;
  const std::int32_t tolerance_ppb = kCarrierTolerance_ppb + timestamp_tolerance_ppb(length);
  const std::int32_t carrier_ppb = leg.quality.clock_offset_ppb.value_or(offset_ppb);
  if (std::abs(offset_ppb - carrier_ppb) > tolerance_ppb) return false;
  return range.flight >= kShortest && range.flight <= kLongest;
}

}  // namespace

Range evaluate(const Exchange& exchange, const Leg& leg) noexcept {
  if (!leg.answered) return {};
  if (!leg.timestamp_valid) return {.status = RangeStatus::kBadTimestamp};
  if (leg.closing_state == Leg::Closing::kStale) return {.status = RangeStatus::kStale};
  const bool closed = leg.closing_state == Leg::Closing::kHeld && exchange.closing_sent;
  if (!closed || *exchange.closing_sent - leg.received > kMaxClosing)
    return {.status = RangeStatus::kNoClosingTimestamp};
  Range range{.status = RangeStatus::kBadTimestamp,
              .intervals = {.tag_round = leg.received - exchange.poll_sent,
                            .anchor_reply = leg.reply,
                            .anchor_round = leg.closing,
                            .tag_reply = *exchange.closing_sent - leg.received}};
  const auto flight = ranging::double_sided(range.intervals);
  if (!flight) return range;
  range.flight = *flight;
  range.clock_offset_ppb = ranging::clock_offset_ppb(range.intervals);
  if (plausible(range, leg)) range.status = RangeStatus::kOk;
  return range;
}

}  // namespace groma::mac
