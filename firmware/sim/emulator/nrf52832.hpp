// The nRF52832 around its processor, on a DWM1001: the peripherals that the board's image uses, strictly.
//
// 0x40000000 CLOCK, POWER   0x40002000 UARTE0   0x40004000 SPIM1    0x40006000 GPIOTE   0x40008000 TIMER0
// 0x4000E000 ECB            0x40010000 WDT      0x4001E000 NVMC     0x40023000 SPIM2    0x50000000 P0
// 0x10000000 FICR           0x10001000 UICR
//
// An access to any other register of these, or to any other peripheral of the chip, fails the run; one to
// where the chip has nothing is a bus fault. Registers are read and written as words alone.
//
// What it does not do: the internal oscillators are as exact as the crystals; a GPIO that a serial peripheral
// uses is not checked against its PIN_CNF; erratum 109 (EasyDMA out of sleep) does not concern tasks that the
// processor starts.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/emulator/clock_power.hpp"
#include "firmware/sim/emulator/cortex_m4.hpp"
#include "firmware/sim/emulator/ecb.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/gpio.hpp"
#include "firmware/sim/emulator/gpiote.hpp"
#include "firmware/sim/emulator/information.hpp"
#include "firmware/sim/emulator/nvmc.hpp"
#include "firmware/sim/emulator/radio_device.hpp"
#include "firmware/sim/emulator/spim.hpp"
#include "firmware/sim/emulator/timer.hpp"
#include "firmware/sim/emulator/uarte.hpp"
#include "firmware/sim/emulator/watchdog.hpp"
#include "firmware/sim/node_clock.hpp"
#include "firmware/sim/uart.hpp"

namespace groma::sim {

// The module's wiring: P0 pin numbers.
namespace dwm1001 {
inline constexpr unsigned kRadioSelect = 17;
inline constexpr unsigned kRadioInterrupt = 19;
inline constexpr unsigned kRadioReset = 24;
inline constexpr unsigned kCanSelect = 3;
inline constexpr unsigned kCanInterrupt = 27;
inline constexpr std::array<unsigned, 4> kLights = {14, 22, 30, 31};  // red, red, green, blue; lit when low
}  // namespace dwm1001

// What the peripherals ask of the processor, beside what it asks of them as a bus.
class Processor {
 public:
  Processor() = default;
  Processor(const Processor&) = delete;
  Processor& operator=(const Processor&) = delete;
  virtual ~Processor() = default;

  // As CortexM4's; local time.
  [[nodiscard]] virtual SimTime now() const = 0;
  [[nodiscard]] virtual std::uint32_t pc() const = 0;
  virtual void limit(SimTime t) = 0;
  virtual void stall(SimTime duration) = 0;
  virtual void set_irq(unsigned irq, bool level) = 0;
  virtual void flash_changed(std::uint32_t address, std::size_t bytes) = 0;
};

class Nrf52832 final : public Bus {
 public:
  // What the peripherals are made of and connected to; all of it outlives them.
  struct Parts {
    Processor& processor;
    const NodeClock& clock;  // the processor's crystal
    std::span<std::uint8_t> flash;
    std::span<std::uint8_t> ram;
    std::span<std::uint8_t> uicr;
    ChipIdentity identity;
    RadioDevice& radio;
    SpiDevice* can = nullptr;  // nothing on the header's SPI: reads give zeros
    UartLine& to_host;
    UartLine& from_host;
    std::uint32_t bits_per_s = 1'000'000;
  };

  // Bytes from the host reach the UARTE this much later than they are through its line, so that a processor
  // that has run ahead of the world by no more never misses one.
  static constexpr SimTime kHostDelay = 50 * kUnitsPerMicrosecond;

  explicit Nrf52832(const Parts& parts);

  // Local time from here on, but for the devices' own.
  void reset(ResetCause cause, SimTime t);
  void power_cut(SimTime t);
  // Does all that is due by t, each at its own time.
  void advance(SimTime t);
  // When the next is due, told anew after what other nodes did.
  [[nodiscard]] SimTime next_event();

  bool read(std::uint32_t address, unsigned bytes, std::uint32_t& value) override;
  bool write(std::uint32_t address, unsigned bytes, std::uint32_t value) override;
  bool flash_write(std::uint32_t address, unsigned bytes, std::uint32_t value) override;

  [[nodiscard]] const Gpio& gpio() const noexcept { return gpio_; }
  [[nodiscard]] const Nvmc& nvmc() const noexcept { return nvmc_; }
  [[nodiscard]] const Uarte& uarte() const noexcept { return uarte_; }
  [[nodiscard]] const Spim& radio_spi() const noexcept { return spim2_; }
  [[nodiscard]] const Spim& can_spi() const noexcept { return spim1_; }
  [[nodiscard]] const Ecb& ecb() const noexcept { return ecb_; }
  [[nodiscard]] const Watchdog& watchdog() const noexcept { return watchdog_; }
  // One of the module's lights.
  [[nodiscard]] bool lit(std::size_t light) const noexcept {
    return gpio_.drive(dwm1001::kLights[light]) == PinDrive::kLow;
  }

 private:
  struct Block {
    Peripheral* peripheral;
    std::uint32_t base;
    int irq;  // -1: none
    bool level = false;
    SimTime next = kNever;  // the peripheral's next_event()
  };
  // A chip on an SPI bus with its select and interrupt pins.
  struct Slot {
    const char* name;
    SpiDevice* device;
    unsigned select_pin;
    unsigned interrupt_pin;
    bool active_high;
    unsigned transfers_in_window = 0;
    SimTime event = kNever;        // the device's
    SimTime event_local = kNever;  // the same by the processor's crystal
  };

  [[nodiscard]] Block* find(std::uint32_t address);
  [[nodiscard]] SimTime world(SimTime local) const noexcept { return parts_.clock.time_of_local(local); }
  [[nodiscard]] SimTime local(SimTime world) const noexcept {
    return world == kNever ? kNever : parts_.clock.local_units(world);
  }
  void look_outside();
  void look_at(Block& block);
  void look_at_all();
  void settle();
  void step(SimTime t);
  void update_interrupt_pin(SimTime t, const Slot& slot);
  bool exchange(Slot& slot, SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz);
  void pin_driven(SimTime t, unsigned pin, PinDrive drive);
  [[noreturn]] void fail(const std::string& what, std::uint32_t address) const;

  Parts parts_;
  std::array<Slot, 2> slots_;
  ClockPower clock_power_;
  Gpiote gpiote_;
  Gpio gpio_;
  Timer timer_;
  Spim spim1_;
  Spim spim2_;
  Uarte uarte_;
  Ecb ecb_;
  Nvmc nvmc_;
  Watchdog watchdog_;
  std::array<Block, 10> blocks_;

  // The least of the blocks', the slots' and the host's next instants, as last looked at. Between two calls
  // from outside only accesses and steps change them.
  SimTime next_ = kNever;
  SimTime host_byte_ = kNever;
  SimTime host_byte_local_ = kNever;
  std::vector<TimedByte> received_;
};

}  // namespace groma::sim
