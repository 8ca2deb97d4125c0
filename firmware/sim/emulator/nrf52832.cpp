#include "firmware/sim/emulator/nrf52832.hpp"

#include <algorithm>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

// Of a chip that the board does not have. No pin has this number, so a transfer to it fails the run.
constexpr unsigned kNoPin = 64;
constexpr BoardWiring::Chip kNoChip{
    .spi = {.sck = kNoPin, .mosi = kNoPin, .miso = kNoPin}, .select = kNoPin, .interrupt = kNoPin};

constexpr std::uint32_t kFicr = 0x10000000;
constexpr std::uint32_t kBlockBytes = 0x1000;
// Peripherals of the chip (product specification, instantiation): ids 0 to 38, and P0 on the AHB.
constexpr std::uint32_t kPeripherals = 0x40000000;
constexpr std::uint32_t kPeripheralsEnd = 0x40027000;
constexpr std::uint32_t kP0 = 0x50000000;

// Purposes of draws.
enum : std::uint64_t { kSpoiledBits = 0xE101 };

bool chip_has(std::uint32_t address) {
  return (address >= kPeripherals && address < kPeripheralsEnd) ||
         (address >= kP0 && address < kP0 + kBlockBytes);
}

}  // namespace

Nrf52832::Nrf52832(const Parts& parts)
    : parts_(parts),
      random_(parts.identity.device_id),
      slots_{{{"SPIM1", parts.can, parts.board.can.value_or(kNoChip), false},
              {"SPIM2", &parts.radio, parts.board.radio, true}}},
      clock_power_(parts.silicon, parts.board.slow_crystal),
      gpio_([this](SimTime t, unsigned pin, PinDrive drive) { pin_driven(t, pin, drive); },
            [this](SimTime, unsigned pin, bool high) { gpiote_.level_changed(pin, high); }),
      spim1_("SPIM1", slots_[0].wiring.spi, EasyDma(parts.ram), parts.spi_overhead,
             [this](SimTime end, auto mosi, auto miso, std::uint32_t hz) {
               return exchange(slots_[0], end, mosi, miso, hz);
             }),
      spim2_("SPIM2", slots_[1].wiring.spi, EasyDma(parts.ram), parts.spi_overhead,
             [this](SimTime end, auto mosi, auto miso, std::uint32_t hz) {
               return exchange(slots_[1], end, mosi, miso, hz);
             }),
      uarte_(parts.board.host,
             {parts.bits_per_s,
              [this](SimTime t, auto bytes) {
                if (!parts_.to_host.write(world(t), bytes))
                  throw SimulationError("UARTE0: the host's line is still busy with earlier bytes");
              },
              [this](SimTime t) { parts_.to_host.clear(world(t)); }},
             EasyDma(parts.ram)),
      ecb_(EasyDma(parts.ram)),
      nvmc_(
          parts.flash, parts.uicr,
          [this](SimTime duration) {
            // The processor continues only after the write has taken effect.
            parts_.processor.stall(duration);
            parts_.processor.limit(parts_.processor.now());
          },
          [this](std::uint32_t address, std::uint32_t bytes) {
            parts_.processor.flash_changed(address, bytes);
          }),
      blocks_{{{&clock_power_, 0x40000000, 0},
               {&uarte_, 0x40002000, 2},
               {&spim1_, 0x40004000, 4},
               {&gpiote_, 0x40006000, 6},
               {&timer_, 0x40008000, 8},
               {&ecb_, 0x4000E000, 14},
               {&watchdog_, 0x40010000, 16},
               {&nvmc_, 0x4001E000, -1},
               {&spim2_, 0x40023000, 35},
               {&gpio_, kP0, -1}}} {}

// ---- resets ---------------------------------------------------------------------------------------------

// Product specification 18.8, reset behaviour: a soft reset and a lockup leave the watchdog running.
void Nrf52832::reset(ResetCause cause, SimTime t) {
  spim1_.reset();
  spim2_.reset();
  gpiote_.reset();
  gpio_.reset(t);
  uarte_.reset(t);
  timer_.reset();
  ecb_.reset();
  nvmc_.reset();
  clock_power_.reset(cause, t);
  if (cause != ResetCause::kSoftware && cause != ResetCause::kLockup) watchdog_.reset();
  for (const Slot& slot : slots_) update_interrupt_pin(t, slot);
  refresh_all();
}

void Nrf52832::power_cut(SimTime t) {
  nvmc_.power_cut(t);
  refresh_all();
}

// ---- time -----------------------------------------------------------------------------------------------

// Polls the devices and the host's line: other nodes, the host, transfers or pins may have changed them.
void Nrf52832::poll_devices() {
  for (Slot& slot : slots_) {
    if (slot.device == nullptr) continue;
    const SimTime event = slot.device->next_event();
    if (event == slot.event) continue;
    slot.event = event;
    slot.event_local = local(event);
  }
  const SimTime byte = parts_.from_host.next_byte();
  if (byte != host_byte_) {
    host_byte_ = byte;
    host_byte_local_ = byte == kNever ? kNever : local(byte + kHostDelay);
  }
  settle();
}

void Nrf52832::settle() {
  next_ = host_byte_local_;
  for (const Slot& slot : slots_) next_ = std::min(next_, slot.event_local);
  for (const Block& block : blocks_) next_ = std::min(next_, block.next);
}

void Nrf52832::refresh(Block& block) {
  block.next = block.peripheral->next_event();
  if (block.irq < 0) return;
  const bool level = block.peripheral->irq();
  if (level == block.level) return;
  block.level = level;
  parts_.processor.set_irq(static_cast<unsigned>(block.irq), level);
}

void Nrf52832::refresh_all() {
  for (Block& block : blocks_) refresh(block);
  poll_devices();
}

SimTime Nrf52832::next_event() {
  poll_devices();
  return next_;
}

void Nrf52832::advance(SimTime t) {
  poll_devices();
  while (next_ <= t) step(next_);
}

// Handles all events due at t, the devices' first.
void Nrf52832::step(SimTime t) {
  for (Slot& slot : slots_) {
    if (slot.event_local > t) continue;
    slot.device->advance(slot.event);
    update_interrupt_pin(t, slot);
  }
  if (host_byte_local_ <= t) {
    received_.clear();
    parts_.from_host.take(host_byte_, received_);
    for (const TimedByte& byte : received_) uarte_.receive(t, byte.value);
  }
  for (const Block& block : blocks_)
    if (block.next <= t) block.peripheral->advance(t);
  refresh_all();
}

void Nrf52832::update_interrupt_pin(SimTime t, const Slot& slot) {
  if (slot.device == nullptr) return;
  const bool high = slot.device->irq() == slot.active_high;
  gpio_.drive_from_outside(t, slot.wiring.interrupt, high ? PinDrive::kHigh : PinDrive::kLow);
}

// ---- pins and buses -------------------------------------------------------------------------------------

bool Nrf52832::exchange(Slot& slot, SimTime end, std::span<const std::uint8_t> mosi,
                        std::span<std::uint8_t> miso, std::uint32_t hz) {
  if (gpio_.drive(slot.wiring.select) != PinDrive::kLow) return false;
  if (parts_.silicon.sck_input && !gpio_.input_connected(slot.wiring.spi.sck))
    throw SimulationError(std::string(slot.name) + ": the input buffer of SCK is disconnected");
  if (++slot.transfers_in_window > 1) {
    throw SimulationError(std::string(slot.name) +
                          ": a second transfer within one chip-select window is not modelled");
  }
  if (slot.device == nullptr) return true;
  slot.device->transfer(world(end), mosi, miso, hz);
  update_interrupt_pin(end, slot);
  return true;
}

void Nrf52832::pin_driven(SimTime t, unsigned pin, PinDrive drive) {
  if (pin == parts_.board.radio_reset) {
    if (drive == PinDrive::kHigh)
      throw SimulationError("P0." + std::to_string(pin) + " drives the DW1000's reset line high");
    if (drive == PinDrive::kLow) {
      parts_.radio.hold_in_reset(world(t));
    } else {
      parts_.radio.release_reset(world(t));
    }
    update_interrupt_pin(t, slots_[1]);
    return;
  }
  for (Slot& slot : slots_) {
    if (pin != slot.wiring.select) continue;
    const Spim& master = &slot == &slots_.front() ? spim1_ : spim2_;
    if (master.busy())
      throw SimulationError(std::string(slot.name) + ": chip select changes during a transfer");
    slot.transfers_in_window = 0;
    if (slot.device != nullptr) slot.device->select(world(t), drive == PinDrive::kLow);
  }
}

// Anomaly 109.
void Nrf52832::on_sleep(SimTime t) {
  // At least one bit.
  const auto bits =
      static_cast<std::uint8_t>(random_.of(kSpoiledBits, static_cast<std::uint64_t>(t)).bits() % 0xFF + 1);
  if (parts_.silicon.spim_start) {
    spim1_.spoil_start(t, bits);
    spim2_.spoil_start(t, bits);
  }
  if (parts_.silicon.uarte_start) uarte_.spoil_start(t, bits);
  if (parts_.silicon.ecb_start) ecb_.spoil_start(t, bits);
}

// ---- the bus --------------------------------------------------------------------------------------------

void Nrf52832::fail(const std::string& what, std::uint32_t address) const {
  throw SimulationError(what + " (address " + hexadecimal(address) + ", PC " +
                        hexadecimal(parts_.processor.pc()) + ")");
}

Nrf52832::Block* Nrf52832::find(std::uint32_t address) {
  const std::uint32_t base = address & ~(kBlockBytes - 1);
  const auto block =
      std::find_if(blocks_.begin(), blocks_.end(), [&](const Block& it) { return it.base == base; });
  return block == blocks_.end() ? nullptr : &*block;
}

bool Nrf52832::read(std::uint32_t address, unsigned bytes, std::uint32_t& value) {
  const SimTime t = parts_.processor.now();
  std::optional<std::uint32_t> content;
  if (address >= kFicr && address < kUicrAddress + kBlockBytes) {
    const std::uint32_t word = address & ~3U;
    content = address < kUicrAddress ? read_factory_information(parts_.identity, word - kFicr)
                                     : read_user_information(parts_.uicr, word - kUicrAddress);
    if (!content) fail("read of FICR or UICR where no register is modelled", address);
    value = *content >> (8 * (address & 3U));
    return true;
  }
  if (!chip_has(address)) return false;
  if (bytes != 4) fail("peripheral registers are read as words", address);
  Block* block = find(address);
  if (block != nullptr) {
    if (next_ <= t) advance(t);
    try {
      content = block->peripheral->read(t, address - block->base);
    } catch (const SimulationError& error) {
      fail(error.what(), address);
    }
  }
  if (!content) fail("read where no register is modelled", address);
  value = *content;
  return true;
}

bool Nrf52832::write(std::uint32_t address, unsigned bytes, std::uint32_t value) {
  if (address >= kUicrAddress && address < kUicrAddress + kBlockBytes)
    return flash_write(address, bytes, value);
  if (address >= kFicr && address < kUicrAddress) fail("FICR cannot be written", address);
  if (!chip_has(address)) return false;
  if (bytes != 4) fail("peripheral registers are written as words", address);
  const SimTime t = parts_.processor.now();
  Block* block = find(address);
  bool known = false;
  if (block != nullptr) {
    if (next_ <= t) advance(t);
    try {
      known = block->peripheral->write(t, address - block->base, value);
    } catch (const SimulationError& error) {
      fail(error.what(), address);
    }
  }
  if (!known) fail("write of " + hexadecimal(value) + " where no register is modelled", address);
  if (block->peripheral == &gpio_) {
    refresh_all();
  } else {
    refresh(*block);
    settle();
  }
  parts_.processor.limit(next_);
  return true;
}

bool Nrf52832::flash_write(std::uint32_t address, unsigned bytes, std::uint32_t value) {
  const SimTime t = parts_.processor.now();
  advance(t);
  try {
    if (!nvmc_.store(t, address, bytes, value)) return false;
  } catch (const SimulationError& error) {
    fail(error.what(), address);
  }
  refresh_all();
  return true;
}

}  // namespace groma::sim
