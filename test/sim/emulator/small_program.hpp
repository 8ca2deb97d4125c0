// A node that runs a few instructions instead of the shipped image.
#pragma once

#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "firmware/sim/emulator/emulated_node.hpp"
#include "test/sim/emulator/soc_bench.hpp"

namespace groma::sim {

class SmallProgram {
 public:
  using Code = std::vector<std::uint16_t>;
  using Writes = std::vector<std::pair<std::uint32_t, std::uint32_t>>;  // of words: address, value

  // Makes the writes, then continues with `tail`, whose address is kTail.
  SmallProgram(const Writes& writes, const Code& tail, const EmulatorOptions& options) {
    put_word(0, kRamAddress + 0x1000);
    put_word(4, kReset | 1U);
    put(kReset, {
                    0x2001,  // movs r0, #1
                    0x0280,  // lsls r0, r0, #10
                    0xC806,  // ldmia r0!, {r1, r2}
                    0xB109,  // cbz r1, .+6
                    0x600A,  // str r2, [r1]
                    0xE7FB,  // b .-6
                });
    put(kTail, tail);
    std::uint32_t at = kTable;
    for (const auto& [address, value] : writes) {
      put_word(at, address);
      put_word(at + 4, value);
      at += 8;
    }
    put_word(at, 0);
    EmulatorOptions with_device = options;
    with_device.can = &device;
    NodeSpec spec;
    spec.chip.id = 1;
    auto owned = make_emulated_node(spec, image_, network.medium(), with_device);
    node = owned.get();
    network.add(std::move(owned));
  }

  void run_until(double t_s) { network.run_until(from_seconds(t_s)); }
  // The bytes on the line to the host.
  [[nodiscard]] std::vector<std::uint8_t> sent() {
    std::vector<TimedByte> timed;
    network.take(0, timed);
    std::vector<std::uint8_t> bytes;
    bytes.reserve(timed.size());
    for (const TimedByte& byte : timed) bytes.push_back(byte.value);
    return bytes;
  }

  PatternDevice device;  // on SPIM1
  DistanceTable space;
  Network network{space, {}, 1};
  EmulatedNode* node = nullptr;

 private:
  static constexpr std::uint32_t kReset = 0x200;
  static constexpr std::uint32_t kTail = kReset + 12;
  static constexpr std::uint32_t kTable = 0x400;

  void put(std::uint32_t address, const Code& code) {
    for (const std::uint16_t half : code) {
      image_.flash[address++] = static_cast<std::uint8_t>(half);
      image_.flash[address++] = static_cast<std::uint8_t>(half >> 8);
    }
  }
  void put_word(std::uint32_t address, std::uint32_t word) {
    put(address, {static_cast<std::uint16_t>(word), static_cast<std::uint16_t>(word >> 16)});
  }

  FirmwareImage image_;
};

}  // namespace groma::sim
