#include "test/host/provision/emulated_part.hpp"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstring>
#include <thread>

namespace groma::provision::test {

namespace {

constexpr std::uint32_t kPageBytes = 4096;
constexpr std::uint32_t kUicr = 0x1000'1000;
constexpr std::uint32_t kUicrBytes = 0x1000;
constexpr std::uint32_t kUicrApprotect = 0x208;
constexpr std::uint32_t kRam = 0x2000'0000;
constexpr std::uint32_t kRamBytes = 64 * 1024;

constexpr std::uint32_t kNvmcReady = 0x4001'E400;
constexpr std::uint32_t kNvmcConfig = 0x4001'E504;
constexpr std::uint32_t kNvmcErasePage = 0x4001'E508;
constexpr std::uint32_t kNvmcEraseAll = 0x4001'E50C;
constexpr std::uint32_t kNvmcEraseUicr = 0x4001'E514;
constexpr std::uint32_t kWriteEnable = 1;
constexpr std::uint32_t kEraseEnable = 2;

constexpr std::uint32_t kCpuid = 0xE000'ED00;
constexpr std::uint32_t kAircr = 0xE000'ED0C;
constexpr std::uint32_t kDfsr = 0xE000'ED30;
constexpr std::uint32_t kDhcsr = 0xE000'EDF0;
constexpr std::uint32_t kDcrsr = 0xE000'EDF4;
constexpr std::uint32_t kDcrdr = 0xE000'EDF8;
constexpr std::uint32_t kDemcr = 0xE000'EDFC;
constexpr std::uint32_t kSystemSpace = 0xE000'0000;
constexpr std::uint32_t kSystemEnd = 0xE010'0000;

constexpr std::uint32_t kHalt = 1U << 1;
constexpr std::uint32_t kRegisterReady = 1U << 16;
constexpr std::uint32_t kHalted = 1U << 17;
constexpr std::uint32_t kResetSeen = 1U << 25;
constexpr std::uint32_t kCatchReset = 1;
constexpr std::uint32_t kStackPointer = 13;
constexpr std::uint32_t kProgramCounter = 15;

constexpr std::uint32_t kControlReset = 0x00;
constexpr std::uint32_t kControlEraseAll = 0x04;
constexpr std::uint32_t kControlEraseStatus = 0x08;
constexpr std::uint32_t kControlProtection = 0x0C;
constexpr std::uint32_t kControlIdentity = 0xFC;

std::uint32_t word_at(const std::vector<std::uint8_t>& memory, std::uint32_t offset) {
  std::uint32_t word = 0;
  std::memcpy(&word, memory.data() + offset, sizeof word);
  return word;
}

void set_word(std::vector<std::uint8_t>& memory, std::uint32_t offset, std::uint32_t word) {
  std::memcpy(memory.data() + offset, &word, sizeof word);
}

}  // namespace

EmulatedPart::EmulatedPart() : flash_(kFlashBytes, 0xFF), uicr_(kUicrBytes, 0xFF), ram_(kRamBytes, 0) {
  kept_ = {
      {0x1000'0010, kPageBytes},   // FICR.CODEPAGESIZE
      {0x1000'0014, 128},          // FICR.CODESIZE
      {0x1000'0100, 0x52832},      // FICR.INFO.PART
      {0x1000'0104, 0x4141'4530},  // VARIANT AAE0
      {0x1000'0108, 0x2000},       // PACKAGE QF
      {0x1000'010C, 64},           // RAM in KiB
      {0x1000'0110, 512},          // FLASH in KiB
      {0x1000'005C, 0xFFFF'0139},  // CONFIGID
      {0x4000'0600, 0},            // BPROT.CONFIG0 to 3
      {0x4000'0604, 0},           {0x4000'0610, 0},
      {0x4000'0614, 0},           {kCpuid, 0x410F'C241},       // Cortex-M4 r0p1
      {0xE000'EF40, 0x1011'0021},                              // MVFR0, MVFR1: with an FPU
      {0xE000'EF44, 0x1100'0011}, {0xE000'1000, 0x4000'0000},  // DWT_CTRL: 4 comparators
      {0xE000'2000, 0x0000'0260},                              // FP_CTRL: 6 + 2 comparators
  };
}

void EmulatedPart::lock() {
  set_word(uicr_, kUicrApprotect, 0xFFFF'FF00);
  locked_ = true;
}

std::optional<std::uint32_t> EmulatedPart::read(std::uint32_t address) {
  if (locked_) return std::nullopt;
  if (address < kFlashBytes) return word_at(flash_, address);
  if (address >= kUicr && address < kUicr + kUicrBytes) return word_at(uicr_, address - kUicr);
  if (address >= kRam && address < kRam + kRamBytes) return word_at(ram_, address - kRam);
  return read_register(address);
}

bool EmulatedPart::write(std::uint32_t address, std::uint32_t value, std::uint32_t lanes) {
  if (locked_) return false;
  const bool whole = lanes == 0xFFFF'FFFF;
  if (address < kFlashBytes) return whole && write_flash(flash_, address, value);
  if (address >= kUicr && address < kUicr + kUicrBytes)
    return whole && write_flash(uicr_, address - kUicr, value);
  if (address >= kRam && address < kRam + kRamBytes) {
    set_word(ram_, address - kRam, (word_at(ram_, address - kRam) & ~lanes) | (value & lanes));
    return true;
  }
  return whole && write_register(address, value);
}

bool EmulatedPart::write_flash(std::vector<std::uint8_t>& memory, std::uint32_t offset, std::uint32_t value) {
  if (nvmc_config_ != kWriteEnable) return false;
  const bool broken = &memory == &flash_ && broken_ == offset;
  if (!broken) set_word(memory, offset, word_at(memory, offset) & value);  // writing only clears bits
  ++words_written_;
  while (words_written_ >= hold_at_) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  return true;
}

std::optional<std::uint32_t> EmulatedPart::read_register(std::uint32_t address) {
  switch (address) {
    case kNvmcReady:
      return 1;
    case kNvmcConfig:
      return nvmc_config_;
    case kDhcsr: {
      const std::uint32_t value =
          (dhcsr_ & 0xFFFF) | kRegisterReady | (halted_ ? kHalted : 0) | (was_reset_ ? kResetSeen : 0);
      was_reset_ = false;
      return value;
    }
    case kDcrdr:
      return core_transfer_;
    case kDemcr:
      return demcr_;
    default:
      break;
  }
  if (const auto found = kept_.find(address); found != kept_.end()) return found->second;
  if (address >= kSystemSpace && address < kSystemEnd) return 0;
  return std::nullopt;
}

bool EmulatedPart::write_register(std::uint32_t address, std::uint32_t value) {
  switch (address) {
    case kNvmcConfig:
      nvmc_config_ = value;
      return true;
    case kNvmcErasePage:
      if (nvmc_config_ != kEraseEnable || value >= kFlashBytes || value % kPageBytes != 0) return false;
      std::fill_n(flash_.begin() + static_cast<std::ptrdiff_t>(value), kPageBytes, std::uint8_t{0xFF});
      ++pages_erased_;
      return true;
    case kNvmcEraseAll:
      if (nvmc_config_ != kEraseEnable) return false;
      mass_erase();
      return true;
    case kNvmcEraseUicr:
      if (nvmc_config_ != kEraseEnable) return false;
      std::fill(uicr_.begin(), uicr_.end(), std::uint8_t{0xFF});
      return true;
    case kDhcsr:
      if (value >> 16 != 0xA05F) return true;  // ignored without the key
      dhcsr_ = value & 0xFFFF;
      halted_ = (value & 1U) != 0 && (value & kHalt) != 0;
      return true;
    case kDcrsr:
      if ((value & (1U << 16)) != 0) {
        core_.at(value & 0x7F) = core_transfer_;
      } else {
        core_transfer_ = core_.at(value & 0x7F);
      }
      return true;
    case kDcrdr:
      core_transfer_ = value;
      return true;
    case kDemcr:
      demcr_ = value;
      return true;
    case kAircr:
      if (value == 0x05FA'0004) reset();
      return true;
    case kDfsr:
      return true;
    default:
      break;
  }
  if (address < kSystemSpace || address >= kSystemEnd) return false;
  kept_[address] = value;
  return true;
}

void EmulatedPart::reset() {
  was_reset_ = true;
  nvmc_config_ = 0;
  core_.fill(0);
  core_.at(kStackPointer) = word_at(flash_, 0);
  core_.at(kProgramCounter) = word_at(flash_, 4) & ~1U;
  halted_ = (demcr_ & kCatchReset) != 0 && (dhcsr_ & 1U) != 0;
  locked_ = (word_at(uicr_, kUicrApprotect) & 0xFF) == 0;
}

void EmulatedPart::mass_erase() {
  std::fill(flash_.begin(), flash_.end(), std::uint8_t{0xFF});
  std::fill(uicr_.begin(), uicr_.end(), std::uint8_t{0xFF});
  ++mass_erases_;
}

std::uint32_t EmulatedPart::read_control(std::uint32_t reg) {
  switch (reg) {
    case kControlReset:
      return control_reset_;
    case kControlEraseStatus:
      return erase_polls_left_ > 0 && erase_polls_left_-- > 0 ? 1 : 0;
    case kControlProtection:
      return locked_ ? 0 : 1;
    case kControlIdentity:
      return 0x0288'0000;
    default:
      return 0;
  }
}

void EmulatedPart::write_control(std::uint32_t reg, std::uint32_t value) {
  if (reg == kControlReset) {
    if (control_reset_ == 1 && value == 0) reset();
    control_reset_ = value;
  } else if (reg == kControlEraseAll && value == 1) {
    mass_erase();
    erase_polls_left_ = 2;
  }
}

}  // namespace groma::provision::test
