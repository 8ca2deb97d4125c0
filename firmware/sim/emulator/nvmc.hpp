// NVMC (0x4001E000): the firmware's writes and erases of flash and UICR.
//
// A write only clears bits; an erase sets a whole page to ones. Both halt the processor for their duration
// and take effect at its end. A power cut during an operation leaves it partly done: a word's lower half is
// written after half of the time; the share of a page's words that is erased equals the share of the time.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Nvmc final : public Peripheral {
 public:
  // The longest times in the product specification (docs/explanation/silicon.md, flash times).
  static constexpr SimTime kEraseTime = 897 * kUnitsPerMillisecond / 10;
  static constexpr SimTime kWriteTime = 338 * kUnitsPerMicrosecond;
  // The limit of writes to a block between two erases (nWRITE,BLOCK); one more fails the run.
  static constexpr std::uint32_t kBlockBytes = 512;
  static constexpr std::uint8_t kMostWrites = 181;

  // `stall`: halts the processor for a duration. `changed`: reports that these bytes of the flash changed.
  using Stall = std::function<void(SimTime duration)>;
  using Changed = std::function<void(std::uint32_t address, std::uint32_t bytes)>;
  Nvmc(std::span<std::uint8_t> flash, std::span<std::uint8_t> uicr, Stall stall, Changed changed);

  // Completes a pending operation: resets wait for it.
  void reset();
  // Power fails at t, which interrupts a pending operation.
  void power_cut(SimTime t);

  // A store to flash or UICR. False: a bus fault, since writing is not enabled or the store is not an aligned
  // word.
  [[nodiscard]] bool store(SimTime t, std::uint32_t address, unsigned bytes, std::uint32_t value);

  [[nodiscard]] bool busy() const noexcept { return end_at_ != kNever; }
  // Number of word writes and page erases begun.
  [[nodiscard]] std::uint64_t operations() const noexcept { return operations_; }

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override { return end_at_; }
  void advance(SimTime t) override;

 private:
  void begin(SimTime t, SimTime duration);
  // The four bytes at the address; empty if neither memory has them.
  [[nodiscard]] std::span<std::uint8_t> word(std::uint32_t address) const;
  // Applies the operation's first `share` of 4096 parts.
  void apply(std::uint32_t share);

  std::span<std::uint8_t> flash_;
  std::span<std::uint8_t> uicr_;
  std::vector<std::uint8_t> writes_;  // number of writes to each block of the flash since its erase
  Stall stall_;
  Changed changed_;
  std::uint32_t mode_ = 0;  // CONFIG
  std::uint32_t cache_ = 0;

  SimTime begun_at_ = 0;
  SimTime end_at_ = kNever;
  bool erasing_ = false;
  std::uint32_t address_ = 0;
  std::uint32_t value_ = 0;
  std::uint64_t operations_ = 0;
};

}  // namespace groma::sim
