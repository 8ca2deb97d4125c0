// NOR flash like the nRF52832's: a write only clears bits of a 32-bit word; an erase sets a page to all ones.
// The model measures how long its operations halt the processor, counts wear, and can lose power during a
// chosen operation.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "firmware/sim/time.hpp"

namespace groma::sim {

class NorFlash {
 public:
  static constexpr std::uint32_t kPageBytes = 4096;
  // The nRF52832's longest times.
  static constexpr SimTime kEraseTime = 897 * kUnitsPerMillisecond / 10;
  static constexpr SimTime kWriteTime = 338 * kUnitsPerMicrosecond;
  // The nRF52832's limit of writes to a block of 512 bytes between two erases (nWRITE,BLOCK).
  static constexpr std::uint32_t kBlockBytes = 512;
  static constexpr std::uint32_t kMaxWritesPerBlock = 181;

  // The result of an operation that a power loss interrupts.
  enum class Tear : std::uint8_t {
    kNothing,     // not begun
    kEverything,  // complete
    kHalf,        // a word's low half is written; a page's first half is erased
    kSomeBits,    // the seed decides which of the bits to change have changed
    kAnyBits,     // erase: the seed decides every bit of the page. Write: as kSomeBits
  };
  static constexpr Tear kTears[] = {Tear::kNothing, Tear::kEverything, Tear::kHalf, Tear::kSomeBits,
                                    Tear::kAnyBits};

  explicit NorFlash(std::size_t pages) : words_(pages * kPageBytes / 4, 0xFFFFFFFF), wear_(pages) {}

  // The interface storage::Flash. False without power, or if the page or word does not exist.
  bool erase(std::size_t page) noexcept;
  bool write(std::uint32_t offset, std::uint32_t word) noexcept;
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept;

  // The power fails during operation number `operation`; the next operation is number 0.
  void cut_power_at(std::uint64_t operation, Tear tear, std::uint64_t seed) noexcept;
  [[nodiscard]] bool powered() const noexcept { return powered_; }
  // Restores power and cancels a cut that has not happened yet.
  void power_on() noexcept;

  // Writes and erases begun since construction.
  [[nodiscard]] std::uint64_t operations() const noexcept { return operations_; }
  [[nodiscard]] std::uint64_t erases(std::size_t page) const noexcept { return wear_[page].erases; }
  // The highest number of writes to a block between two erases.
  [[nodiscard]] std::uint32_t most_writes_in_a_block() const noexcept { return most_writes_; }
  // Writes to words that were not erased, interrupted writes included.
  [[nodiscard]] std::uint64_t overwrites() const noexcept { return overwrites_; }
  // The total duration of all operations.
  [[nodiscard]] SimTime busy_time() const noexcept { return busy_time_; }

 private:
  static constexpr std::size_t kBlocks = kPageBytes / kBlockBytes;
  struct Wear {
    std::uint64_t erases = 0;
    std::uint32_t writes[kBlocks] = {};
  };

  // True: the power fails during this operation.
  bool begin(SimTime duration) noexcept;

  std::vector<std::uint32_t> words_;
  std::vector<Wear> wear_;
  std::uint64_t operations_ = 0;
  std::uint32_t most_writes_ = 0;
  std::uint64_t overwrites_ = 0;
  SimTime busy_time_ = 0;
  bool powered_ = true;
  std::uint64_t cut_at_ = ~std::uint64_t{0};
  Tear tear_ = Tear::kNothing;
  std::uint64_t seed_ = 0;
};

}  // namespace groma::sim
