#include "firmware/sim/mcp2518fd_chip.hpp"

#include <algorithm>
#include <cstdio>

#include "firmware/sim/can_bits.hpp"

namespace groma::sim {

namespace {

constexpr unsigned kCon = 0x000;
constexpr unsigned kNbtcfg = 0x004;
constexpr unsigned kDbtcfg = 0x008;
constexpr unsigned kTdc = 0x00C;
constexpr unsigned kInt = 0x01C;
constexpr unsigned kTrec = 0x034;
constexpr unsigned kBdiag1 = 0x03C;
constexpr std::uint32_t kWasBusOff = 1U << 23;  // TXBOERR
constexpr unsigned kFifoBegin = 0x05C;          // CiFIFOCON1; status and user address follow
constexpr unsigned kFifoEnd = 0x1D0;
constexpr unsigned kFifoStride = 12;
constexpr unsigned kFilterControl = 0x1D0;
constexpr unsigned kFilterObject = 0x1F0;
constexpr unsigned kFilterEnd = 0x2F0;
constexpr unsigned kRam = 0x400;
constexpr unsigned kRamEnd = 0xC00;
constexpr unsigned kOsc = 0xE00;
constexpr unsigned kEccControl = 0xE0C;
constexpr unsigned kEccStatus = 0xE10;

constexpr std::uint32_t kConReset = 0x0498'0760;
constexpr std::uint32_t kNbtcfgReset = 0x003E'0F0F;
constexpr std::uint32_t kDbtcfgReset = 0x000E'0303;
constexpr std::uint32_t kTdcReset = 0x0002'1000;
constexpr std::uint32_t kFifoConReset = 0x0060'0400;
constexpr std::uint32_t kOscReset = 0x0000'0060;

constexpr std::uint32_t kOscPll = 1U << 0;
constexpr std::uint32_t kOscDisable = 1U << 2;
constexpr std::uint32_t kOscLowPower = 1U << 3;
constexpr std::uint32_t kOscReady = 1U << 10;

constexpr std::uint32_t kAbort = 1U << 27;
constexpr std::uint32_t kTransmitQueue = 1U << 20;
constexpr std::uint32_t kEventFifo = 1U << 19;

constexpr std::uint32_t kTxIf = 1U << 0;
constexpr std::uint32_t kRxIf = 1U << 1;
constexpr std::uint32_t kModeIf = 1U << 3;
constexpr std::uint32_t kEccIf = 1U << 8;
constexpr std::uint32_t kRxOverrunIf = 1U << 11;
constexpr std::uint32_t kSystemErrorIf = 1U << 12;
constexpr std::uint32_t kErrorStateIf = 1U << 13;
constexpr std::uint32_t kInvalidIf = 1U << 15;
constexpr std::uint32_t kWakeIf = 1U << 14;
constexpr std::uint32_t kTimeBaseIf = 1U << 2;
constexpr std::uint32_t kClearable =
    kModeIf | kSystemErrorIf | kErrorStateIf | kInvalidIf | kWakeIf | kTimeBaseIf;
constexpr std::uint32_t kEnableBits = 0xFF1F'0000;

constexpr std::uint32_t kFifoTransmits = 1U << 7;
constexpr std::uint32_t kFifoAdvance = 1U << 8;
constexpr std::uint32_t kFifoRequest = 1U << 9;
constexpr std::uint32_t kFifoReset = 1U << 10;
constexpr std::uint32_t kFifoTimestamp = 1U << 5;
constexpr std::uint32_t kFifoRemote = 1U << 6;
constexpr std::uint32_t kFifoOverrun = 1U << 3;

constexpr std::uint32_t kExtended = 1U << 30;

constexpr unsigned kRecessiveBits = 11;
constexpr int kSequencesToRecover = 128;
constexpr SimTime kAssemblyTime = 2 * kUnitsPerMicrosecond;  // from the request to the first bit

constexpr std::array<unsigned, 8> kPayloadSizes{8, 12, 16, 20, 24, 32, 48, 64};

constexpr std::uint32_t bits(std::uint32_t word, unsigned lsb, unsigned width) noexcept {
  return (word >> lsb) & ((1U << width) - 1U);
}

std::string hex(unsigned value) {
  std::array<char, 16> text{};
  std::snprintf(text.data(), text.size(), "0x%03X", value);
  return text.data();
}

std::uint32_t id_of_object(std::uint32_t word) noexcept {
  return bits(word, 0, 11) << 18 | bits(word, 11, 18);
}

}  // namespace

Mcp2518fdChip::Mcp2518fdChip(CanBus& bus, const Mcp2518fdSpec& spec) : bus_(bus), spec_(spec) {
  bus.attach(*this);
}

void Mcp2518fdChip::set_power(bool on, SimTime t) {
  bus_.advance(t);
  now_ = std::max(now_, t);
  powered_ = on;
  reset();
  written_.fill(false);
  oscillator_ready_at_ = on && spec_.oscillates ? t + kOscillatorStart : kNever;
}

void Mcp2518fdChip::reset() {
  registers_.fill(0);
  word(kCon) = kConReset;
  word(kNbtcfg) = kNbtcfgReset;
  word(kDbtcfg) = kDbtcfgReset;
  word(kTdc) = kTdcReset;
  for (unsigned i = 1; i < kFifos; ++i) word(kFifoBegin + (i - 1) * kFifoStride) = kFifoConReset;
  osc_ = kOscReset;
  ecc_control_ = 0;
  ecc_status_ = 0;
  requested_mode_.reset();
  enter_configuration();
  word(kInt) = 0;
}

void Mcp2518fdChip::complain(const std::string& message) {
  if (fault_.empty()) fault_ = "MCP2518FD: " + message;
}

// ---- SPI
// -----------------------------------------------------------------------------------------------------

void Mcp2518fdChip::transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                             std::uint32_t hz) {
  advance(end);
  if (!powered_) {
    std::fill(miso.begin(), miso.end(), std::uint8_t{0xFF});
    return;
  }
  std::fill(miso.begin(), miso.end(), std::uint8_t{0});
  if (std::uint64_t{hz} * 40 > std::uint64_t{spec_.clock_hz} * 17) {
    return complain("SPI at " + std::to_string(hz) + " Hz, more than 0.85 of half its clock");
  }
  if (mosi.size() < 2 || miso.size() != mosi.size()) return complain("a transfer without an address");
  const unsigned instruction = mosi[0] >> 4;
  const unsigned address = (mosi[0] & 0xFU) << 8 | mosi[1];
  const auto data = mosi.subspan(2);
  const bool ram = address >= kRam && address < kRamEnd;
  if (ram && (address % 4 != 0 || data.size() % 4 != 0)) {
    return complain("RAM at " + hex(address) + " not in whole words");
  }
  constexpr unsigned kReset = 0;
  constexpr unsigned kWrite = 2;
  constexpr unsigned kRead = 3;
  if (instruction != kReset && data.empty()) return complain("a transfer without data");
  if (address < kOsc && end < oscillator_ready_at_) {
    return complain("access to " + hex(address) + " before its oscillator runs");
  }
  switch (instruction) {
    case kReset:
      if (address != 0 || !data.empty()) return complain("a reset with an address or data");
      if (mode_ != Mode::kConfiguration) return complain("a reset outside the configuration mode");
      reset();
      break;
    case kWrite:
      write_bytes(address, data);
      break;
    case kRead:
      for (std::size_t i = 0; i < data.size(); ++i) {
        miso[2 + i] = read_byte(address + static_cast<unsigned>(i));
      }
      break;
    default:
      complain("instruction " + std::to_string(instruction) + " is not modelled");
  }
  settle(end);
}

std::uint8_t Mcp2518fdChip::read_byte(unsigned address) {
  const unsigned aligned = address / 4 * 4;
  const std::uint32_t value =
      address >= kRam && address < kRamEnd ? ram_word(aligned - kRam) : read_register(aligned);
  return static_cast<std::uint8_t>(value >> (8 * (address % 4)));
}

void Mcp2518fdChip::write_bytes(unsigned address, std::span<const std::uint8_t> bytes) {
  std::size_t at = 0;
  while (at < bytes.size()) {
    const unsigned aligned = address / 4 * 4;
    std::uint32_t value = 0;
    std::uint32_t mask = 0;
    for (; at < bytes.size() && address / 4 * 4 == aligned; ++at, ++address) {
      value |= std::uint32_t{bytes[at]} << (8 * (address % 4));
      mask |= std::uint32_t{0xFF} << (8 * (address % 4));
    }
    if (aligned >= kRam && aligned < kRamEnd) {
      set_ram_word(aligned - kRam, value);
    } else {
      write_register(aligned, value, mask);
    }
  }
}

std::uint32_t Mcp2518fdChip::read_register(unsigned address) {
  switch (address) {
    case kCon:
      return (word(kCon) & ~(7U << 21)) | static_cast<std::uint32_t>(mode_) << 21;
    case kNbtcfg:
    case kDbtcfg:
    case kTdc:
      return word(address);
    case kInt:
      return interrupts();
    case kTrec: {
      if (mode_ == Mode::kConfiguration) return 1U << 21;
      const ErrorState state = error_state();
      std::uint32_t value = std::min(receive_errors_, 255U) | std::min(transmit_errors_, 255U) << 8;
      if (state >= ErrorState::kWarning) value |= 1U << 16;
      if (receive_errors_ >= 96) value |= 1U << 17;
      if (transmit_errors_ >= 96) value |= 1U << 18;
      if (receive_errors_ >= 128) value |= 1U << 19;
      if (transmit_errors_ >= 128) value |= 1U << 20;
      if (bus_off_) value |= 1U << 21;
      return value;
    }
    case kBdiag1:
      return was_bus_off_ ? kWasBusOff : 0;
    case kOsc:
      return osc_ | (now_ >= oscillator_ready_at_ ? kOscReady : 0);
    case kEccControl:
      return ecc_control_;
    case kEccStatus:
      return ecc_status_;
    default:
      break;
  }
  if (address >= kFifoBegin && address < kFifoEnd) {
    const unsigned index = 1 + (address - kFifoBegin) / kFifoStride;
    const Fifo& fifo = fifos_[index];
    switch ((address - kFifoBegin) % kFifoStride) {
      case 0:
        return word(address) | (fifo.requested ? kFifoRequest : 0);
      case 4:
        return fifo_status(index);
      default:
        if (mode_ == Mode::kConfiguration) complain("the user address is read in configuration mode");
        return fifo.depth == 0 ? 0 : fifo.address(fifo.transmits ? fifo.head() : fifo.tail);
    }
  }
  if (address >= kFilterControl && address < kFilterEnd) return word(address);
  complain("register " + hex(address) + " is not modelled (read)");
  return 0;
}

// `protected_bits` of the register can be changed in configuration mode only.
void Mcp2518fdChip::config_only(const char* name, unsigned address, std::uint32_t value, std::uint32_t mask,
                                std::uint32_t writable, std::uint32_t protected_bits) {
  const std::uint32_t before = word(address);
  const std::uint32_t after = (before & ~(mask & writable)) | (value & mask & writable);
  if (mode_ != Mode::kConfiguration && ((before ^ after) & protected_bits) != 0) {
    complain(std::string(name) + " changed outside the configuration mode");
    return;
  }
  if ((value & mask & ~writable) != 0) complain(std::string(name) + ": an unimplemented bit is set");
  word(address) = after;
}

void Mcp2518fdChip::write_register(unsigned address, std::uint32_t value, std::uint32_t mask) {
  switch (address) {
    case kCon:
      return write_con(value, mask);
    case kNbtcfg:
      return config_only("CiNBTCFG", address, value, mask, 0xFFFF'7F7F, ~0U);
    case kDbtcfg:
      return config_only("CiDBTCFG", address, value, mask, 0xFF1F'0F0F, ~0U);
    case kTdc:
      return config_only("CiTDC", address, value, mask, 0x0303'7F3F, ~0U);
    case kInt:
      // Writing 0 clears a flag; writing 1 has no effect.
      word(kInt) &= ~(kClearable & mask & ~value);
      word(kInt) = (word(kInt) & ~(kEnableBits & mask)) | (value & mask & kEnableBits);
      return;
    case kBdiag1:
      if ((mask & kWasBusOff) != 0 && (value & kWasBusOff) == 0) was_bus_off_ = false;
      return;
    case kOsc:
      if ((value & mask & kOscPll) != 0) complain("the PLL is turned on, which this clock does not need");
      if ((value & mask & kOscDisable) != 0) complain("turning off the oscillator is not modelled");
      osc_ = (osc_ & ~mask) | (value & mask & 0x7F);
      if (spec_.is_mcp2517fd) osc_ &= ~kOscLowPower;
      return;
    case kEccControl:
      ecc_control_ = (ecc_control_ & ~mask) | (value & mask & 0x7F07);
      return;
    case kEccStatus:
      ecc_status_ &= value | ~mask;
      return;
    default:
      break;
  }
  if (address >= kFifoBegin && address < kFifoEnd) {
    const unsigned index = 1 + (address - kFifoBegin) / kFifoStride;
    switch ((address - kFifoBegin) % kFifoStride) {
      case 0:
        return write_fifo_con(index, value, mask);
      case 4:
        if ((mask & kFifoOverrun) != 0 && (value & kFifoOverrun) == 0) fifos_[index].overrun = false;
        return;
      default:
        return complain("a user address is written");
    }
  }
  if (address >= kFilterControl && address < kFilterObject) {
    word(address) = (word(address) & ~mask) | (value & mask);
    return;
  }
  if (address >= kFilterObject && address < kFilterEnd) {
    const unsigned filter = (address - kFilterObject) / 8;
    const std::uint32_t control = word(kFilterControl + filter / 4 * 4);
    if (bits(control, filter % 4 * 8 + 7, 1) != 0) return complain("a filter is changed while it is enabled");
    word(address) = (word(address) & ~mask) | (value & mask);
    return;
  }
  complain("register " + hex(address) + " is not modelled (write)");
}

void Mcp2518fdChip::write_con(std::uint32_t value, std::uint32_t mask) {
  constexpr std::uint32_t kWritable = 0xFF1F'177F;
  constexpr std::uint32_t kProtected = 0x001F'0760;
  const std::uint32_t request = bits(value, 24, 3);
  config_only("CiCON", kCon, value, mask & ~(kAbort | 7U << 21), kWritable, kProtected);
  if ((value & mask & kAbort) != 0) {
    for (Fifo& fifo : fifos_) {
      if (!fifo.transmits) continue;
      fifo.requested = false;
    }
    // A frame that is on the bus is sent to its end.
    if (bus_.recessive_since(now_)) next_frame_.reset();
  }
  if ((mask & (7U << 24)) != 0) request_mode(request);
}

void Mcp2518fdChip::write_fifo_con(unsigned index, std::uint32_t value, std::uint32_t mask) {
  constexpr std::uint32_t kCommands = kFifoAdvance | kFifoRequest | kFifoReset;
  constexpr std::uint32_t kWritable = 0xFF7F'00FF;
  constexpr std::uint32_t kProtected = 0xFF00'0000 | kFifoTransmits | kFifoTimestamp | kFifoRemote;
  const unsigned address = kFifoBegin + (index - 1) * kFifoStride;
  config_only("CiFIFOCON", address, value & ~kCommands, mask & ~kCommands, kWritable, kProtected);
  const std::uint32_t commands = value & mask & kCommands;
  if (commands == 0) return;
  const std::string name = "FIFO " + std::to_string(index);
  Fifo& fifo = fifos_[index];
  if (mode_ == Mode::kConfiguration) {
    if ((commands & ~kFifoReset) != 0) complain(name + " is used in configuration mode");
    return;
  }
  if ((commands & kFifoReset) != 0) return complain("the reset of a single FIFO is not modelled");
  if ((commands & kFifoAdvance) != 0) {
    if (fifo.transmits) {
      if (fifo.count == fifo.depth) return complain(name + " is advanced while it is full");
      ++fifo.count;
    } else {
      if (fifo.count == 0) return complain(name + " is advanced while it is empty");
      fifo.tail = (fifo.tail + 1) % fifo.depth;
      --fifo.count;
    }
  }
  if ((commands & kFifoRequest) != 0) {
    if (!fifo.transmits) return complain(name + " receives, but a transmission is requested");
    fifo.requested = fifo.count != 0;
    if (!next_frame_) load_next_frame(now_ + kAssemblyTime);
  }
}

std::uint32_t Mcp2518fdChip::fifo_status(unsigned index) const {
  const Fifo& fifo = fifos_[index];
  constexpr std::uint32_t kWrongIndex = 0x1FU << 8;
  std::uint32_t status = kWrongIndex;
  if (fifo.transmits) {
    if (fifo.count < fifo.depth) status |= 1U;
    if (fifo.count <= fifo.depth / 2) status |= 2U;
    if (fifo.count == 0) status |= 4U;
  } else {
    if (fifo.count > 0) status |= 1U;
    if (fifo.count >= (fifo.depth + 1) / 2) status |= 2U;
    if (fifo.count == fifo.depth) status |= 4U;
    if (fifo.overrun) status |= kFifoOverrun;
  }
  return status;
}

std::uint32_t Mcp2518fdChip::interrupts() const {
  std::uint32_t value = word(kInt);
  if (mode_ != Mode::kConfiguration) {
    for (unsigned i = 1; i < kFifos; ++i) {
      const std::uint32_t control = word(kFifoBegin + (i - 1) * kFifoStride);
      const std::uint32_t pending = fifo_status(i) & control;
      if ((pending & 7U) != 0) value |= fifos_[i].transmits ? kTxIf : kRxIf;
      if (!fifos_[i].transmits && (pending & kFifoOverrun) != 0) value |= kRxOverrunIf;
    }
  }
  if ((ecc_status_ & ecc_control_ & 6U) != 0) value |= kEccIf;
  return value;
}

bool Mcp2518fdChip::irq() const {
  if (!powered_) return false;
  const std::uint32_t value = interrupts();
  return (value & (value >> 16) & 0xFFFFU) != 0;
}

// ---- RAM
// -----------------------------------------------------------------------------------------------------

std::uint32_t Mcp2518fdChip::ram_word(unsigned offset) {
  if (offset >= kRamBytes) {
    complain("RAM beyond its end");
    return 0;
  }
  constexpr std::uint32_t kDoubleError = 1U << 2;
  if ((ecc_control_ & 1U) != 0 && !written_[offset / 4]) ecc_status_ |= kDoubleError | offset << 16;
  if (!spec_.keeps_ram) return 0;
  std::uint32_t value = 0;
  for (unsigned i = 0; i < 4; ++i) value |= std::uint32_t{ram_[offset + i]} << (8 * i);
  return value;
}

void Mcp2518fdChip::set_ram_word(unsigned offset, std::uint32_t value) {
  if (offset >= kRamBytes) return complain("RAM beyond its end");
  for (unsigned i = 0; i < 4; ++i) ram_[offset + i] = static_cast<std::uint8_t>(value >> (8 * i));
  written_[offset / 4] = true;
}

// ---- modes
// ---------------------------------------------------------------------------------------------------

void Mcp2518fdChip::request_mode(unsigned mode) {
  switch (static_cast<Mode>(mode)) {
    case Mode::kNormalFd:
    case Mode::kConfiguration:
    case Mode::kNormalClassic:
      requested_mode_ = static_cast<Mode>(mode);
      requested_at_ = now_;
      if (*requested_mode_ == mode_) requested_mode_.reset();
      if (requested_mode_ && mode_ == Mode::kConfiguration) load_bit_timing();
      return;
  }
  complain("mode " + std::to_string(mode) + " is not modelled");
}

void Mcp2518fdChip::enter_configuration() {
  mode_ = Mode::kConfiguration;
  word(kInt) |= kModeIf;
  for (unsigned i = 1; i < kFifos; ++i) {
    word(kFifoBegin + (i - 1) * kFifoStride) |= kFifoReset;
    fifos_[i] = Fifo{};
  }
  next_frame_.reset();
  transmit_errors_ = receive_errors_ = 0;
  bus_off_ = was_bus_off_ = false;
}

void Mcp2518fdChip::enter_normal(Mode mode) {
  const std::uint32_t con = word(kCon);
  if ((con & kTransmitQueue) != 0) complain("the transmit queue is not modelled");
  if ((con & kEventFifo) != 0) complain("the event FIFO is not modelled");
  if (mode == Mode::kNormalFd && bits(con, 5, 1) == 0) complain("CAN FD without the CRC of ISO 11898-1");
  mode_ = mode;
  rates_.fd = mode == Mode::kNormalFd;
  word(kInt) |= kModeIf;
  lay_out_fifos();
}

void Mcp2518fdChip::lay_out_fifos() {
  unsigned at = 0;
  for (unsigned i = 1; i < kFifos; ++i) {
    std::uint32_t& control = word(kFifoBegin + (i - 1) * kFifoStride);
    control &= ~kFifoReset;
    if ((control & kFifoTimestamp) != 0) complain("timestamps are not modelled");
    Fifo& fifo = fifos_[i];
    fifo.payload_bytes = kPayloadSizes[bits(control, 29, 3)];
    fifo.object_bytes = 8 + fifo.payload_bytes;
    fifo.depth = bits(control, 24, 5) + 1;
    fifo.transmits = (control & kFifoTransmits) != 0;
    fifo.base = at;
    at += fifo.depth * fifo.object_bytes;
    const bool set_up = (control & ~kFifoReset) != (kFifoConReset & ~kFifoReset);
    if (set_up && at > kRamBytes) complain("FIFO " + std::to_string(i) + " exceeds the RAM");
  }
}

void Mcp2518fdChip::load_bit_timing() {
  const auto time_of = [this](unsigned cycles) {
    return SimTime{cycles} * kUnitsPerSecond / SimTime{spec_.clock_hz};
  };
  const auto check = [this](const char* phase, unsigned before, unsigned quanta) {
    if (before * 100 < quanta * 70 || before * 1000 > quanta * 875) {
      complain(std::string("the ") + phase + " bit is sampled at " + std::to_string(before * 100 / quanta) +
               " % of it");
    }
  };
  const std::uint32_t n = word(kNbtcfg);
  const unsigned n_before = 2 + bits(n, 16, 8);
  const unsigned n_quanta = n_before + 1 + bits(n, 8, 7);
  check("nominal", n_before, n_quanta);
  rates_.nominal = time_of((bits(n, 24, 8) + 1U) * n_quanta);
  const std::uint32_t d = word(kDbtcfg);
  const unsigned d_before = 2 + bits(d, 16, 5);
  const unsigned d_quanta = d_before + 1 + bits(d, 8, 4);
  const unsigned d_prescaler = bits(d, 24, 8) + 1;
  check("data", d_before, d_quanta);
  rates_.data = time_of(d_prescaler * d_quanta);

  // Whether the transmitter can check its own data bits. With delay compensation its sample point must be in
  // the second half of a bit; without it a bit must come back before the sample point.
  const SimTime delay = SimTime{spec_.transceiver_delay_ns} * kUnitsPerMicrosecond / 1'000;
  const std::uint32_t t = word(kTdc);
  constexpr unsigned kAutomatic = 2;
  if (bits(t, 16, 2) == kAutomatic) {
    const SimTime offset = time_of(bits(t, 8, 7));
    can_check_own_bits_ = offset * 2 > rates_.data && offset < rates_.data;
  } else {
    can_check_own_bits_ = delay < time_of(d_prescaler * d_before);
  }
}

void Mcp2518fdChip::advance(SimTime t) {
  bus_.advance(t);
  now_ = std::max(now_, t);
  settle(now_);
}

void Mcp2518fdChip::settle(SimTime t) {
  const auto recessive_since = bus_.recessive_since(t);
  if (!recessive_since) return;
  if (requested_mode_) {
    if (*requested_mode_ == Mode::kConfiguration || mode_ != Mode::kConfiguration) {
      const Mode mode = *requested_mode_;
      requested_mode_.reset();
      if (mode == Mode::kConfiguration) {
        enter_configuration();
      } else {
        complain("a change of normal modes without the configuration mode in between");
      }
    } else if (t >= std::max(*recessive_since, requested_at_) + kRecessiveBits * rates_.nominal) {
      const Mode mode = *requested_mode_;
      requested_mode_.reset();
      enter_normal(mode);
    }
  }
  if (bus_off_) {
    const SimTime quiet = t - std::max(*recessive_since, bus_off_at_);
    const std::int64_t seen = recessive_sequences_ + quiet / (kRecessiveBits * rates_.nominal);
    if (seen >= kSequencesToRecover) {
      bus_off_ = false;
      transmit_errors_ = receive_errors_ = 0;
      word(kInt) |= kErrorStateIf;
    }
  }
}

SimTime Mcp2518fdChip::next_event() const {
  SimTime next = bus_.next_event();
  const SimTime now = std::max(now_, bus_.now());
  const auto recessive_since = bus_.recessive_since(now);
  if (!recessive_since) return next;
  if (requested_mode_) {
    next = std::min(next, std::max(*recessive_since, requested_at_) + kRecessiveBits * rates_.nominal);
  }
  if (bus_off_) {
    next = std::min(next, std::max(*recessive_since, bus_off_at_) +
                              (kSequencesToRecover - recessive_sequences_) * kRecessiveBits * rates_.nominal);
  }
  return next;
}

// ---- the bus
// -------------------------------------------------------------------------------------------------

std::optional<CanStation::Offer> Mcp2518fdChip::offer() const {
  if (!participates() || !next_frame_ || requested_mode_) return std::nullopt;
  return Offer{.since = offer_since_,
               .frame = &*next_frame_,
               .error_passive = error_passive(),
               .can_check_own_bits = can_check_own_bits_ || !next_frame_->bit_rate_switch};
}

// Takes the frame of the transmit FIFO with the lowest number: priorities are not modelled.
void Mcp2518fdChip::load_next_frame(SimTime t) {
  next_frame_.reset();
  for (unsigned i = 1; i < kFifos && !next_frame_; ++i) {
    const Fifo& fifo = fifos_[i];
    if (!fifo.transmits || !fifo.requested || fifo.count == 0) continue;
    const unsigned at = fifo.address(fifo.tail);
    const std::uint32_t id = ram_word(at);
    const std::uint32_t control = ram_word(at + 4);
    if (bits(control, 4, 1) == 0) complain("frames with ids of 11 bits are not modelled");
    if (bits(control, 5, 1) != 0) complain("remote frames are not modelled");
    wire::CanFrame frame;
    frame.id = id_of_object(id);
    const bool fd = bits(control, 7, 1) != 0;
    if (fd && mode_ != Mode::kNormalFd) complain("a CAN FD frame in CAN 2.0 mode");
    frame.format = fd ? wire::CanFormat::kFd : wire::CanFormat::kClassic;
    frame.bit_rate_switch = fd && bits(control, 6, 1) != 0;
    frame.size = wire::kCanLengths[bits(control, 0, 4)];
    if (!fd && frame.size > wire::kMaxClassicPayload) frame.size = wire::kMaxClassicPayload;
    if (frame.size > fifo.payload_bytes) complain("a frame longer than its FIFO's objects");
    for (unsigned b = 0; b < frame.size; b += 4) {
      const std::uint32_t data = ram_word(at + 8 + b);
      for (unsigned k = 0; k < 4 && b + k < frame.size; ++k) {
        frame.data[b + k] = static_cast<std::uint8_t>(data >> (8 * k));
      }
    }
    next_frame_ = frame;
    sending_ = i;
    offer_since_ = t;
  }
}

void Mcp2518fdChip::frame_begins(SimTime t) {
  settle(t);
  if (!bus_off_) return;
  if (const auto since = bus_.recessive_since(t)) {
    recessive_sequences_ += (t - std::max(*since, bus_off_at_)) / (kRecessiveBits * rates_.nominal);
  }
}

void Mcp2518fdChip::sent(SimTime end) {
  if (!next_frame_) return;  // the chip lost its power meanwhile
  const ErrorState before = error_state();
  if (transmit_errors_ > 0) --transmit_errors_;
  Fifo& fifo = fifos_[sending_];
  fifo.tail = (fifo.tail + 1) % fifo.depth;
  --fifo.count;
  if (fifo.count == 0) fifo.requested = false;
  const unsigned pause = kIntermissionBits + (error_passive() ? kSuspendBits : 0);
  load_next_frame(end + pause * rates_.nominal);
  errors_changed(before);
}

void Mcp2518fdChip::send_failed(SimTime t, CanError error) {
  if (!next_frame_) return;
  const ErrorState before = error_state();
  // Alone on the bus a station retries for ever but does not go bus-off (ISO 11898-1, 12.1.4.2, exception 1).
  if (error != CanError::kAcknowledge || before < ErrorState::kPassive) transmit_errors_ += 8;
  const unsigned pause = kIntermissionBits + (error_passive() ? kSuspendBits : 0);
  offer_since_ = t + pause * rates_.nominal;
  if (!fifos_[sending_].requested) next_frame_.reset();
  if (transmit_errors_ > 255) go_bus_off(t);
  errors_changed(before);
}

void Mcp2518fdChip::received(const wire::CanFrame& frame, SimTime /*end*/) {
  const ErrorState before = error_state();
  receive_errors_ = receive_errors_ > 127 ? 120 : receive_errors_ - std::min(receive_errors_, 1U);
  errors_changed(before);
  const auto index = fifo_for(frame.id);
  if (!index) return;
  Fifo& fifo = fifos_[*index];
  if (fifo.transmits) return complain("a filter points to a transmit FIFO");
  if (frame.size > fifo.payload_bytes) return complain("a frame longer than its FIFO's objects is received");
  if (fifo.count == fifo.depth) {
    fifo.overrun = true;
    return;
  }
  const unsigned at = fifo.address(fifo.head());
  const bool fd = frame.format == wire::CanFormat::kFd;
  set_ram_word(at, bits(frame.id, 18, 11) | bits(frame.id, 0, 18) << 11);
  set_ram_word(at + 4, wire::can_length_code(frame.size) | 1U << 4 | (frame.bit_rate_switch ? 1U << 6 : 0U) |
                           (fd ? 1U << 7 : 0U));
  for (unsigned b = 0; b < frame.size; b += 4) {
    std::uint32_t data = 0;
    for (unsigned k = 0; k < 4 && b + k < frame.size; ++k)
      data |= std::uint32_t{frame.data[b + k]} << (8 * k);
    set_ram_word(at + 8 + b, data);
  }
  ++fifo.count;
}

std::optional<unsigned> Mcp2518fdChip::fifo_for(std::uint32_t id) {
  for (unsigned i = 0; i < kFilters; ++i) {
    const std::uint32_t control = bits(word(kFilterControl + i / 4 * 4), i % 4 * 8, 8);
    if ((control & 0x80U) == 0) continue;
    const std::uint32_t object = word(kFilterObject + 8 * i);
    const std::uint32_t mask = word(kFilterObject + 8 * i + 4);
    if ((mask & kExtended) != 0 && (object & kExtended) == 0) continue;
    const std::uint32_t compared = id_of_object(mask);
    if (((id ^ id_of_object(object)) & compared) != 0) continue;
    const unsigned fifo = control & 0x1FU;
    if (fifo == 0) {
      complain("a filter points to the transmit queue");
      return std::nullopt;
    }
    return fifo;
  }
  return std::nullopt;
}

void Mcp2518fdChip::receive_failed(SimTime /*t*/) {
  const ErrorState before = error_state();
  receive_errors_ = std::min(receive_errors_ + 1, 255U);
  errors_changed(before);
}

bool Mcp2518fdChip::error_passive() const {
  return error_state() >= ErrorState::kPassive;
}

Mcp2518fdChip::ErrorState Mcp2518fdChip::error_state() const noexcept {
  const unsigned worst = std::max(transmit_errors_, receive_errors_);
  if (bus_off_) return ErrorState::kOff;
  if (worst >= 128) return ErrorState::kPassive;
  return worst >= 96 ? ErrorState::kWarning : ErrorState::kActive;
}

// The return from warning to active raises no interrupt.
void Mcp2518fdChip::errors_changed(ErrorState before) {
  const ErrorState after = error_state();
  if (after > before || (before == ErrorState::kPassive && after < before)) word(kInt) |= kErrorStateIf;
}

void Mcp2518fdChip::go_bus_off(SimTime t) {
  bus_off_ = was_bus_off_ = true;
  bus_off_at_ = t;
  recessive_sequences_ = 0;
  next_frame_.reset();
  for (Fifo& fifo : fifos_) {
    if (!fifo.transmits) continue;
    fifo.tail = fifo.count = 0;
    fifo.requested = false;
  }
}

}  // namespace groma::sim
