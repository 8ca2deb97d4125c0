// A CAN controller with its driver and link on a bus, as on the board, without the node.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "firmware/core/node/can_link.hpp"
#include "firmware/sim/can_bus.hpp"
#include "firmware/sim/mcp2518fd_chip.hpp"

namespace groma::sim::test {

// The SPI between processor and controller. Each transfer advances the module's time.
class TimedSpi {
 public:
  static constexpr std::uint32_t kClock_hz = 8'000'000;
  static constexpr SimTime kOverhead = 3 * kUnitsPerMicrosecond;  // chip select, DMA, end of transfer

  TimedSpi(Mcp2518fdChip& chip, SimTime& now) : chip_(chip), now_(now) {}

  void transfer(std::span<std::uint8_t> inout) noexcept {
    now_ += kOverhead + static_cast<SimTime>(inout.size()) * 8 * kUnitsPerSecond / kClock_hz;
    const std::vector<std::uint8_t> mosi(inout.begin(), inout.end());
    chip_.transfer(now_, mosi, inout, hz);
    ++transfers;
    bytes += inout.size();
  }

  std::uint32_t hz = kClock_hz;
  std::size_t transfers = 0;
  std::size_t bytes = 0;

 private:
  Mcp2518fdChip& chip_;
  SimTime& now_;
};

struct CanModule {
  explicit CanModule(CanBus& bus, const Mcp2518fdSpec& spec = {})
      : chip(bus, spec), spi(chip, now), link(spi) {
    chip.set_power(true, 0);
  }

  mcp2518fd::BringUp start(const mcp2518fd::Settings& settings) {
    return link.start(settings, now_us(), [this](std::uint32_t us) { wait(us); });
  }

  // Runs up to `t`, or longer until the current work is done.
  void run(SimTime t) {
    while (now < t) {
      chip.advance(now);
      while (service()) {
      }
      if (now >= t) break;
      SimTime next = std::min(t, chip.next_event());
      const std::uint64_t deadline_us = link.next_deadline_us();
      if (deadline_us < 1'000'000'000) {
        next = std::min(next, static_cast<SimTime>(deadline_us) * kUnitsPerMicrosecond);
      }
      now = std::max(now + kUnitsPerMicrosecond, next);
    }
    chip.advance(now);
  }

  bool service() {
    const SimTime begin = now;
    const std::size_t bytes = spi.bytes;
    const std::size_t transfers = spi.transfers;
    const bool more = link.service(
        chip.irq(), now_us(),
        [this](std::span<const std::uint8_t> in) { received.insert(received.end(), in.begin(), in.end()); },
        [this](std::uint32_t us) { wait(us); });
    longest_step = std::max(longest_step, now - begin);
    most_bytes = std::max(most_bytes, spi.bytes - bytes);
    most_transfers = std::max(most_transfers, spi.transfers - transfers);
    return more;
  }

  void wait(std::uint32_t us) { now += SimTime{us} * kUnitsPerMicrosecond; }
  [[nodiscard]] std::uint64_t now_us() const {
    return static_cast<std::uint64_t>(now / kUnitsPerMicrosecond);
  }

  SimTime now = 0;
  Mcp2518fdChip chip;
  TimedSpi spi;
  node::CanLink<TimedSpi> link;
  std::vector<std::uint8_t> received;
  SimTime longest_step = 0;
  std::size_t most_bytes = 0;
  std::size_t most_transfers = 0;
};

// Runs all modules in steps, so that none is ahead of the others by more than `step`.
inline void run_all(std::span<CanModule* const> modules, SimTime until,
                    SimTime step = 50 * kUnitsPerMicrosecond) {
  SimTime t = until;
  for (const CanModule* module : modules) t = std::min(t, module->now);
  for (; t < until; t += step) {
    for (CanModule* module : modules) module->run(std::min(t + step, until));
  }
}

inline wire::CanFrame frame_of(std::uint32_t id, std::size_t size, wire::CanFormat format,
                               std::uint8_t fill = 0x55) {
  wire::CanFrame frame;
  frame.id = id;
  frame.format = format;
  frame.bit_rate_switch = format == wire::CanFormat::kFd;
  frame.size = static_cast<std::uint8_t>(size);
  frame.data.fill(fill);
  return frame;
}

}  // namespace groma::sim::test
