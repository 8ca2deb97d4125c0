// TIMER0 (0x40008000) in timer mode, with six compare registers. Counter mode is not modelled.
#pragma once

#include <array>
#include <cstdint>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Timer final : public Peripheral {
 public:
  void reset();

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override { return next_match_; }
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

 private:
  static constexpr unsigned kChannels = 6;
  static constexpr unsigned kFirstCompare = 16;  // EVENTS_COMPARE[0] at 0x140
  static constexpr SimTime kInputTick = kUnitsPerSecond / 16'000'000;

  [[nodiscard]] SimTime tick() const noexcept { return kInputTick << prescaler_; }
  [[nodiscard]] std::uint64_t period() const noexcept;
  [[nodiscard]] std::uint64_t count(SimTime t) const noexcept;
  void hold(SimTime t, std::uint64_t count) noexcept;
  void schedule(SimTime t, unsigned channel) noexcept;
  void schedule_all(SimTime t) noexcept;

  EventRegisters events_{0x3FU << kFirstCompare};
  std::array<std::uint32_t, kChannels> compare_{};
  std::array<SimTime, kChannels> match_at_ = {kNever, kNever, kNever, kNever, kNever, kNever};
  SimTime next_match_ = kNever;
  bool running_ = false;
  SimTime since_ = 0;  // when the counter was count_
  std::uint64_t count_ = 0;
  std::uint32_t shorts_ = 0;
  std::uint32_t bit_mode_ = 0;
  std::uint32_t prescaler_ = 4;
};

}  // namespace groma::sim
