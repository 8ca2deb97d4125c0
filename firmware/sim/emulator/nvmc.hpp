// NVMC (0x4001E000): flash and UICR as the firmware may change them.
//
// A write clears bits and never sets one; an erase sets a whole page. Both take their time, in which the
// processor stands still, and take effect at its end. Where power goes amid one, the first part is done: of a
// word its lower half once half of the time has passed; of a page that share of its words.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Nvmc final : public Peripheral {
 public:
  // Product specification 11.4, electrical specification.
  static constexpr SimTime kEraseTime = 85 * kUnitsPerMillisecond;
  static constexpr SimTime kWriteTime = 41 * kUnitsPerMicrosecond;
  // Writes to a block that it bears between two erases (nWRITE,BLOCK); one more fails the run.
  static constexpr std::uint32_t kBlockBytes = 512;
  static constexpr std::uint8_t kMostWrites = 181;

  // `stall`: halts the processor for that long. `changed`: these bytes of the flash are no longer what they
  // were.
  using Stall = std::function<void(SimTime duration)>;
  using Changed = std::function<void(std::uint32_t address, std::uint32_t bytes)>;
  Nvmc(std::span<std::uint8_t> flash, std::span<std::uint8_t> uicr, Stall stall, Changed changed);

  // What is under way is finished: resets wait for it.
  void reset();
  // Power is gone at t, and with it what is under way.
  void power_cut(SimTime t);

  // A store to flash or UICR. False: a bus fault, since it is not enabled, or no aligned word.
  [[nodiscard]] bool store(SimTime t, std::uint32_t address, unsigned bytes, std::uint32_t value);

  [[nodiscard]] bool busy() const noexcept { return end_at_ != kNever; }
  // Writes of words and erases of pages that were begun.
  [[nodiscard]] std::uint64_t operations() const noexcept { return operations_; }

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override { return end_at_; }
  void advance(SimTime t) override;

 private:
  void begin(SimTime t, SimTime duration);
  // The four bytes there; empty where neither memory has them.
  [[nodiscard]] std::span<std::uint8_t> word(std::uint32_t address) const;
  // The operation as far as it came: `share` of 4096.
  void apply(std::uint32_t share);

  std::span<std::uint8_t> flash_;
  std::span<std::uint8_t> uicr_;
  std::vector<std::uint8_t> writes_;  // to each block of the flash since its erase
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
