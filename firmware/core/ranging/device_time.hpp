// Time in the network's units, also those of the frames: ticks of 1/(128 x 499.2 MHz) = 15.65 ps. A radio's
// clock has 40 bits and wraps each 17.2 s; a radio that counts otherwise converts (radio/radio.hpp).
//
//   Ticks       a signed duration
//   DeviceTime  an instant of the radio's clock, modulo 2^40
//   ClockTime   an instant of the node's clock in 64 bits, which does not wrap (9 years)
//   Unwrapper   converts between the two
//
// All conversions to and from numbers, and from durations to instants, are explicit, so that microseconds
// cannot be mistaken for ticks.
#pragma once

#include <compare>
#include <cstdint>

namespace groma::ranging {

class Ticks {
 public:
  static constexpr std::int64_t kPerSecond = 63'897'600'000;
  // 1.0256 us: a PHR symbol, and the unit of the receiver's time-outs.
  static constexpr std::int64_t kPerUus = 65'536;

  constexpr Ticks() noexcept = default;
  constexpr explicit Ticks(std::int64_t count) noexcept : count_(count) {}

  // Rounded to the nearest tick; |us| up to 10^13.
  [[nodiscard]] static constexpr Ticks from_us(std::int64_t us) noexcept {
    const std::int64_t tenths = us * 638'976;
    return Ticks((tenths + (tenths < 0 ? -5 : 5)) / 10);
  }

  [[nodiscard]] constexpr std::int64_t count() const noexcept { return count_; }
  // Rounded down.
  [[nodiscard]] constexpr std::int64_t to_us() const noexcept {
    constexpr std::int64_t kTicksIn10Us = 638'976;
    const std::int64_t whole = count_ / kTicksIn10Us;
    const std::int64_t rest = count_ % kTicksIn10Us;
    const std::int64_t rest_us = rest * 10;
    return whole * 10 + (rest_us - (rest_us < 0 ? kTicksIn10Us - 1 : 0)) / kTicksIn10Us;
  }

  constexpr Ticks& operator+=(Ticks other) noexcept {
    count_ += other.count_;
    return *this;
  }
  constexpr Ticks& operator-=(Ticks other) noexcept {
    count_ -= other.count_;
    return *this;
  }
  friend constexpr Ticks operator+(Ticks a, Ticks b) noexcept { return Ticks(a.count_ + b.count_); }
  friend constexpr Ticks operator-(Ticks a, Ticks b) noexcept { return Ticks(a.count_ - b.count_); }
  friend constexpr Ticks operator-(Ticks a) noexcept { return Ticks(-a.count_); }
  friend constexpr Ticks operator*(Ticks a, std::int64_t n) noexcept { return Ticks(a.count_ * n); }
  friend constexpr Ticks operator*(std::int64_t n, Ticks a) noexcept { return a * n; }
  friend constexpr bool operator==(Ticks, Ticks) noexcept = default;
  friend constexpr std::strong_ordering operator<=>(Ticks a, Ticks b) noexcept {
    return a.count_ <=> b.count_;
  }

 private:
  std::int64_t count_ = 0;
};

class DeviceTime {
 public:
  static constexpr std::uint64_t kMask = (std::uint64_t{1} << 40) - 1;

  constexpr DeviceTime() noexcept = default;
  // From the low 40 bits of `count`.
  constexpr explicit DeviceTime(std::uint64_t count) noexcept : count_(count & kMask) {}

  [[nodiscard]] constexpr std::uint64_t count() const noexcept { return count_; }

  friend constexpr DeviceTime operator+(DeviceTime t, Ticks d) noexcept {
    return DeviceTime(t.count_ + static_cast<std::uint64_t>(d.count()));
  }
  friend constexpr DeviceTime operator-(DeviceTime t, Ticks d) noexcept { return t + -d; }
  // The shorter difference modulo 2^40: -2^39 to 2^39 - 1 ticks, that is +-8.6 s.
  friend constexpr Ticks operator-(DeviceTime later, DeviceTime earlier) noexcept {
    const std::uint64_t modular = (later.count_ - earlier.count_) & kMask;
    const auto signed_ticks = static_cast<std::int64_t>(modular);
    return Ticks(modular >= (kMask + 1) / 2 ? signed_ticks - static_cast<std::int64_t>(kMask) - 1
                                            : signed_ticks);
  }
  friend constexpr bool operator==(DeviceTime, DeviceTime) noexcept = default;

 private:
  std::uint64_t count_ = 0;
};

class ClockTime {
 public:
  constexpr ClockTime() noexcept = default;
  constexpr explicit ClockTime(std::int64_t count) noexcept : count_(count) {}

  [[nodiscard]] constexpr std::int64_t count() const noexcept { return count_; }

  constexpr ClockTime& operator+=(Ticks d) noexcept {
    count_ += d.count();
    return *this;
  }
  friend constexpr ClockTime operator+(ClockTime t, Ticks d) noexcept {
    return ClockTime(t.count_ + d.count());
  }
  friend constexpr ClockTime operator-(ClockTime t, Ticks d) noexcept {
    return ClockTime(t.count_ - d.count());
  }
  friend constexpr Ticks operator-(ClockTime later, ClockTime earlier) noexcept {
    return Ticks(later.count_ - earlier.count_);
  }
  friend constexpr bool operator==(ClockTime, ClockTime) noexcept = default;
  friend constexpr std::strong_ordering operator<=>(ClockTime a, ClockTime b) noexcept {
    return a.count_ <=> b.count_;
  }

 private:
  std::int64_t count_ = 0;
};

// The instants of a superframe are multiples of 512 ticks of network time.
inline constexpr Ticks kTransmitGrid{512};

[[nodiscard]] constexpr Ticks round_up_to_grid(Ticks t) noexcept {
  return Ticks((t.count() + kTransmitGrid.count() - 1) & ~(kTransmitGrid.count() - 1));
}

// The timestamp of the last transmission that can leave the antenna not after `latest`, if the radio starts
// transmissions on `grid`, a power of two up to kTransmitGrid. It is known before the frame is sent.
[[nodiscard]] constexpr ClockTime transmit_timestamp_not_after(ClockTime latest, Ticks antenna_delay,
                                                               Ticks grid) noexcept {
  const std::int64_t at_chip = (latest - antenna_delay).count() & ~(grid.count() - 1);
  return ClockTime(at_chip) + antenna_delay;
}

// Extends the 40-bit counter over its wraps. It must process an instant at least each 8 s. A ClockTime's low
// 9 bits equal the counter's, so that both have the same grid.
class Unwrapper {
 public:
  [[nodiscard]] constexpr DeviceTime wrap(ClockTime t) const noexcept {
    return DeviceTime(static_cast<std::uint64_t>((t - offset_).count()));
  }

  // The instant nearest to the latest one so far; a later one becomes the latest.
  constexpr ClockTime unwrap(DeviceTime t) noexcept {
    const ClockTime result = latest_ + (t - wrap(latest_));
    if (result > latest_) latest_ = result;
    return result;
  }

  // The counter has restarted and now reads `counter`, `elapsed` (not negative) after the latest instant. The
  // clock continues without a step back.
  constexpr void restart(DeviceTime counter, Ticks elapsed) noexcept {
    const ClockTime now = latest_ + elapsed;
    offset_ = round_up_to_grid(Ticks((now - Ticks(static_cast<std::int64_t>(counter.count()))).count()));
    latest_ = now;
  }

  [[nodiscard]] constexpr ClockTime latest() const noexcept { return latest_; }

 private:
  ClockTime latest_;
  Ticks offset_;
};

}  // namespace groma::ranging
