#include "firmware/sim/emulator/gpio.hpp"

#include <string>
#include <utility>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kOut = 0x504,
  kOutset = 0x508,
  kOutclr = 0x50C,
  kIn = 0x510,
  kDir = 0x514,
  kDirset = 0x518,
  kDirclr = 0x51C,
  kPinCnf = 0x700,
};

// PIN_CNF
constexpr std::uint32_t kOutput = 1U << 0;
constexpr std::uint32_t kInputDisconnected = 1U << 1;
constexpr std::uint32_t kPullShift = 2;
constexpr std::uint32_t kPullDown = 1;
constexpr std::uint32_t kPullUp = 3;
constexpr std::uint32_t kDriveShift = 8;
constexpr std::uint32_t kModelled = kOutput | kInputDisconnected | 3U << kPullShift | 7U << kDriveShift;

}  // namespace

Gpio::Gpio(OnDrive on_drive, OnLevel on_level)
    : on_drive_(std::move(on_drive)), on_level_(std::move(on_level)) {}

void Gpio::reset(SimTime t) {
  out_ = 0;
  for (Pin& pin : pins_) pin.configuration = kInputDisconnected;
  update(t);
}

void Gpio::drive_from_outside(SimTime t, unsigned pin, PinDrive drive) {
  pins_[pin].outside = drive;
  update_pin(t, pin);
}

PinDrive Gpio::driven(unsigned pin) const noexcept {
  const std::uint32_t configuration = pins_[pin].configuration;
  if ((configuration & kOutput) == 0) return PinDrive::kFloating;
  // S0S1, H0S1, S0H1, H0H1, D0S1, D0H1, S0D1, H0D1
  const std::uint32_t mode = configuration >> kDriveShift & 7U;
  const bool high = (out_ >> pin & 1U) != 0;
  if (high) return mode >= 6 ? PinDrive::kFloating : PinDrive::kHigh;
  return mode == 4 || mode == 5 ? PinDrive::kFloating : PinDrive::kLow;
}

bool Gpio::input_connected(unsigned pin) const noexcept {
  return (pins_[pin].configuration & kInputDisconnected) == 0;
}

bool Gpio::level(unsigned pin) const noexcept {
  const Pin& state = pins_[pin];
  if (state.drive != PinDrive::kFloating) return state.drive == PinDrive::kHigh;
  if (state.outside != PinDrive::kFloating) return state.outside == PinDrive::kHigh;
  return (state.configuration >> kPullShift & 3U) == kPullUp;
}

void Gpio::update_pin(SimTime t, unsigned pin) {
  Pin& state = pins_[pin];
  const PinDrive drive = driven(pin);
  if (drive != state.drive) {
    state.drive = drive;
    on_drive_(t, pin, drive);
  }
  const bool seen = input_connected(pin) && level(pin);
  if (seen != state.level) {
    state.level = seen;
    on_level_(t, pin, seen);
  }
}

void Gpio::update(SimTime t) {
  for (unsigned pin = 0; pin < kPins; ++pin) update_pin(t, pin);
}

std::optional<std::uint32_t> Gpio::read(SimTime, std::uint32_t offset) {
  std::uint32_t bits = 0;
  switch (offset) {
    case kOut:
    case kOutset:
    case kOutclr:
      return out_;
    case kIn:
      for (unsigned pin = 0; pin < kPins; ++pin) bits |= pins_[pin].level ? 1U << pin : 0U;
      return bits;
    case kDir:
    case kDirset:
    case kDirclr:
      for (unsigned pin = 0; pin < kPins; ++pin)
        bits |= (pins_[pin].configuration & kOutput) != 0 ? 1U << pin : 0U;
      return bits;
    default:
      if (offset >= kPinCnf && offset < kPinCnf + 4 * kPins)
        return pins_[(offset - kPinCnf) / 4].configuration;
      return std::nullopt;
  }
}

bool Gpio::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  const std::uint32_t before = out_;
  const auto direct = [&](auto&& output) {
    for (unsigned pin = 0; pin < kPins; ++pin) {
      std::uint32_t& configuration = pins_[pin].configuration;
      configuration = output(pin) ? configuration | kOutput : configuration & ~kOutput;
    }
  };
  const auto bit = [value](unsigned pin) { return (value >> pin & 1U) != 0; };
  const auto is_output = [this](unsigned pin) { return (pins_[pin].configuration & kOutput) != 0; };
  switch (offset) {
    case kOut:
      out_ = value;
      break;
    case kOutset:
      out_ |= value;
      break;
    case kOutclr:
      out_ &= ~value;
      break;
    case kDir:
      direct(bit);
      update(t);
      return true;
    case kDirset:
      direct([&](unsigned pin) { return is_output(pin) || bit(pin); });
      update(t);
      return true;
    case kDirclr:
      direct([&](unsigned pin) { return is_output(pin) && !bit(pin); });
      update(t);
      return true;
    default: {
      if (offset < kPinCnf || offset >= kPinCnf + 4 * kPins) return false;
      const unsigned pin = (offset - kPinCnf) / 4;
      const std::uint32_t pull = value >> kPullShift & 3U;
      if ((value & ~kModelled) != 0 || (pull != 0 && pull != kPullDown && pull != kPullUp)) {
        throw SimulationError("P0: PIN_CNF[" + std::to_string(pin) + "] = " + hexadecimal(value) +
                              " is not modelled");
      }
      pins_[pin].configuration = value;
      update_pin(t, pin);
      return true;
    }
  }
  for (std::uint32_t changed = before ^ out_; changed != 0; changed &= changed - 1)
    update_pin(t, static_cast<unsigned>(__builtin_ctz(changed)));
  return true;
}

}  // namespace groma::sim
