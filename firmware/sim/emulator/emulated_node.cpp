#include "firmware/sim/emulator/emulated_node.hpp"

#include <algorithm>
#include <string>
#include <vector>

#include "firmware/core/storage/config_store.hpp"
#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {

namespace {

constexpr SimTime kPowerOnTime = 1 * kUnitsPerMillisecond;  // from the supply to the first instruction
constexpr SimTime kResetTime = 10 * kUnitsPerMicrosecond;
constexpr std::uint32_t kStoragePages = kFlashBytes - storage::kPages * storage::kPageBytes;

// Purposes of draws.
enum : std::uint64_t { kDeviceId = 0xE001, kRamAtPowerOn };

// The storage pages of a flash image, before the image runs.
class ImageFlash {
 public:
  explicit ImageFlash(std::span<std::uint8_t> pages) : pages_(pages) {}
  bool erase(std::size_t page) noexcept {
    const auto bytes = pages_.subspan(page * storage::kPageBytes, storage::kPageBytes);
    std::fill(bytes.begin(), bytes.end(), std::uint8_t{0xFF});
    return true;
  }
  bool write(std::uint32_t offset, std::uint32_t word) noexcept {
    for (unsigned i = 0; i < 4; ++i) pages_[offset + i] &= static_cast<std::uint8_t>(word >> (8 * i));
    return true;
  }
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept {
    std::uint32_t word = 0;
    for (unsigned i = 0; i < 4; ++i) word |= static_cast<std::uint32_t>(pages_[offset + i]) << (8 * i);
    return word;
  }

 private:
  std::span<std::uint8_t> pages_;
};
static_assert(storage::Flash<ImageFlash>);

}  // namespace

class EmulatedNode::Machine final : private Processor {
 public:
  Machine(const NodeSpec& spec, const FirmwareImage& image, Medium& medium, const EmulatorOptions& options)
      : chip(spec.chip, medium),
        uart_out(spec.uart),
        uart_in(spec.uart),
        flash(image.flash),
        ram(kRamBytes),
        shares_bus(options.can != nullptr),
        random_(KeyedRandom(spec.chip.id)),
        clock_(spec.cpu_clock.value_or(spec.chip.clock)),
        quantum_(options.quantum),
        uicr_(image.uicr),
        radio_(chip),
        soc({.processor = *this,
             .clock = clock_,
             .flash = flash,
             .ram = ram,
             .uicr = uicr_,
             .identity = {.device_id = random_.of(kDeviceId).bits()},
             .radio = radio_,
             .can = options.can,
             .to_host = uart_out,
             .from_host = uart_in,
             .bits_per_s = spec.uart.bits_per_s,
             .silicon = options.silicon,
             .spi_overhead = options.spi_overhead,
             .board = options.board}),
        cpu(flash, ram, soc, options.timing),
        boots_at_(spec.power_on) {
    if (quantum_ <= 0 || quantum_ > Nrf52832::kHostDelay)
      throw SimulationError("the quantum of an emulated node must be above 0 and at most 50 us");
    cpu.guard_wake_up(options.silicon.wake_up);
    ImageFlash pages{std::span<std::uint8_t>(flash).subspan(kStoragePages)};
    if (!spec.stored_config.empty() && !storage::ConfigStore(pages).store(spec.stored_config))
      throw SimulationError("stored_config: at most " + std::to_string(storage::kMaxRecordBytes) + " bytes");
  }

  SimTime next_work() {
    if (!powered_) return boots_at_;
    const SimTime wake = cpu.next_wake();
    const SimTime next = std::min(wake, soc.next_event());
    return next == kNever ? kNever : clock_.time_of_local(next);
  }

  void run(SimTime now) {
    if (!powered_) {
      if (now < boots_at_) return;
      power_on(now);
    }
    const SimTime here = clock_.local_units(now);
    const SimTime ahead = clock_.local_units(now + quantum_);
    for (;;) {
      // A flash operation must not complete ahead of the network, so that an earlier power cut can interrupt
      // it.
      const SimTime horizon = soc.nvmc().busy() ? here : ahead;
      const SimTime event = soc.next_event();
      const SimTime wake = cpu.next_wake();
      if (event <= cpu.now()) {
        soc.advance(cpu.now());
      } else if (wake <= cpu.now()) {
        if (cpu.now() >= horizon) break;
        cpu.run(std::min(horizon, event));
        soc.advance(cpu.now());
      } else {
        const SimTime next = std::min(event, wake);
        if (next > horizon) break;
        idle(next);
        soc.advance(next);
      }
      reset_if_due();
    }
  }

  void set_power(bool on, SimTime now) {
    if (on == (powered_ || boots_at_ != kNever)) return;
    if (on) {
      boots_at_ = now;
      return;
    }
    boots_at_ = kNever;
    if (!powered_) return;
    powered_ = false;
    powered_time_ += clock_.local_units(now) - powered_since_;
    busy_time_ += cpu.now() - powered_since_ - idle_time_;
    soc.power_cut(clock_.local_units(now));
    chip.set_power(false, now);
    uart_out.clear(now);
    uart_in.clear(now);
  }

  void reset(ResetCause cause, SimTime t) {
    soc.reset(cause, t);
    cpu.reset(t + kResetTime);
    idle_time_ += kResetTime;
    ++resets_;
  }

  void press_reset(SimTime now) {
    if (powered_) reset(ResetCause::kPin, std::max(cpu.now(), clock_.local_units(now)));
  }

  [[nodiscard]] EmulatorUsage usage(SimTime now) const {
    EmulatorUsage usage;
    SimTime powered = powered_time_;
    SimTime busy = busy_time_;
    if (powered_) {
      powered += std::max(clock_.local_units(now), cpu.now()) - powered_since_;
      busy += cpu.now() - powered_since_ - idle_time_;
    }
    usage.powered_s = to_seconds(powered);
    if (powered > 0) usage.cpu_load = to_seconds(busy) / to_seconds(powered);
    usage.radio_spi_s = to_seconds(soc.radio_spi().busy_time());
    usage.can_spi_s = to_seconds(soc.can_spi().busy_time());
    usage.radio_transfers = soc.radio_spi().transfers();
    usage.instructions = cpu.instructions();
    usage.interrupts = cpu.exceptions();
    usage.resets = resets_;
    return usage;
  }

  Dw1000Chip chip;
  UartLine uart_out;
  UartLine uart_in;
  std::vector<std::uint8_t> flash;
  std::vector<std::uint8_t> ram;
  const bool shares_bus;

 private:
  // ---- interface to the peripherals (Processor)
  [[nodiscard]] SimTime now() const override { return cpu.now(); }
  [[nodiscard]] std::uint32_t pc() const override { return cpu.pc(); }
  void limit(SimTime t) override { cpu.limit(t); }
  void stall(SimTime duration) override { cpu.stall(duration); }
  void set_irq(unsigned irq, bool level) override { cpu.set_irq(irq, level); }
  void flash_changed(std::uint32_t address, std::size_t bytes) override { cpu.flash_changed(address, bytes); }

  void idle(SimTime t) {
    idle_time_ += t - cpu.now();
    cpu.idle_until(t);
  }

  void power_on(SimTime now) {
    boots_at_ = kNever;
    powered_ = true;
    // The content of RAM is undefined after a loss of power.
    KeyedRandom noise = random_.of(kRamAtPowerOn);
    for (std::size_t i = 0; i < ram.size(); ++i)
      ram[i] = static_cast<std::uint8_t>(noise.of(i / 8).bits() >> (8 * (i % 8)));
    chip.set_power(true, now);
    const SimTime t = clock_.local_units(now);
    powered_since_ = t;
    idle_time_ = 0;
    soc.reset(ResetCause::kPowerOn, t);
    cpu.reset(t + kPowerOnTime);
    idle_time_ += kPowerOnTime;
  }

  void reset_if_due() {
    if (soc.watchdog().bites()) {
      reset(ResetCause::kWatchdog, cpu.now());
    } else if (cpu.lockup()) {
      reset(ResetCause::kLockup, cpu.now());
    } else if (cpu.reset_requested()) {
      reset(ResetCause::kSoftware, cpu.now());
    }
  }

  KeyedRandom random_;
  NodeClock clock_;
  SimTime quantum_;
  std::vector<std::uint8_t> uicr_;
  RadioDevice radio_;

 public:
  Nrf52832 soc;
  CortexM4 cpu;

 private:
  bool powered_ = false;
  SimTime boots_at_;
  SimTime powered_since_ = 0;  // local time, as are the following ones
  SimTime powered_time_ = 0;   // of earlier power cycles
  SimTime idle_time_ = 0;      // since powered_since_: asleep, halted or in reset
  SimTime busy_time_ = 0;      // of earlier power cycles
  std::uint64_t resets_ = 0;
};

EmulatedNode::EmulatedNode(const NodeSpec& spec, const FirmwareImage& image, Medium& medium,
                           const EmulatorOptions& options)
    : machine_(std::make_unique<Machine>(spec, image, medium, options)) {}

EmulatedNode::~EmulatedNode() = default;

Dw1000Chip& EmulatedNode::chip() noexcept {
  return machine_->chip;
}
UartLine& EmulatedNode::uart_out() noexcept {
  return machine_->uart_out;
}
UartLine& EmulatedNode::uart_in() noexcept {
  return machine_->uart_in;
}
SimTime EmulatedNode::next_work() {
  return machine_->next_work();
}
bool EmulatedNode::shares_bus() const noexcept {
  return machine_->shares_bus;
}
void EmulatedNode::run(SimTime now) {
  machine_->run(now);
}
void EmulatedNode::set_power(bool on, SimTime now) {
  machine_->set_power(on, now);
}
void EmulatedNode::press_reset(SimTime now) {
  machine_->press_reset(now);
}
CortexM4& EmulatedNode::cpu() noexcept {
  return machine_->cpu;
}
const Nrf52832& EmulatedNode::soc() const noexcept {
  return machine_->soc;
}
std::span<std::uint8_t> EmulatedNode::flash() noexcept {
  return machine_->flash;
}
std::span<std::uint8_t> EmulatedNode::ram() noexcept {
  return machine_->ram;
}
EmulatorUsage EmulatedNode::usage(SimTime now) const {
  return machine_->usage(now);
}

std::unique_ptr<EmulatedNode> make_emulated_node(const NodeSpec& spec, const FirmwareImage& image,
                                                 Medium& medium, const EmulatorOptions& options) {
  return std::make_unique<EmulatedNode>(spec, image, medium, options);
}

}  // namespace groma::sim
