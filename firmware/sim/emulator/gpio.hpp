// P0 (0x50000000) with its 32 pins and the signals on them.
#pragma once

#include <array>
#include <functional>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

enum class PinDrive : std::uint8_t { kFloating, kLow, kHigh };

class Gpio final : public Peripheral {
 public:
  static constexpr unsigned kPins = 32;

  // Callbacks for a change of the chip's drive of a pin, and of a pin's level as an input.
  using OnDrive = std::function<void(SimTime t, unsigned pin, PinDrive drive)>;
  using OnLevel = std::function<void(SimTime t, unsigned pin, bool high)>;

  Gpio(OnDrive on_drive, OnLevel on_level);

  // All pins become floating inputs with the input buffer disconnected.
  void reset(SimTime t);

  // Sets the external drive of the pin.
  void drive_from_outside(SimTime t, unsigned pin, PinDrive drive);

  [[nodiscard]] PinDrive drive(unsigned pin) const noexcept { return pins_[pin].drive; }
  [[nodiscard]] bool input_connected(unsigned pin) const noexcept;
  // The level on the wire: driven, else pulled, else low.
  [[nodiscard]] bool level(unsigned pin) const noexcept;

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;

 private:
  struct Pin {
    std::uint32_t configuration = 2;  // PIN_CNF
    PinDrive drive = PinDrive::kFloating;
    PinDrive outside = PinDrive::kFloating;
    bool level = false;
  };

  void update(SimTime t);
  void update_pin(SimTime t, unsigned pin);
  [[nodiscard]] PinDrive driven(unsigned pin) const noexcept;

  OnDrive on_drive_;
  OnLevel on_level_;
  std::uint32_t out_ = 0;
  std::array<Pin, kPins> pins_{};
};

}  // namespace groma::sim
