#include "firmware/board/dwm1001/spim.hpp"

#include "firmware/board/dwm1001/cpu.hpp"
#include "firmware/board/dwm1001/pins.hpp"

namespace groma::dwm1001 {

namespace gpio = nrf52832::gpio;
namespace spim = nrf52832::spim;

// There is one processor, and its interrupt handlers see memory in program order.
constexpr auto kRelaxed = std::memory_order_relaxed;

void Spim::start(SpiFrequency frequency) noexcept {
  pin::set(wiring_.select_pin);
  pin::configure(wiring_.select_pin, gpio::kOutput);
  pin::clear(wiring_.clock_pin);
  pin::configure(wiring_.clock_pin, gpio::kOutput);
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
  registers_[spim::kEventEnd] = 0;
  registers_[spim::kInterruptSet] = spim::kInterruptEnd;
  enable_interrupt(wiring_.irq, Priority::kPeripheral);
}

void Spim::set_frequency(SpiFrequency frequency) noexcept {
  registers_[spim::kFrequency] = static_cast<std::uint32_t>(frequency);
}

void Spim::transfer(std::span<const std::uint8_t> out, std::span<std::uint8_t> in) noexcept {
  registers_[spim::kTransmitPointer] = reinterpret_cast<std::uintptr_t>(out.data());
  registers_[spim::kTransmitCount] = out.size();
  registers_[spim::kReceivePointer] = reinterpret_cast<std::uintptr_t>(in.data());
  registers_[spim::kReceiveCount] = in.size();
  over_.store(false, kRelaxed);
  pin::clear(wiring_.select_pin);
  asm volatile("" ::: "memory");
  registers_[spim::kStart] = 1;
  for (bool over = false; !over;) {
    const InterruptLock lock;
    // The interrupt may have come while another one was served.
    if (!over_.load(kRelaxed)) sleep();
    if (registers_[spim::kEventEnd] != 0) {
      // Clears the interrupt: taking it now would only cost time.
      nrf52832::clear_event(registers_[spim::kEventEnd]);
      clear_pending_interrupt(wiring_.irq);
      over = true;
    } else {
      over = over_.load(kRelaxed);
    }
  }
  asm volatile("" ::: "memory");
  pin::set(wiring_.select_pin);
}

void Spim::on_interrupt() noexcept {
  nrf52832::clear_event(registers_[spim::kEventEnd]);
  over_.store(true, kRelaxed);
}

}  // namespace groma::dwm1001
