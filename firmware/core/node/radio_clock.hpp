// The radio's clock in 64 bits, and beside it the processor's, in us since boot (Platform::now_us()).
#pragma once

#include <algorithm>
#include <cstdint>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::node {

class RadioClock {
 public:
  using ClockTime = ranging::ClockTime;
  using Ticks = ranging::Ticks;

  [[nodiscard]] ranging::DeviceTime wrap(ClockTime t) const noexcept { return counter_.wrap(t); }
  // The instant of the counter that is nearest to the latest one so far.
  ClockTime unwrap(ranging::DeviceTime counter) noexcept { return counter_.unwrap(counter); }
  [[nodiscard]] ClockTime latest() const noexcept { return counter_.latest(); }

  // Records that the radio's clock showed `radio` at `us`; the functions below convert from there.
  void refer(ClockTime radio, std::uint64_t us) noexcept { reference_ = {radio, us}; }
  [[nodiscard]] ClockTime reference() const noexcept { return reference_.radio; }

  // When the radio's clock shows `t`, at most 2 us too early; for a `t` before the reference, the reference.
  [[nodiscard]] std::uint64_t us_at(ClockTime t) const noexcept {
    return reference_.us + rough_us(t - reference_.radio);
  }
  // From `from_us` until the radio's clock shows `t`; negative if that is past.
  [[nodiscard]] std::int32_t us_until(ClockTime t, std::uint64_t from_us) const noexcept {
    const Ticks left = t - reference_.radio;
    return static_cast<std::int32_t>(rough_us(left) - rough_us(-left) - (from_us - reference_.us));
  }
  // Rounded down without a 64-bit division: 65536 ticks are 40/39 us. 0 for a negative duration.
  [[nodiscard]] static std::uint64_t rough_us(Ticks t) noexcept {
    if (t.count() <= 0) return 0;
    const auto uus = static_cast<std::uint32_t>(t.count() >> 16);
    return std::uint64_t{uus} + uus / 39;
  }

  // What the radio's clock shows at `us`, to some ms.
  [[nodiscard]] ClockTime expected_at(std::uint64_t us) const noexcept {
    constexpr std::int64_t kRoughlyPer_us = 63'898;
    return reference_.radio + kRoughlyPer_us * Ticks(static_cast<std::int64_t>(us - reference_.us));
  }
  // The counter, if it runs, may read `counter` at `us`.
  [[nodiscard]] bool is_plausible(ranging::DeviceTime counter, std::uint64_t us) const noexcept {
    constexpr Ticks kMostApart = Ticks::from_us(100'000);
    const Ticks apart = counter - wrap(expected_at(us));
    return apart < kMostApart && -apart < kMostApart;
  }

  // As refer(), for clocks that were read together, about once a second: restart() needs the last two pairs.
  void pair(ClockTime radio, std::uint64_t us) noexcept {
    former_pair_ = pair_;
    pair_ = reference_ = {radio, us};
  }
  // The counter has restarted and reads `counter` at `now_us`: continues the radio's clock by the
  // processor's. Returns whether the error is some us, which takes two pairs.
  bool restart(ranging::DeviceTime counter, std::uint64_t now_us) noexcept {
    ClockTime now = reference_.radio + elapsed(now_us - reference_.us);
    const bool exact = former_pair_.us != 0;
    if (exact) {
      const std::uint64_t apart_us = pair_.us - former_pair_.us;
      const std::uint64_t since_us = now_us - pair_.us;
      const std::int64_t excess = (pair_.radio - former_pair_.radio - elapsed(apart_us)).count();
      now = pair_.radio + elapsed(since_us) +
            Ticks(excess * static_cast<std::int64_t>(since_us) / static_cast<std::int64_t>(apart_us));
    }
    counter_.restart(counter, std::max(now - latest(), Ticks(0)));
    refer(latest(), now_us);
    return exact;
  }

 private:
  struct Pair {
    ClockTime radio;
    std::uint64_t us = 0;  // 0: never
  };

  [[nodiscard]] static Ticks elapsed(std::uint64_t us) noexcept {
    return Ticks::from_us(static_cast<std::int64_t>(us));
  }

  ranging::Unwrapper counter_;
  Pair reference_;
  Pair pair_;  // of the last call of pair(), and of the one before
  Pair former_pair_;
};

}  // namespace groma::node
