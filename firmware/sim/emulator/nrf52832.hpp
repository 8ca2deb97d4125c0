// The nRF52832 without its processor, on a board: a strict model of the peripherals that the image uses.
//
// 0x40000000 CLOCK, POWER   0x40002000 UARTE0   0x40004000 SPIM1    0x40006000 GPIOTE   0x40008000 TIMER0
// 0x4000E000 ECB            0x40010000 WDT      0x4001E000 NVMC     0x40023000 SPIM2    0x50000000 P0
// 0x10000000 FICR           0x10001000 UICR
//
// An access to a register that is not modelled, or to any other peripheral of the chip, fails the run; an
// access to an address without a peripheral is a bus fault. Registers can only be read and written as words.
//
// Limits of the model: the internal oscillators are as exact as the crystals; of the GPIOs that a serial
// peripheral uses, only the input buffer of SCK is checked. silicon.hpp has what the silicon does beyond the
// specification.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/emulator/board_wiring.hpp"
#include "firmware/sim/emulator/clock_power.hpp"
#include "firmware/sim/emulator/cortex_m4.hpp"
#include "firmware/sim/emulator/ecb.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/gpio.hpp"
#include "firmware/sim/emulator/gpiote.hpp"
#include "firmware/sim/emulator/information.hpp"
#include "firmware/sim/emulator/nvmc.hpp"
#include "firmware/sim/emulator/radio_device.hpp"
#include "firmware/sim/emulator/silicon.hpp"
#include "firmware/sim/emulator/spim.hpp"
#include "firmware/sim/emulator/timer.hpp"
#include "firmware/sim/emulator/uarte.hpp"
#include "firmware/sim/emulator/watchdog.hpp"
#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/node_clock.hpp"
#include "firmware/sim/uart.hpp"

namespace groma::sim {

// Of each SPI transfer. No public figure exists; this one is on the safe side (docs/explanation/silicon.md,
// A4).
inline constexpr SimTime kSpiOverhead = 5 * kUnitsPerMicrosecond;

// The interface from the peripherals to the processor; Bus is the opposite direction.
class Processor {
 public:
  Processor() = default;
  Processor(const Processor&) = delete;
  Processor& operator=(const Processor&) = delete;
  virtual ~Processor() = default;

  // As the same functions of CortexM4; local time.
  [[nodiscard]] virtual SimTime now() const = 0;
  [[nodiscard]] virtual std::uint32_t pc() const = 0;
  virtual void limit(SimTime t) = 0;
  virtual void stall(SimTime duration) = 0;
  virtual void set_irq(unsigned irq, bool level) = 0;
  virtual void flash_changed(std::uint32_t address, std::size_t bytes) = 0;
};

class Nrf52832 final : public Bus {
 public:
  // The memories and devices that the peripherals are connected to. All must outlive Nrf52832.
  struct Parts {
    Processor& processor;
    const NodeClock& clock;  // the processor's crystal
    std::span<std::uint8_t> flash;
    std::span<std::uint8_t> ram;
    std::span<std::uint8_t> uicr;
    ChipIdentity identity;
    RadioDevice& radio;
    SpiDevice* can = nullptr;  // null: nothing on the board's CAN pins; reads give zeros
    UartLine& to_host;
    UartLine& from_host;
    std::uint32_t bits_per_s = 1'000'000;
    SiliconQuirks silicon{};
    SimTime spi_overhead = kSpiOverhead;
    BoardWiring board = kDwm1001;
  };

  // The UARTE receives bytes from the host this much later than the end of their stop bits, so that a
  // processor that runs ahead of the network by at most this time misses none.
  static constexpr SimTime kHostDelay = 50 * kUnitsPerMicrosecond;

  explicit Nrf52832(const Parts& parts);

  // Times from here on are local, except those of the devices.
  void reset(ResetCause cause, SimTime t);
  void power_cut(SimTime t);
  // Handles all events due by t, each at its own time.
  void advance(SimTime t);
  // The next event. Polls the devices first, since other nodes may have changed them.
  [[nodiscard]] SimTime next_event();

  bool read(std::uint32_t address, unsigned bytes, std::uint32_t& value) override;
  bool write(std::uint32_t address, unsigned bytes, std::uint32_t value) override;
  bool flash_write(std::uint32_t address, unsigned bytes, std::uint32_t value) override;
  void on_sleep(SimTime t) override;

  [[nodiscard]] const Gpio& gpio() const noexcept { return gpio_; }
  [[nodiscard]] const Nvmc& nvmc() const noexcept { return nvmc_; }
  [[nodiscard]] const Uarte& uarte() const noexcept { return uarte_; }
  [[nodiscard]] const Spim& radio_spi() const noexcept { return spim2_; }
  [[nodiscard]] const Spim& can_spi() const noexcept { return spim1_; }
  [[nodiscard]] const Ecb& ecb() const noexcept { return ecb_; }
  [[nodiscard]] const Watchdog& watchdog() const noexcept { return watchdog_; }
  // Whether the LED with this index in BoardWiring::lights is lit.
  [[nodiscard]] bool lit(std::size_t light) const noexcept {
    const BoardWiring& board = parts_.board;
    return gpio_.drive(board.lights[light]) == (board.lights_active_low ? PinDrive::kLow : PinDrive::kHigh);
  }

 private:
  struct Block {
    Peripheral* peripheral;
    std::uint32_t base;
    int irq;  // -1: none
    bool level = false;
    SimTime next = kNever;  // the peripheral's next_event()
  };
  // A chip on an SPI bus.
  struct Slot {
    const char* name;
    SpiDevice* device;
    BoardWiring::Chip wiring;
    bool active_high;
    unsigned transfers_in_window = 0;
    SimTime event = kNever;        // the device's next event, world time
    SimTime event_local = kNever;  // the same in local time
  };

  [[nodiscard]] Block* find(std::uint32_t address);
  [[nodiscard]] SimTime world(SimTime local) const noexcept { return parts_.clock.time_of_local(local); }
  [[nodiscard]] SimTime local(SimTime world) const noexcept {
    return world == kNever ? kNever : parts_.clock.local_units(world);
  }
  void poll_devices();
  void refresh(Block& block);
  void refresh_all();
  void settle();
  void step(SimTime t);
  void update_interrupt_pin(SimTime t, const Slot& slot);
  bool exchange(Slot& slot, SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz);
  void pin_driven(SimTime t, unsigned pin, PinDrive drive);
  [[noreturn]] void fail(const std::string& what, std::uint32_t address) const;

  Parts parts_;
  KeyedRandom random_;
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

  // The earliest event of blocks, slots and host when last polled. Between two calls from outside only
  // accesses and steps change it.
  SimTime next_ = kNever;
  SimTime host_byte_ = kNever;
  SimTime host_byte_local_ = kNever;
  std::vector<TimedByte> received_;
};

}  // namespace groma::sim
