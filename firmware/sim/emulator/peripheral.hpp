// What all peripherals of the nRF52832 have in common (product specification, peripheral interface).
//
// Time is that of the processor's crystal, in its units (as SimTime, but local). A register that is not
// modelled is told apart from one that is: the access fails the run.
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

  // Offsets are those within the peripheral, multiples of 4; everything due by `t` has been done. Nothing,
  // or false: no such register is modelled. Throw SimulationError for what the hardware would not bear.
  [[nodiscard]] virtual std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) = 0;
  [[nodiscard]] virtual bool write(SimTime t, std::uint32_t offset, std::uint32_t value) = 0;

  // When something happens by itself, and doing it. Called with each such instant, in order.
  [[nodiscard]] virtual SimTime next_event() const noexcept { return kNever; }
  virtual void advance(SimTime t) { (void)t; }

  [[nodiscard]] virtual bool irq() const noexcept { return false; }
};

// The events at 0x100, one bit of INTEN each, in the order of their offsets, with INTENSET and INTENCLR.
class EventRegisters {
 public:
  // `modelled`: the events there are. Those of `polled_only` cannot raise an interrupt here.
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
