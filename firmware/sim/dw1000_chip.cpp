#include "firmware/sim/dw1000_chip.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <utility>

#include "firmware/sim/frame_check.hpp"

namespace groma::sim {

namespace {

constexpr std::int64_t kCounterPeriod = std::int64_t{1} << 40;
constexpr std::uint64_t kCounterMask = (std::uint64_t{1} << 40) - 1;
constexpr std::uint64_t kCoarseMask = kCounterMask & ~std::uint64_t{0x1FF};
constexpr std::uint32_t kSlowSpi_hz = 3'000'000;
constexpr std::uint32_t kFastSpi_hz = 20'000'000;
// A frame is announced to the receivers this long before it starts.
constexpr SimTime kAnnounceAhead = 10 * kUnitsPerMillisecond;

// PMSC_CTRL0
constexpr std::uint32_t kSysclks = 0x3;
constexpr std::uint32_t kSysclksXti = 0x1;
constexpr std::uint32_t kLdeLoadClocks = 0x0301;  // the low half while the LDE microcode is loaded
constexpr std::uint32_t kTxclks = 0x30;
constexpr std::uint32_t kTxclksPll = 0x20;

// AON_CFG0, AON_CTRL, and the values with which other firmware puts the chip to sleep.
constexpr std::uint64_t kSleepEnable = 1U << 0;
constexpr std::uint64_t kAonSave = 1U << 1;
constexpr std::uint64_t kAonUpload = 1U << 2;
constexpr std::uint64_t kSleepSettings = 0x07;   // SLEEP_EN, WAKE_PIN, WAKE_SPI
constexpr std::uint64_t kWakeSettings = 0x0840;  // ONW_LLDE, ONW_LDC

// SYS_CFG
constexpr std::uint32_t kHirqPol = 1U << 9;
constexpr std::uint32_t kDisDrxb = 1U << 12;
constexpr std::uint32_t kDisStxp = 1U << 18;
constexpr std::uint32_t kRxwtoe = 1U << 28;
constexpr std::uint32_t kFilterRules = 0x1FE;  // no effect without FFE

// Purposes of draws.
enum : std::uint64_t { kFalsePllFlag = 0xD101 };

struct Header {
  bool valid = false;
  bool write = false;
  std::uint8_t file = 0;
  std::uint16_t offset = 0;
  std::size_t size = 1;
};

// User manual 2.2.1.2.
Header decode_header(std::span<const std::uint8_t> bytes) {
  Header header;
  if (bytes.empty()) return header;
  header.write = (bytes[0] & 0x80) != 0;
  header.file = bytes[0] & 0x3F;
  if ((bytes[0] & 0x40) != 0) {
    if (bytes.size() < 2) return header;
    header.size = 2;
    header.offset = bytes[1] & 0x7F;
    if ((bytes[1] & 0x80) != 0) {
      if (bytes.size() < 3) return header;
      header.size = 3;
      header.offset = static_cast<std::uint16_t>(header.offset | bytes[2] << 7);
    }
  }
  header.valid = true;
  return header;
}

std::string place(std::uint8_t file, std::size_t offset) {
  std::array<char, 24> text{};
  std::snprintf(text.data(), text.size(), "%02X:%04zX", static_cast<unsigned>(file), offset);
  return text.data();
}

std::uint64_t little_endian(std::span<const std::uint8_t> bytes, std::size_t at) {
  std::uint64_t value = 0;
  for (std::size_t i = 0; i < bytes.size() && at + i < 8; ++i)
    value |= static_cast<std::uint64_t>(bytes[i]) << (8 * (at + i));
  return value;
}

// TX_FCTRL's TXPSR and PE (table 16); 0: reserved.
std::uint16_t preamble_symbols(std::uint64_t fctrl) {
  switch ((fctrl >> 18) & 0xF) {
    case 0x1:
      return 64;
    case 0x5:
      return 128;
    case 0x9:
      return 256;
    case 0xD:
      return 512;
    case 0x2:
      return 1024;
    case 0x6:
      return 1536;
    case 0xA:
      return 2048;
    case 0x3:
      return 4096;
    default:
      return 0;
  }
}

}  // namespace

Dw1000Chip::Dw1000Chip(const ChipSpec& spec, Medium& medium)
    : medium_(medium), station_(medium.attach(*this, spec.id)), spec_(spec), clock_(spec.clock) {}

// ---- power and reset ------------------------------------------------------------------------------

void Dw1000Chip::set_power(bool on, SimTime t) {
  advance(t);
  if (on == powered_) return;
  powered_ = on;
  asleep_ = on && spec_.quirks.asleep;
  kept_sleep_settings_ = asleep_ ? kSleepSettings : 0;
  kept_wake_settings_ = asleep_ ? kWakeSettings : 0;
  if (on) {
    reset(t);
    return;
  }
  clear_radio();
  registers_.reset();
  status_ = 0;
  update_next_event();
}

void Dw1000Chip::reset(SimTime t) {
  advance(t);
  if (!powered_) return;
  // The reset loads the always-on memory.
  if ((kept_sleep_settings_ & kSleepEnable) != 0) {
    asleep_ = true;
    clear_radio();
    status_ = 0;
    update_next_event();
    return;
  }
  if (kept_wake_settings_ != 0) complain("AON: a reset that restores settings is not modelled");
  boot(t, kSpiReadyAfterReset);
}

void Dw1000Chip::select(SimTime t, bool low) {
  const SimTime since = std::exchange(selected_at_, low ? t : kNever);
  if (low || !asleep_ || since == kNever || t - since < kWakeUpSelect) return;
  advance(t);
  asleep_ = false;
  boot(since + kWakeUpSelect, kSpiReadyAfterWakeUp);
  registers_.set(Reg::kAonCfg0, kept_sleep_settings_);
  registers_.set(Reg::kAonWcfg, kept_wake_settings_);
}

void Dw1000Chip::boot(SimTime t, SimTime until_spi) {
  clear_radio();
  registers_.reset();
  status_ = 0;
  tuning_valid_ = false;
  converted_at_ = kNever;
  restart_counter(t);
  lde_loaded_ = false;
  lde_loaded_at_ = kNever;
  pll_locked_ = false;
  pll_flag_at_ = kNever;
  spi_ready_at_ = t + until_spi;
  pll_locks_at_ = spi_ready_at_ + (kPllLockAfterReset - kSpiReadyAfterReset);
  update_next_event();
}

void Dw1000Chip::soft_reset() {
  const std::uint64_t held = registers_.get(Reg::kPmscCtrl0) & 0x0FFFFFFF;
  clear_radio();
  registers_.reset();
  registers_.set(Reg::kPmscCtrl0, held);
  status_ = 0;
  tuning_valid_ = false;
  converted_at_ = kNever;
  restart_counter(now_);
  lde_loaded_ = false;
  lde_loaded_at_ = kNever;
  pll_locked_ = false;
  pll_flag_at_ = kNever;
  pll_locks_at_ = kNever;
}

void Dw1000Chip::restart_counter(SimTime t) noexcept {
  counter_base_ = clock_.ticks(t) - static_cast<std::int64_t>(spec_.clock.first_tick);
}

void Dw1000Chip::lock_pll() {
  pll_locked_ = true;
  status_ |= status::kCplock;
  draw_pll_flag(now_);
  const KeyedRandom draw = medium_.random().of(kFalsePllFlag, spec_.id, pll_flags_drawn_++);
  if (pll_flag_at_ == kNever || draw.of(0).uniform() < 0.5) return;
  pll_flag_ = status::kClkpllLl;
  pll_flag_at_ = now_ + from_seconds(draw.of(1).uniform(10e-6, 500e-6));
}

// The times between false flags are distributed exponentially.
void Dw1000Chip::draw_pll_flag(SimTime from) {
  const double rate_hz = spec_.quirks.false_pll_flags_per_minute / 60.0;
  if (rate_hz <= 0.0) return;
  const KeyedRandom draw = medium_.random().of(kFalsePllFlag, spec_.id, pll_flags_drawn_++);
  pll_flag_ = draw.of(0).uniform() < 0.5 ? status::kClkpllLl : status::kRfpllLl;
  pll_flag_at_ = from + from_seconds(-std::log(draw.of(1).uniform()) / rate_hz);
}

void Dw1000Chip::clear_radio() {
  transceiver_off();
  arrivals_.clear();
  receiver_needs_reset_ = false;
}

// ---- SPI ------------------------------------------------------------------------------------------

bool Dw1000Chip::spi_answers(std::uint32_t hz) {
  if (!powered_ || asleep_ || now_ < spi_ready_at_) return false;
  const bool on_crystal = !pll_locked_ || (registers_.get(Reg::kPmscCtrl0) & kSysclks) == kSysclksXti;
  if (hz > (on_crystal ? kSlowSpi_hz : kFastSpi_hz)) {
    ++garbled_transfers_;
    return false;
  }
  return true;
}

void Dw1000Chip::write(SimTime t, std::span<const std::uint8_t> header_bytes,
                       std::span<const std::uint8_t> out, std::uint32_t hz) {
  advance(t);
  if (!spi_answers(hz)) return;
  const Header header = decode_header(header_bytes);
  if (!header.valid || !header.write || header.size != header_bytes.size()) {
    complain("SPI: invalid header of a write");
    return;
  }
  std::size_t offset = header.offset;
  while (!out.empty()) {
    const RegisterInfo* info = find_register(header.file, static_cast<std::uint16_t>(offset));
    if (info == nullptr) {
      complain("write to " + place(header.file, offset) + ", where no register is modelled");
      break;
    }
    const std::size_t at = offset - info->offset;
    const std::size_t count = std::min<std::size_t>(out.size(), info->length - at);
    write_register(*info, at, out.first(count));
    offset += count;
    out = out.subspan(count);
  }
  update_next_event();
}

void Dw1000Chip::read(SimTime t, std::span<const std::uint8_t> header_bytes, std::span<std::uint8_t> in,
                      std::uint32_t hz) {
  advance(t);
  std::fill(in.begin(), in.end(), std::uint8_t{0});
  const std::uint64_t garbled = garbled_transfers_;
  if (!spi_answers(hz)) {
    // Garbage that is no register's reset value.
    if (garbled_transfers_ != garbled) std::fill(in.begin(), in.end(), std::uint8_t{0xA5});
    return;
  }
  const Header header = decode_header(header_bytes);
  if (!header.valid || header.write || header.size != header_bytes.size()) {
    complain("SPI: invalid header of a read");
    return;
  }
  std::size_t offset = header.offset;
  while (!in.empty()) {
    const RegisterInfo* info = find_register(header.file, static_cast<std::uint16_t>(offset));
    if (info == nullptr) {
      complain("read of " + place(header.file, offset) + ", where no register is modelled");
      return;
    }
    switch (info->reg) {
      case Reg::kSysTime:
        registers_.set(Reg::kSysTime, static_cast<std::uint64_t>(ticks(now_)) & kCoarseMask);
        break;
      case Reg::kSysStatus:
        registers_.set(Reg::kSysStatus, live_status());
        break;
      case Reg::kTcSarlSupply:
      case Reg::kTcSarlTemperature:
        finish_conversion();
        break;
      case Reg::kRfStatus:
        registers_.set(Reg::kRfStatus, pll_locked_ ? 0x1 : 0x0);
        break;
      default:
        break;
    }
    const std::size_t at = offset - info->offset;
    const std::size_t count = std::min<std::size_t>(in.size(), info->length - at);
    const std::span<const std::uint8_t> bytes = registers_.bytes(info->reg).subspan(at, count);
    std::copy(bytes.begin(), bytes.end(), in.begin());
    offset += count;
    in = in.subspan(count);
  }
}

void Dw1000Chip::transfer(SimTime t, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                          std::uint32_t hz) {
  const Header header = decode_header(mosi);
  std::fill(miso.begin(), miso.end(), std::uint8_t{0});
  if (!header.valid) {
    complain("SPI: a transfer ends within its header");
  } else if (header.write) {
    write(t, mosi.first(header.size), mosi.subspan(header.size), hz);
  } else {
    read(t, mosi.first(header.size), miso.subspan(std::min(header.size, miso.size())), hz);
  }
}

void Dw1000Chip::write_register(const RegisterInfo& info, std::size_t at,
                                std::span<const std::uint8_t> bytes) {
  switch (info.access) {
    case Access::kReadOnly:
      complain(std::string("write to ") + info.name + " (" + place(info.file, info.offset + at) +
               "), which is read-only");
      return;
    case Access::kWriteOneToClear:
      status_ &= ~little_endian(bytes, at);
      return;
    case Access::kCommand:
      command(static_cast<std::uint32_t>(little_endian(bytes, at)));
      return;
    case Access::kReadWrite:
      break;
  }
  const auto before = static_cast<std::uint32_t>(registers_.get(info.reg));
  std::copy(bytes.begin(), bytes.end(), registers_.bytes(info.reg).begin() + static_cast<std::ptrdiff_t>(at));
  if (info.reg == Reg::kPmscCtrl0) {
    power_management_written(before);
  } else {
    register_written(info.reg);
  }
}

void Dw1000Chip::register_written(Reg reg) {
  switch (reg) {
    case Reg::kSysCfg:
      system_configuration_written();
      break;
    case Reg::kTxBuffer:
      if (transmission_.frame != nullptr && transmission_.stage == 0) load_frame(*transmission_.frame);
      break;
    case Reg::kTxFctrl:
      if (transmission_.frame != nullptr) complain("TX_FCTRL written while a frame is pending or being sent");
      break;
    case Reg::kChanCtrl:
      if ((registers_.get(reg) & 0x00320000) != 0) complain("CHAN_CTRL: user-defined SFDs are not modelled");
      tuning_valid_ = false;
      break;
    case Reg::kFsXtalt:
      if ((registers_.get(reg) & 0xE0) != 0x60) complain("FS_XTALT: bits 7 to 5 must be 011");
      break;
    case Reg::kOtpCtrl:
      otp_control_written();
      break;
    case Reg::kTcSarc:
      converter_written();
      break;
    case Reg::kRfSensorBias:
    case Reg::kRfSensorEnable:
      break;
    case Reg::kAonCfg0:
    case Reg::kAonWcfg:
      if (registers_.get(reg) != 0) complain("AON: going to sleep is not modelled");
      break;
    case Reg::kAonCtrl:
      if ((registers_.get(reg) & (kAonSave | kAonUpload)) != 0) {
        kept_sleep_settings_ = registers_.get(Reg::kAonCfg0);
        kept_wake_settings_ = registers_.get(Reg::kAonWcfg);
      }
      break;
    case Reg::kEvcCtrl:
      if ((registers_.get(reg) & 2) != 0) {
        for (auto i = static_cast<std::size_t>(Reg::kEvcPhe); i <= static_cast<std::size_t>(Reg::kEvcTpw);
             ++i)
          registers_.set(static_cast<Reg>(i), 0);
        registers_.set(reg, registers_.get(reg) & ~std::uint64_t{2});
      }
      break;
    default:
      tuning_valid_ = false;
      break;
  }
}

void Dw1000Chip::system_configuration_written() {
  const auto value = static_cast<std::uint32_t>(registers_.get(Reg::kSysCfg));
  const std::uint32_t modelled = kHirqPol | kDisDrxb | kDisStxp | kRxwtoe | kFilterRules;
  if ((value & ~modelled) != 0) {
    complain("SYS_CFG: bits that are not modelled are set: " + place(0x04, value & ~modelled));
  } else if ((value & kHirqPol) == 0) {
    complain("SYS_CFG: the interrupt line is wired active high (HIRQ_POL)");
  } else if ((value & kDisDrxb) == 0) {
    complain("SYS_CFG: double buffering is not modelled (DIS_DRXB)");
  }
}

void Dw1000Chip::otp_control_written() {
  const std::uint64_t bits = registers_.get(Reg::kOtpCtrl);
  if ((bits & 0x8000) != 0) {
    if ((registers_.get(Reg::kPmscCtrl0) & 0xFFFF) == kLdeLoadClocks) lde_loaded_at_ = now_ + kLdeLoadTime;
    registers_.set(Reg::kOtpCtrl, bits & 0x7FFF);
  }
  if ((bits & 0x3) == 0x3) {
    const bool on_crystal = !pll_locked_ || (registers_.get(Reg::kPmscCtrl0) & kSysclks) == kSysclksXti;
    if (!on_crystal) {
      complain("OTP read with the system clock on the PLL");
      return;
    }
    std::uint32_t word = 0;
    switch (registers_.get(Reg::kOtpAddr)) {
      case 0x04:
        word = spec_.otp.ldo_tune;
        break;
      case 0x06:
        word = spec_.otp.part_id;
        break;
      case 0x07:
        word = spec_.otp.lot_id;
        break;
      case 0x08:
        word = spec_.otp.supply;
        break;
      case 0x09:
        word = spec_.otp.temperature;
        break;
      case 0x1C:
        word = spec_.otp.antenna_delay;
        break;
      case 0x1E:
        word = spec_.otp.crystal_trim;
        break;
      default:
        break;
    }
    registers_.set(Reg::kOtpRdat, word);
  }
}

// User manual 6.4 and Decawave's driver: the sensors' bias and outputs must be on before a conversion starts.
// The conversion takes kConversionTime.
void Dw1000Chip::converter_written() {
  const bool on = (registers_.get(Reg::kTcSarc) & 1) != 0;
  const bool biased =
      registers_.get(Reg::kRfSensorBias) == 0x80 && registers_.get(Reg::kRfSensorEnable) == 0x0F;
  if (!on) {
    finish_conversion();
    converted_at_ = kNever;
  } else if (biased && converted_at_ == kNever) {
    converted_at_ = now_ + kConversionTime;
  }
}

void Dw1000Chip::finish_conversion() {
  if (converted_at_ == kNever || now_ < converted_at_) return;
  const auto reading = [](double at_reference, double steps) {
    return static_cast<std::uint64_t>(std::clamp(std::round(at_reference + steps), 0.0, 255.0));
  };
  registers_.set(Reg::kTcSarlSupply,
                 reading(spec_.otp.supply & 0xFF, (spec_.ambient.supply_v - 3.3) * 173.0));
  registers_.set(Reg::kTcSarlTemperature,
                 reading(spec_.otp.temperature & 0xFF, (spec_.ambient.temperature_c - 23.0) / 1.14));
}

void Dw1000Chip::power_management_written(std::uint32_t before) {
  const auto value = static_cast<std::uint32_t>(registers_.get(Reg::kPmscCtrl0));
  if (lde_loaded_at_ != kNever && (value & 0xFFFF) != kLdeLoadClocks) lde_loaded_at_ = kNever;
  const std::uint32_t reset = value >> 28;
  const std::uint32_t reset_before = before >> 28;
  if (reset == reset_before) return;
  switch (reset) {
    case 0x0:
      if ((value & kSysclks) != kSysclksXti) {
        complain("soft reset with the system clock not on the crystal");
      }
      soft_reset();
      break;
    case 0xE:
      if (transmission_.frame != nullptr) complain("receiver reset while a frame is pending or being sent");
      receiver_off();
      receiver_needs_reset_ = receiver_needs_reset_ || (spec_.quirks.reset_needs_off && !turned_off_);
      break;
    case 0xF:
      if (reset_before == 0x0) {
        pll_locks_at_ = now_ + kPllLockAfterSoftReset;
      } else if (reset_before == 0xE && (turned_off_ || !spec_.quirks.reset_needs_off)) {
        receiver_needs_reset_ = false;
      }
      break;
    default:
      complain("PMSC_CTRL0: this reset is not modelled");
      break;
  }
}

std::uint64_t Dw1000Chip::live_status() const noexcept {
  std::uint64_t value = status_;
  const bool transmit_waits =
      transmission_.frame != nullptr && transmission_.delayed && transmission_.stage == 0;
  if (transmit_waits || receiver_ == Receiver::kDelayed) {
    const std::int64_t start = transmit_waits ? transmission_.start_tick : receive_start_tick_;
    if (start - ticks(now_) > kCounterPeriod / 2) value |= status::kHpdwarn;
  }
  if ((value & registers_.get(Reg::kSysMask)) != 0) value |= status::kIrqs;
  return value;
}

bool Dw1000Chip::irq() const noexcept {
  return powered_ && !asleep_ && (live_status() & status::kIrqs) != 0;
}

// ---- commands and transmitter ---------------------------------------------------------------------

void Dw1000Chip::command(std::uint32_t bits) {
  using namespace control;
  if ((bits & ~(kTxstrt | kTxdlys | kTrxoff | kWait4resp | kRxenab | kRxdlye)) != 0) {
    complain("SYS_CTRL: a command that is not modelled");
    return;
  }
  if ((bits & kTrxoff) != 0) transceiver_off();
  if ((bits & kTxstrt) != 0) start_transmit((bits & kTxdlys) != 0, (bits & kWait4resp) != 0);
  if ((bits & kRxenab) != 0) start_receive((bits & kRxdlye) != 0);
}

void Dw1000Chip::transceiver_off() {
  turned_off_ = true;
  if (transmission_.frame != nullptr) {
    if (transmission_.stage > 0) {
      medium_.cut(transmission_.frame, now_);
    } else if (transmission_.announced) {
      medium_.retract(transmission_.frame);
    }
    transmission_ = {};
  }
  receiver_off();
}

bool Dw1000Chip::radio_clocked(const char* what) {
  if (!pll_locked_ || (registers_.get(Reg::kPmscCtrl0) & kSysclks) == kSysclksXti) {
    complain(std::string(what) + " with the system clock on the crystal");
    return false;
  }
  if (registers_.get(Reg::kPmscCtrl0) >> 28 != 0xF) {
    complain(std::string(what) + " while in reset");
    return false;
  }
  return true;
}

std::int64_t Dw1000Chip::next_tick_with(std::uint64_t value) const noexcept {
  const auto now = static_cast<std::uint64_t>(ticks(now_));
  return static_cast<std::int64_t>(now + ((value - now) & kCounterMask));
}

void Dw1000Chip::load_frame(AirFrame& frame) {
  const std::size_t from = registers_.get(Reg::kTxFctrl) >> 22 & 0x3FF;
  const std::size_t payload = frame.length - 2U;
  const std::span<const std::uint8_t> buffer = registers_.bytes(Reg::kTxBuffer);
  if (from + payload > buffer.size()) {
    complain("TX_FCTRL: the frame reaches beyond the transmit buffer");
    return;
  }
  std::copy_n(buffer.begin() + static_cast<std::ptrdiff_t>(from), payload, frame.data.begin());
  const std::uint16_t check = frame_check(std::span(frame.data).first(payload));
  frame.data[payload] = static_cast<std::uint8_t>(check & 0xFF);
  frame.data[payload + 1] = static_cast<std::uint8_t>(check >> 8);
}

void Dw1000Chip::start_transmit(bool delayed, bool wait_for_response) {
  if (!radio_clocked("transmit")) return;
  if (transmission_.frame != nullptr) {
    complain("TXSTRT while a frame is pending or being sent");
    return;
  }
  if (receiver_ != Receiver::kOff) {
    complain("TXSTRT while the receiver is on");
    return;
  }
  const std::uint64_t fctrl = registers_.get(Reg::kTxFctrl);
  const auto length = static_cast<std::uint16_t>(fctrl & 0x3FF);
  const std::uint16_t symbols = preamble_symbols(fctrl);
  if (length < 3 || length > 127) {
    complain("TX_FCTRL: a frame has 3 to 127 bytes");
    return;
  }
  if (symbols == 0 || ((fctrl >> 13) & 3) != 2) {
    complain("TX_FCTRL: only 6.8 Mbit/s and valid preamble lengths are modelled");
    return;
  }
  const Tuning& tuned = tuning();
  auto frame = std::make_shared<AirFrame>();
  frame->source = station_;
  frame->number = frames_sent_ + 1;
  frame->format.channel = tuned.transmits ? 5 : 0;
  frame->format.prf_mhz = ((fctrl >> 16) & 3) == 2 ? 64 : 16;
  frame->format.preamble_code = tuned.transmit_code;
  frame->format.preamble_symbols = symbols;
  frame->ranging = (fctrl & 0x8000) != 0;
  frame->length = length;
  load_frame(*frame);

  Transmission& sending = transmission_;
  sending = {};
  sending.delayed = delayed;
  sending.wait_for_response = wait_for_response;
  const std::int64_t to_rmarker = preamble_ticks(symbols);
  const std::int64_t now = ticks(now_);
  bool missed = false;
  if (delayed) {
    const std::uint64_t rmarker = registers_.get(Reg::kDxTime) & kCoarseMask;
    sending.start_tick = next_tick_with(rmarker - static_cast<std::uint64_t>(to_rmarker));
    sending.rmarker_tick = sending.start_tick + to_rmarker;
    const std::int64_t ahead = sending.start_tick - now;
    if (ahead > kCounterPeriod / 2) {
      count_event(Reg::kEvcHpw);
    } else if (ahead < kTransmitterPowerUpTicks) {
      status_ |= status::kTxpute;
      count_event(Reg::kEvcTpw);
      missed = spec_.quirks.missed_starts;
    }
    if (ahead <= kCounterPeriod / 2) {
      const auto lead = static_cast<double>(sending.rmarker_tick - now);
      sending.gain_ticks = std::llround(1e-6 * spec_.quirks.delayed_transmit_gain_ppm * lead);
    }
  } else {
    sending.rmarker_tick = (now + kTransmitterPowerUpTicks + to_rmarker + 0x1FF) & ~std::int64_t{0x1FF};
    sending.start_tick = sending.rmarker_tick - to_rmarker;
  }
  // By the counter before the launch.
  const auto time_at = [&](std::int64_t tick) { return time_of(tick - sending.gain_ticks); };
  const std::int64_t data = sending.rmarker_tick + kHeaderTicks;
  sending.at = {time_at(sending.start_tick),
                time_at(sending.rmarker_tick - kSfdSymbols * kPreambleSymbolTicks), time_at(data),
                time_at(data + data_ticks(length))};
  // The antenna radiates later than the chip's counter says, by the antenna delay.
  const SimTime rmarker = time_at(sending.rmarker_tick);
  frame->rmarker = time_at(sending.rmarker_tick + spec_.transmit_antenna_delay_ticks);
  const SimTime antenna = frame->rmarker - rmarker;
  frame->preamble_start = sending.at[0] + antenna;
  frame->data_start = sending.at[2] + antenna;
  frame->end = sending.at[3] + antenna;
  frame->clock_offset = clock_.offset(rmarker);
  sending.announce_at = missed ? kNever : std::max(now_, sending.at[0] - kAnnounceAhead);
  sending.frame = std::move(frame);
  if (sending.announce_at <= now_) transmission_step();
}

void Dw1000Chip::transmission_step() {
  Transmission& sending = transmission_;
  if (!sending.announced) {
    sending.announced = true;
    medium_.announce(sending.frame);
    return;
  }
  const SimTime at = sending.at[sending.stage];
  switch (sending.stage++) {
    case 0:
      ++frames_sent_;
      counter_base_ -= sending.gain_ticks;
      status_ = (status_ & ~status::kAllTx) | status::kTxfrb | (status_ & status::kTxpute);
      break;
    case 1:
      status_ |= status::kTxprs;
      break;
    case 2: {
      status_ |= status::kTxphs;
      const auto raw = static_cast<std::uint64_t>(sending.rmarker_tick);
      const std::uint64_t timestamp = (raw + registers_.get(Reg::kTxAntd)) & kCounterMask;
      const std::span<std::uint8_t> bytes = registers_.bytes(Reg::kTxTime);
      for (unsigned i = 0; i < 5; ++i) {
        bytes[i] = static_cast<std::uint8_t>(timestamp >> (8 * i));
        bytes[5 + i] = static_cast<std::uint8_t>((raw & kCounterMask) >> (8 * i));
      }
      break;
    }
    default: {
      // Erratum TX-1: after a delayed transmit TXFRS is set only if the transmitter's clock was forced on.
      if (const bool reported = !std::exchange(loses_event_, false);
          reported && (!sending.delayed || (registers_.get(Reg::kPmscCtrl0) & kTxclks) == kTxclksPll))
        status_ |= status::kTxfrs;
      count_event(Reg::kEvcTxfs);
      const bool wait = sending.wait_for_response;
      const std::int64_t end = ticks(at);
      sending = {};
      if (wait) {
        receive_start_tick_ =
            end + static_cast<std::int64_t>(registers_.get(Reg::kAckRespT) & 0xFFFFF) * kTicksPerUus;
        receiver_on_at_ = std::max(at, time_of(receive_start_tick_));
        receiver_ = Receiver::kDelayed;
      }
      break;
    }
  }
}

void Dw1000Chip::start_receive(bool delayed) {
  if (!radio_clocked("receive")) return;
  if (transmission_.frame != nullptr) {
    complain("RXENAB while a frame is pending or being sent");
    return;
  }
  if (listening()) return;
  if (!delayed) {
    receiver_on(now_);
    return;
  }
  receive_start_tick_ = next_tick_with(registers_.get(Reg::kDxTime) & kCoarseMask);
  receiver_on_at_ = time_of(receive_start_tick_);
  receiver_ = Receiver::kDelayed;
  if (receive_start_tick_ - ticks(now_) > kCounterPeriod / 2) count_event(Reg::kEvcHpw);
}

// ---- time -----------------------------------------------------------------------------------------

void Dw1000Chip::update_next_event() noexcept {
  next_event_ = kNever;
  if (!powered_ || asleep_) return;
  SimTime next =
      std::min({pll_locked_ ? kNever : pll_locks_at_, pll_flag_at_, lde_loaded_at_, next_receiver_event()});
  if (transmission_.frame != nullptr)
    next = std::min(
        next, transmission_.announced ? transmission_.at[transmission_.stage] : transmission_.announce_at);
  if (!arrivals_.empty()) {
    // The frames that have started come first.
    const auto first = std::find_if(arrivals_.begin(), arrivals_.end(),
                                    [](const Arrival& arrival) { return !arrival.started; });
    if (first != arrivals_.end()) next = std::min(next, first->frame->preamble_start);
  }
  next_event_ = next;
}

void Dw1000Chip::advance(SimTime t) {
  while (next_event_ <= t) {
    now_ = std::max(now_, next_event_);
    if (!pll_locked_ && pll_locks_at_ <= now_) {
      lock_pll();
    } else if (pll_flag_at_ <= next_event_) {
      status_ |= pll_flag_;
      draw_pll_flag(pll_flag_at_);
    } else if (lde_loaded_at_ <= now_) {
      lde_loaded_ = true;
      lde_loaded_at_ = kNever;
    } else if (transmission_.frame != nullptr &&
               (transmission_.announced ? transmission_.at[transmission_.stage]
                                        : transmission_.announce_at) <= next_event_) {
      transmission_step();
    } else {
      receiver_step(next_event_);
    }
    update_next_event();
  }
  now_ = std::max(now_, t);
}

void Dw1000Chip::count_event(Reg counter) {
  if ((registers_.get(Reg::kEvcCtrl) & 1) != 0)
    registers_.set(counter, (registers_.get(counter) + 1) & 0xFFF);
}

void Dw1000Chip::complain(const std::string& message) {
  if (fault_.empty()) fault_ = "DW1000: " + message;
}

const Tuning& Dw1000Chip::tuning() {
  if (!tuning_valid_) {
    tuning_ = read_tuning(registers_);
    tuning_valid_ = true;
  }
  return tuning_;
}

}  // namespace groma::sim
