// The chip's peripherals with a scripted bus master in the processor's place.
#pragma once

#include <array>
#include <cstdint>
#include <numeric>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/emulator/nrf52832.hpp"
#include "firmware/sim/simulation_error.hpp"
#include "test/sim/radio_bench.hpp"

namespace groma::sim {

class ScriptedProcessor final : public Processor {
 public:
  [[nodiscard]] SimTime now() const override { return t; }
  [[nodiscard]] std::uint32_t pc() const override { return 0x1234; }
  void limit(SimTime) override {}
  void stall(SimTime duration) override { stalled += duration; }
  void set_irq(unsigned irq, bool level) override { lines.at(irq) = level; }
  void flash_changed(std::uint32_t, std::size_t) override { ++flash_changes; }

  SimTime t = 0;
  SimTime stalled = 0;
  int flash_changes = 0;
  std::array<bool, 48> lines{};
};

// Answers each transfer with 0x80, 0x81, ... and keeps the bytes that it received.
class PatternDevice final : public SpiDevice {
 public:
  void transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz) override {
    last_end = end;
    last_hz = hz;
    seen.emplace_back(mosi.begin(), mosi.end());
    std::iota(miso.begin(), miso.end(), std::uint8_t{0x80});
    if (raises_interrupt) asserted = true;
  }
  void advance(SimTime) override {}
  [[nodiscard]] SimTime next_event() const override { return kNever; }
  [[nodiscard]] bool irq() const override { return asserted; }

  SimTime last_end = 0;
  std::uint32_t last_hz = 0;
  std::vector<std::vector<std::uint8_t>> seen;
  bool raises_interrupt = false;
  bool asserted = false;
};

struct SocBench {
  SocBench() {
    chip.set_power(true, 0);
    soc.reset(ResetCause::kPowerOn, 0);
  }

  void write(std::uint32_t address, std::uint32_t value) {
    if (!soc.write(address, 4, value)) throw std::runtime_error("bus fault at " + hexadecimal(address));
  }
  std::uint32_t read(std::uint32_t address) {
    std::uint32_t value = 0;
    if (!soc.read(address, 4, value)) throw std::runtime_error("bus fault at " + hexadecimal(address));
    return value;
  }
  // Lets time pass.
  void run_us(double t_us) { run_until(processor.t + from_seconds(t_us * 1e-6)); }
  void run_until(SimTime t) {
    processor.t = t;
    soc.advance(t);
  }
  // The simulation error that a call raises; empty: none.
  template <class F>
  static std::string error_of(F&& f) {
    try {
      f();
    } catch (const SimulationError& error) {
      return error.what();
    }
    return {};
  }
  [[nodiscard]] bool irq(unsigned number) const { return processor.lines.at(number); }

  DistanceTable space;
  Medium medium{space, {}, 1};
  Dw1000Chip chip{{.id = 1}, medium};
  RadioDevice radio{chip};
  PatternDevice can;
  UartLine to_host;
  UartLine from_host;
  NodeClock clock;
  std::vector<std::uint8_t> flash = std::vector<std::uint8_t>(kFlashBytes, 0xFF);
  std::vector<std::uint8_t> ram = std::vector<std::uint8_t>(kRamBytes);
  std::vector<std::uint8_t> uicr = std::vector<std::uint8_t>(kUicrBytes, 0xFF);
  ScriptedProcessor processor;
  Nrf52832 soc{{.processor = processor,
                .clock = clock,
                .flash = flash,
                .ram = ram,
                .uicr = uicr,
                .identity = {.device_id = 0x0123456789ABCDEF},
                .radio = radio,
                .can = &can,
                .to_host = to_host,
                .from_host = from_host}};
};

// Base addresses of the peripherals, as in the product specification.
namespace reg {
inline constexpr std::uint32_t kPower = 0x40000000;
inline constexpr std::uint32_t kUarte = 0x40002000;
inline constexpr std::uint32_t kSpim1 = 0x40004000;
inline constexpr std::uint32_t kGpiote = 0x40006000;
inline constexpr std::uint32_t kTimer = 0x40008000;
inline constexpr std::uint32_t kEcb = 0x4000E000;
inline constexpr std::uint32_t kWdt = 0x40010000;
inline constexpr std::uint32_t kNvmc = 0x4001E000;
inline constexpr std::uint32_t kSpim2 = 0x40023000;
inline constexpr std::uint32_t kP0 = 0x50000000;
}  // namespace reg

}  // namespace groma::sim
