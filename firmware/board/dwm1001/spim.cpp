#include "firmware/board/dwm1001/spim.hpp"

#include "firmware/board/dwm1001/pins.hpp"

namespace groma::dwm1001 {

namespace gpio = nrf52832::gpio;
namespace spim = nrf52832::spim;

void Spim::start(SpiFrequency frequency) noexcept {
  pin::set(wiring_.select_pin);
  pin::configure(wiring_.select_pin, gpio::kOutput);
  pin::clear(wiring_.clock_pin);
  // Nordic's older drivers say that SPI works only with the clock's input buffer.
  pin::configure(wiring_.clock_pin, gpio::kOutputWithInput);
  pin::clear(wiring_.out_pin);
  pin::configure(wiring_.out_pin, gpio::kOutput);
  pin::configure(wiring_.in_pin, gpio::kInput);
  registers_[spim::kPinClock] = wiring_.clock_pin;
  registers_[spim::kPinOut] = wiring_.out_pin;
  registers_[spim::kPinIn] = wiring_.in_pin;
  registers_[spim::kConfig] = 0;
  registers_[spim::kOverReadByte] = 0;
  set_frequency(frequency);
  registers_[spim::kEnable] = spim::kEnabled;
}

void Spim::set_frequency(SpiFrequency frequency) noexcept {
  registers_[spim::kFrequency] = static_cast<std::uint32_t>(frequency);
}

void Spim::transfer(std::span<const std::uint8_t> out, std::span<std::uint8_t> in) noexcept {
  registers_[spim::kTransmitPointer] = reinterpret_cast<std::uintptr_t>(out.data());
  registers_[spim::kTransmitCount] = out.size();
  registers_[spim::kReceivePointer] = reinterpret_cast<std::uintptr_t>(in.data());
  registers_[spim::kReceiveCount] = in.size();
  nrf52832::clear_event(registers_[spim::kEventEnd]);
  pin::clear(wiring_.select_pin);
  asm volatile("" ::: "memory");
  registers_[spim::kStart] = 1;
  // Awake, because of anomaly 109.
  while (registers_[spim::kEventEnd] == 0) {
  }
  asm volatile("" ::: "memory");
  pin::set(wiring_.select_pin);
}

void Spim::select(bool low) noexcept {
  if (low) {
    pin::clear(wiring_.select_pin);
  } else {
    pin::set(wiring_.select_pin);
  }
}

}  // namespace groma::dwm1001
