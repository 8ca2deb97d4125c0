// NOR flash as the nRF52832's: 32-bit words whose bits a write only clears, pages that an erase sets to all
// ones. It tells how long the processor stood still for it, counts its wear, and loses power at a chosen
// operation.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "firmware/sim/time.hpp"

namespace groma::sim {

class NorFlash {
 public:
  static constexpr std::uint32_t kPageBytes = 4096;
  static constexpr SimTime kEraseTime = 85 * kUnitsPerMillisecond;
  static constexpr SimTime kWriteTime = 41 * kUnitsPerMicrosecond;
  // Writes to a block of 512 bytes between two erases that the nRF52832 bears (nWRITE,BLOCK).
  static constexpr std::uint32_t kBlockBytes = 512;
  static constexpr std::uint32_t kMaxWritesPerBlock = 181;

  // What an operation leaves behind when the power goes in the middle of it.
  enum class Tear : std::uint8_t {
    kNothing,     // it had not begun
    kEverything,  // it was just done
    kHalf,        // a word's low half written; a page's first half erased
    kSomeBits,    // each bit that was to change has or has not, by the seed
    kAnyBits,     // an erased page: every bit by the seed. A word: as kSomeBits
  };
  static constexpr Tear kTears[] = {Tear::kNothing, Tear::kEverything, Tear::kHalf, Tear::kSomeBits,
                                    Tear::kAnyBits};

  explicit NorFlash(std::size_t pages) : words_(pages * kPageBytes / 4, 0xFFFFFFFF), wear_(pages) {}

  // As storage::Flash says. False without power, or where the page or word does not exist.
  bool erase(std::size_t page) noexcept;
  bool write(std::uint32_t offset, std::uint32_t word) noexcept;
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept;

  // The power goes in the midst of operation number `operation`, counted from 0 with the next one.
  void cut_power_at(std::uint64_t operation, Tear tear, std::uint64_t seed) noexcept;
  [[nodiscard]] bool powered() const noexcept { return powered_; }
  // Power back; a cut not yet reached is forgotten.
  void power_on() noexcept;

  // Writes and erases begun since construction.
  [[nodiscard]] std::uint64_t operations() const noexcept { return operations_; }
  [[nodiscard]] std::uint64_t erases(std::size_t page) const noexcept { return wear_[page].erases; }
  // The most that any block has seen between two erases.
  [[nodiscard]] std::uint32_t most_writes_in_a_block() const noexcept { return most_writes_; }
  // Writes to words that were not erased, torn ones among them.
  [[nodiscard]] std::uint64_t overwrites() const noexcept { return overwrites_; }
  // Time that all of it has taken.
  [[nodiscard]] SimTime busy_time() const noexcept { return busy_time_; }

 private:
  static constexpr std::size_t kBlocks = kPageBytes / kBlockBytes;
  struct Wear {
    std::uint64_t erases = 0;
    std::uint32_t writes[kBlocks] = {};
  };

  // True where the power goes in this one.
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
