// Timing of a configuration on trial: when its time is over, the previous configuration gets as long, and so
// on in turn until one of the two is confirmed.
#pragma once

#include <cstdint>

#include "firmware/core/node/platform.hpp"

namespace groma::node {

class Trial {
 public:
  static constexpr std::uint32_t kUsual_s = 60;

  void begin(std::uint64_t now_us, std::uint32_t duration_s) noexcept {
    round_ = 0;
    duration_us_ = std::uint64_t{duration_s} * 1'000'000;
    go_on(now_us);
  }
  void go_on(std::uint64_t now_us) noexcept { end_us_ = now_us + duration_us_; }
  void end() noexcept { end_us_ = kNever_us; }

  [[nodiscard]] bool under_way() const noexcept { return end_us_ != kNever_us; }
  [[nodiscard]] bool is_over(std::uint64_t now_us) const noexcept { return now_us >= end_us_; }
  // In the first round an acknowledged answer confirms the configuration; in later rounds synchronization is
  // enough.
  [[nodiscard]] bool in_first_round() const noexcept { return round_ == 0; }
  // Returns true if it is the turn of the previous configuration.
  [[nodiscard]] bool next_round() noexcept { return ++round_ % 2 != 0; }

 private:
  std::uint8_t round_ = 0;
  std::uint64_t duration_us_ = 0;
  std::uint64_t end_us_ = kNever_us;
};

}  // namespace groma::node
