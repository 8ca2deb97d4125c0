#include "firmware/sim/emulator/nvmc.hpp"

#include <algorithm>
#include <string>
#include <utility>

#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kReady = 0x400,
  kConfig = 0x504,
  kErasepage = 0x508,
  kIcachecnf = 0x540,
};

constexpr std::uint32_t kWriteEnabled = 1;
constexpr std::uint32_t kEraseEnabled = 2;
constexpr std::uint32_t kWhole = 4096;

}  // namespace

Nvmc::Nvmc(std::span<std::uint8_t> flash, std::span<std::uint8_t> uicr, Stall stall, Changed changed)
    : flash_(flash),
      uicr_(uicr),
      writes_(flash.size() / kBlockBytes),
      stall_(std::move(stall)),
      changed_(std::move(changed)) {}

void Nvmc::reset() {
  if (busy()) advance(end_at_);
  mode_ = 0;
  cache_ = 0;
}

void Nvmc::power_cut(SimTime t) {
  mode_ = 0;
  cache_ = 0;
  if (!busy()) return;
  const SimTime end = std::exchange(end_at_, kNever);
  if (t <= begun_at_) return;
  const SimTime done = std::min(t, end) - begun_at_;
  apply(static_cast<std::uint32_t>(done * static_cast<SimTime>(kWhole) / (end - begun_at_)));
}

void Nvmc::begin(SimTime t, SimTime duration) {
  if (busy()) throw SimulationError("NVMC: an operation while another is in progress");
  begun_at_ = t;
  end_at_ = t + duration;
  ++operations_;
  stall_(duration);
}

std::span<std::uint8_t> Nvmc::word(std::uint32_t address) const {
  if (address + 4 <= flash_.size()) return flash_.subspan(address, 4);
  if (address >= kUicrAddress && address - kUicrAddress + 4 <= uicr_.size())
    return uicr_.subspan(address - kUicrAddress, 4);
  return {};
}

void Nvmc::apply(std::uint32_t share) {
  if (erasing_) {
    const std::uint32_t bytes = kFlashPageBytes * share / kWhole & ~3U;
    std::fill_n(flash_.begin() + static_cast<std::ptrdiff_t>(address_), bytes, std::uint8_t{0xFF});
  } else {
    const unsigned bytes = share == kWhole ? 4 : share >= kWhole / 2 ? 2 : 0;
    const std::span<std::uint8_t> cells = word(address_);
    for (unsigned i = 0; i < bytes; ++i) cells[i] &= static_cast<std::uint8_t>(value_ >> (8 * i));
  }
  if (address_ < flash_.size()) changed_(address_, erasing_ ? kFlashPageBytes : 4);
}

void Nvmc::advance(SimTime t) {
  if (end_at_ > t) return;
  end_at_ = kNever;
  apply(kWhole);
}

bool Nvmc::store(SimTime t, std::uint32_t address, unsigned bytes, std::uint32_t value) {
  if (mode_ != kWriteEnabled || bytes != 4 || address % 4 != 0 || word(address).empty()) return false;
  if (address < flash_.size() && ++writes_[address / kBlockBytes] > kMostWrites) {
    throw SimulationError("NVMC: more than " + std::to_string(kMostWrites) +
                          " writes to a block of 512 bytes without an erase");
  }
  erasing_ = false;
  address_ = address;
  value_ = value;
  begin(t, kWriteTime);
  return true;
}

std::optional<std::uint32_t> Nvmc::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kReady:
      return busy() ? 0 : 1;
    case kConfig:
      return mode_;
    case kIcachecnf:
      return cache_;
    default:
      return std::nullopt;
  }
}

bool Nvmc::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kConfig:
      if (value > kEraseEnabled) throw SimulationError("NVMC: CONFIG " + hexadecimal(value));
      mode_ = value;
      return true;
    case kErasepage:
      if (mode_ != kEraseEnabled) throw SimulationError("NVMC: ERASEPAGE while erasing is not enabled");
      if (value % kFlashPageBytes != 0 || value >= flash_.size())
        throw SimulationError("NVMC: ERASEPAGE of " + hexadecimal(value) + ", not the start of a page");
      erasing_ = true;
      address_ = value;
      std::fill_n(writes_.begin() + static_cast<std::ptrdiff_t>(value / kBlockBytes),
                  kFlashPageBytes / kBlockBytes, std::uint8_t{0});
      begin(t, kEraseTime);
      return true;
    case kIcachecnf:
      // The cache would only change timing; its profiling is not modelled.
      if (value > 1) throw SimulationError("NVMC: ICACHECNF " + hexadecimal(value) + " is not modelled");
      cache_ = value;
      return true;
    default:
      return false;
  }
}

}  // namespace groma::sim
