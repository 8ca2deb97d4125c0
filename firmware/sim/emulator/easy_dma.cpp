#include "firmware/sim/emulator/easy_dma.hpp"

#include <string>

#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/peripheral.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

constexpr std::uint32_t kMaximumCount = 255;

enum : std::uint32_t {
  kRxdPtr = 0x534,
  kRxdMaxcnt = 0x538,
  kRxdAmount = 0x53C,
  kTxdPtr = 0x544,
  kTxdMaxcnt = 0x548,
  kTxdAmount = 0x54C,
};

}  // namespace

std::span<std::uint8_t> EasyDma::at(std::uint32_t address, std::uint32_t count, const char* name) const {
  if (count > kMaximumCount) {
    throw SimulationError(std::string(name) + ".MAXCNT is " + std::to_string(count) +
                          ": EasyDMA moves at most 255 bytes");
  }
  if (count == 0) return {};
  if (address < kRamAddress || address - kRamAddress > ram_.size() ||
      count > ram_.size() - (address - kRamAddress)) {
    throw SimulationError(std::string(name) + ".PTR: " + std::to_string(count) + " bytes at " +
                          hexadecimal(address) + " are not in RAM, the only memory that EasyDMA reaches");
  }
  return ram_.subspan(address - kRamAddress, count);
}

std::optional<std::uint32_t> DmaRegisters::read(std::uint32_t offset) const noexcept {
  switch (offset) {
    case kRxdPtr:
      return receive.pointer;
    case kRxdMaxcnt:
      return receive.maximum;
    case kRxdAmount:
      return receive.amount;
    case kTxdPtr:
      return transmit.pointer;
    case kTxdMaxcnt:
      return transmit.maximum;
    case kTxdAmount:
      return transmit.amount;
    default:
      return std::nullopt;
  }
}

bool DmaRegisters::write(std::uint32_t offset, std::uint32_t value) noexcept {
  switch (offset) {
    case kRxdPtr:
      receive.pointer = value;
      return true;
    case kRxdMaxcnt:
      receive.maximum = value;
      return true;
    case kTxdPtr:
      transmit.pointer = value;
      return true;
    case kTxdMaxcnt:
      transmit.maximum = value;
      return true;
    default:
      return false;
  }
}

}  // namespace groma::sim
