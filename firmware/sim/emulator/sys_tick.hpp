// SysTick: a 24-bit counter of processor cycles. ARMv7-M Architecture Reference Manual (DDI 0403E), B3.3.
#pragma once

#include <cstdint>

#include "firmware/sim/time.hpp"

namespace groma::sim {

class SysTick {
 public:
  explicit SysTick(SimTime cycle) noexcept : cycle_(cycle) {}

  void reset() noexcept;
  // Advances the counter to `now`; true if it reached zero and its interrupt is enabled.
  bool advance(SimTime now) noexcept;
  // The time of the next interrupt, or kNever.
  [[nodiscard]] SimTime next_interrupt() const noexcept;

  // CSR, RVR, CVR and CALIB. Reading CSR clears COUNTFLAG. Call advance() first.
  [[nodiscard]] std::uint32_t read_control(SimTime now) noexcept;
  void write_control(SimTime now, std::uint32_t value) noexcept;
  [[nodiscard]] std::uint32_t reload() const noexcept { return reload_; }
  void write_reload(std::uint32_t value) noexcept { reload_ = value & 0xFFFFFF; }
  [[nodiscard]] std::uint32_t current(SimTime now) const noexcept;
  void clear_current(SimTime now) noexcept;

 private:
  [[nodiscard]] bool counting() const noexcept { return enabled_ && zero_at_ != kNever; }
  void start(SimTime now, std::uint32_t from) noexcept;

  SimTime cycle_;
  std::uint32_t reload_ = 0;
  std::uint32_t stopped_at_ = 0;  // the counter's value while it is not enabled
  SimTime zero_at_ = kNever;      // when the counter next reaches zero
  bool enabled_ = false;
  bool interrupts_ = false;
  bool count_flag_ = false;
};

}  // namespace groma::sim
