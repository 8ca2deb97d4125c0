#include "firmware/sim/emulator/easy_dma.hpp"

#include <string>

#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/peripheral.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

constexpr std::uint32_t kMaximumCount = 255;

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

}  // namespace groma::sim
