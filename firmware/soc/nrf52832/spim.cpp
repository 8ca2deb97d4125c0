#include "firmware/soc/nrf52832/spim.hpp"

#include "firmware/soc/nrf52832/gpio.hpp"

namespace groma::nrf52832 {

void Spim::start(SpiFrequency frequency) noexcept {
  pin::set(pins_.select);
  pin::configure(pins_.select, gpio::kOutput);
  pin::clear(pins_.clock);
  // Nordic's older drivers say that SPI works only with the clock's input buffer.
  pin::configure(pins_.clock, gpio::kOutputWithInput);
  pin::clear(pins_.out);
  pin::configure(pins_.out, gpio::kOutput);
  pin::configure(pins_.in, gpio::kInput);
  registers_[spim::kPinClock] = pins_.clock;
  registers_[spim::kPinOut] = pins_.out;
  registers_[spim::kPinIn] = pins_.in;
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
  clear_event(registers_[spim::kEventEnd]);
  pin::clear(pins_.select);
  asm volatile("" ::: "memory");
  registers_[spim::kStart] = 1;
  // Awake, because of anomaly 109.
  while (registers_[spim::kEventEnd] == 0) {
  }
  asm volatile("" ::: "memory");
  pin::set(pins_.select);
}

void Spim::select(bool low) noexcept {
  if (low) {
    pin::clear(pins_.select);
  } else {
    pin::set(pins_.select);
  }
}

}  // namespace groma::nrf52832
