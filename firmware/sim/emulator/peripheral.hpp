// The common interface of the nRF52832's peripherals (product specification, peripheral interface).
//
// Times are local: those of the processor's crystal, in units of SimTime. An access to a register that is not
// modelled fails the run.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// "0x40002534"
[[nodiscard]] std::string hexadecimal(std::uint32_t value);

class Peripheral {
 public:
  Peripheral() = default;
  Peripheral(const Peripheral&) = delete;
  Peripheral& operator=(const Peripheral&) = delete;
  virtual ~Peripheral() = default;

  // `offset`: within the peripheral, a multiple of 4. All events due by `t` have been handled. nullopt, or
  // false: no such register is modelled. Both throw SimulationError for a misuse of the hardware.
  [[nodiscard]] virtual std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) = 0;
  [[nodiscard]] virtual bool write(SimTime t, std::uint32_t offset, std::uint32_t value) = 0;

  // The next internal event, and its handling. advance() is called for each event's instant, in order.
  [[nodiscard]] virtual SimTime next_event() const noexcept { return kNever; }
  virtual void advance(SimTime t) { (void)t; }

  [[nodiscard]] virtual bool irq() const noexcept { return false; }
};

// The events from offset 0x100, each with a bit of INTEN in the order of their offsets; INTENSET and
// INTENCLR.
class EventRegisters {
 public:
  // `modelled`: the events that exist. Interrupts of those in `polled_only` cannot be enabled.
  explicit constexpr EventRegisters(std::uint32_t modelled, std::uint32_t polled_only = 0) noexcept
      : modelled_(modelled), polled_only_(polled_only) {}

  void raise(unsigned event) noexcept { events_ |= 1U << event; }
  [[nodiscard]] bool raised(unsigned event) const noexcept { return (events_ >> event & 1U) != 0; }
  [[nodiscard]] std::uint32_t enabled() const noexcept { return enabled_; }
  [[nodiscard]] bool irq() const noexcept { return (events_ & enabled_) != 0; }

  [[nodiscard]] std::optional<std::uint32_t> read(std::uint32_t offset) const noexcept;
  [[nodiscard]] bool write(std::uint32_t offset, std::uint32_t value) noexcept;

 private:
  [[nodiscard]] bool is_event(std::uint32_t offset) const noexcept;

  std::uint32_t modelled_;
  std::uint32_t polled_only_;
  std::uint32_t events_ = 0;
  std::uint32_t enabled_ = 0;
};

}  // namespace groma::sim
