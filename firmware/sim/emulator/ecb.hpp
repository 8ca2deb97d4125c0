// ECB (0x4000E000): AES-128 of one block at a time, on 48 bytes of RAM: key, clear block, encrypted block.
#pragma once

#include <array>
#include <cstdint>

#include "firmware/sim/aes.hpp"
#include "firmware/sim/emulator/easy_dma.hpp"
#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Ecb final : public Peripheral {
 public:
  // The run time of a block (product specification 28, ECB, electrical specification).
  static constexpr SimTime kBlockTime = 72 * kUnitsPerMicrosecond / 10;

  explicit Ecb(EasyDma dma) noexcept : dma_(dma) {}

  void reset();
  // As Spim::spoil_start(), for the first byte of the clear block.
  void spoil_start(SimTime t, std::uint8_t bits) noexcept;

  // Number of blocks encrypted.
  [[nodiscard]] std::uint64_t blocks() const noexcept { return blocks_; }
  // Number of them that spoil_start() changed.
  [[nodiscard]] std::uint64_t spoiled_blocks() const noexcept { return spoiled_blocks_; }

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override { return end_at_; }
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

 private:
  static constexpr unsigned kEnd = 0;
  static constexpr unsigned kError = 1;
  static constexpr std::uint32_t kDataBytes = 48;

  [[nodiscard]] bool busy() const noexcept { return end_at_ != kNever; }

  EasyDma dma_;
  Aes aes_;
  EventRegisters events_{0x3};
  std::uint32_t pointer_ = 0;
  SimTime end_at_ = kNever;
  std::uint8_t spoiled_ = 0;              // bits of the clear block's first byte
  std::array<std::uint8_t, 32> taken_{};  // copy of key and clear block at the start
  std::uint64_t blocks_ = 0;
  std::uint64_t spoiled_blocks_ = 0;
};

}  // namespace groma::sim
