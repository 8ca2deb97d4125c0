#include "firmware/sim/emulator/radio_device.hpp"

#include <algorithm>

namespace groma::sim {

void RadioDevice::transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                           std::uint32_t hz) {
  if (held_) {
    std::fill(miso.begin(), miso.end(), std::uint8_t{0});
    return;
  }
  chip_.transfer(end, mosi, miso, hz);
}

void RadioDevice::hold_in_reset(SimTime t) {
  held_ = true;
  chip_.reset(t);
}

void RadioDevice::release_reset(SimTime t) {
  held_ = false;
  chip_.reset(t);
}

}  // namespace groma::sim
