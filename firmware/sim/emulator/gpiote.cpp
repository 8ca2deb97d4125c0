#include "firmware/sim/emulator/gpiote.hpp"

#include <string>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

constexpr std::uint32_t kConfig = 0x510;

// CONFIG
constexpr std::uint32_t kModeMask = 3;
constexpr std::uint32_t kModeEvent = 1;
constexpr std::uint32_t kModelled = kModeMask | 0x1FU << 8 | 3U << 16;

}  // namespace

void Gpiote::reset() {
  events_ = EventRegisters{(1U << kChannels) - 1};
  configuration_ = {};
}

void Gpiote::level_changed(unsigned pin, bool high) {
  for (unsigned channel = 0; channel < kChannels; ++channel) {
    const std::uint32_t configuration = configuration_[channel];
    if ((configuration & kModeMask) != kModeEvent || (configuration >> 8 & 0x1FU) != pin) continue;
    // POLARITY: 1 low to high, 2 high to low, 3 both
    const std::uint32_t edges = configuration >> 16 & 3U;
    if ((edges & (high ? 1U : 2U)) != 0) events_.raise(channel);
  }
}

std::optional<std::uint32_t> Gpiote::read(SimTime, std::uint32_t offset) {
  if (offset >= kConfig && offset < kConfig + 4 * kChannels) return configuration_[(offset - kConfig) / 4];
  return events_.read(offset);
}

bool Gpiote::write(SimTime, std::uint32_t offset, std::uint32_t value) {
  if (offset < kConfig || offset >= kConfig + 4 * kChannels) return events_.write(offset, value);
  const std::uint32_t mode = value & kModeMask;
  if ((value & ~kModelled) != 0 || mode > kModeEvent) {
    throw SimulationError("GPIOTE: CONFIG[" + std::to_string((offset - kConfig) / 4) +
                          "] = " + hexadecimal(value) + " is not modelled, only events of edges are");
  }
  configuration_[(offset - kConfig) / 4] = value;
  return true;
}

}  // namespace groma::sim
