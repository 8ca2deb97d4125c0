#include "firmware/core/ranging/twr.hpp"

#include <algorithm>

namespace groma::ranging {
namespace {

// The product of two intervals has 80 bits, and a Cortex-M4 has no 128-bit integer.
struct Wide {
  std::uint64_t high = 0;
  std::uint64_t low = 0;
};

constexpr bool less(const Wide& a, const Wide& b) noexcept {
  return a.high != b.high ? a.high < b.high : a.low < b.low;
}

constexpr Wide add(const Wide& a, const Wide& b) noexcept {
  Wide sum{a.high + b.high, a.low + b.low};
  if (sum.low < a.low) ++sum.high;
  return sum;
}

constexpr Wide subtract(const Wide& a, const Wide& b) noexcept {
  return {a.high - b.high - (a.low < b.low ? 1U : 0U), a.low - b.low};
}

constexpr Wide multiply(std::uint64_t a, std::uint64_t b) noexcept {
  constexpr std::uint64_t kLow = 0xFFFF'FFFF;
  const std::uint64_t ll = (a & kLow) * (b & kLow);
  const std::uint64_t lh = (a & kLow) * (b >> 32);
  const std::uint64_t hl = (a >> 32) * (b & kLow);
  const std::uint64_t middle = (ll >> 32) + (lh & kLow) + (hl & kLow);
  return {(a >> 32) * (b >> 32) + (lh >> 32) + (hl >> 32) + (middle >> 32), (middle << 32) | (ll & kLow)};
}

constexpr Wide shift_left(const Wide& a, int bits) noexcept {
  return {(a.high << bits) | (a.low >> (64 - bits)), a.low << bits};
}

// The quotient's low 64 bits, rounded down. The divisor must be below 2^48, so that the remainder and a digit
// of 16 bits fit into 64 bits.
constexpr std::uint64_t divide(const Wide& numerator, std::uint64_t divisor) noexcept {
  std::uint64_t quotient = 0;
  std::uint64_t remainder = 0;
  for (int digit = 7; digit >= 0; --digit) {
    const std::uint64_t word = digit >= 4 ? numerator.high : numerator.low;
    const std::uint64_t chunk = (remainder << 16) | ((word >> (16 * (digit % 4))) & 0xFFFF);
    // Most digits are zero, and a division takes a Cortex-M4 a hundred instructions.
    const std::uint64_t value = chunk < divisor ? 0 : chunk / divisor;
    quotient = (quotient << 16) | value;
    remainder = chunk - value * divisor;
  }
  return quotient;
}

constexpr bool in_bounds(Ticks t) noexcept {
  return t.count() >= 1 && static_cast<std::uint64_t>(t.count()) <= DeviceTime::kMask;
}

constexpr std::uint64_t positive(Ticks t) noexcept {
  return static_cast<std::uint64_t>(t.count());
}

constexpr std::int64_t with_sign(std::uint64_t magnitude, bool negative) noexcept {
  const auto value = static_cast<std::int64_t>(magnitude);
  return negative ? -value : value;
}

}  // namespace

std::optional<FlightTime> double_sided(const DoubleSidedIntervals& i) noexcept {
  if (!in_bounds(i.tag_round) || !in_bounds(i.anchor_reply) || !in_bounds(i.anchor_round) ||
      !in_bounds(i.tag_reply)) {
    return std::nullopt;
  }
  const Wide rounds = multiply(positive(i.tag_round), positive(i.anchor_round));
  const Wide replies = multiply(positive(i.anchor_reply), positive(i.tag_reply));
  const std::uint64_t sum = positive(i.tag_round + i.anchor_round + i.anchor_reply + i.tag_reply);
  const bool negative = less(rounds, replies);
  const Wide difference = negative ? subtract(replies, rounds) : subtract(rounds, replies);
  const Wide scaled = add(shift_left(difference, FlightTime::kFractionBits), {0, sum / 2});
  return FlightTime(with_sign(divide(scaled, sum), negative));
}

std::optional<FlightTime> single_sided(Ticks round, Ticks reply, std::int32_t offset_ppb) noexcept {
  if (!in_bounds(round) || !in_bounds(reply)) return std::nullopt;
  // 256 ((round - reply) + reply e / 10^9) / 2, with the correction in 256ths: 40 + 20 + 8 bits before the
  // division.
  constexpr std::uint64_t kBillion = 1'000'000'000;
  const bool slow = offset_ppb < 0;
  const auto magnitude_ppb = static_cast<std::uint64_t>(slow ? -std::int64_t{offset_ppb} : offset_ppb);
  const Wide product = shift_left(multiply(positive(reply), magnitude_ppb), FlightTime::kFractionBits);
  const std::uint64_t correction = divide(add(product, {0, kBillion / 2}), kBillion);
  const std::int64_t twice = (round - reply).count() * 256 + with_sign(correction, slow);
  return FlightTime((twice + (twice < 0 ? -1 : 1)) / 2);
}

std::int32_t clock_offset_ppb(const DoubleSidedIntervals& i) noexcept {
  constexpr std::int64_t kLimit_ppb = 1'000'000;
  constexpr std::uint64_t kBillion = 1'000'000'000;
  const Ticks by_tag = i.tag_round + i.tag_reply;
  const Ticks by_anchor = i.anchor_round + i.anchor_reply;
  const std::int64_t difference = (by_anchor - by_tag).count();
  const bool slow = difference < 0;
  const auto magnitude = static_cast<std::uint64_t>(slow ? -difference : difference);
  // Beyond the limit the quotient could exceed 64 bits.
  if (by_tag.count() <= 0 || magnitude > positive(by_tag) / 1000) {
    return static_cast<std::int32_t>(slow ? -kLimit_ppb : kLimit_ppb);
  }
  const std::uint64_t ppb =
      divide(add(multiply(magnitude, kBillion), {0, positive(by_tag) / 2}), positive(by_tag));
  return static_cast<std::int32_t>(with_sign(ppb, slow));
}

}  // namespace groma::ranging
