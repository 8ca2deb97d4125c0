#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/storage/record_store.hpp"

namespace groma::storage {

// A counter that never returns a value twice, in spite of resets and power cuts. It stores in flash the end
// of the values that may have been returned, and reserves a block in advance. A reset discards the rest of a
// block. At about 250 boots per erase and 10^4 erases per page, flash lasts for 5 million boots.
template <Flash F>
class Counter {
 public:
  static constexpr std::uint64_t kBlock = 1U << 16;

  explicit Counter(F& flash) noexcept : records_(flash) {}

  // Call once while booting, because it may take an erase: reserves the first block. Returns the block's
  // number as the number of this boot, 1 for the first ever; 0: the flash failed.
  std::uint32_t open_block() noexcept { return reserve() ? static_cast<std::uint32_t>(end_ / kBlock) : 0; }

  // Writes to flash if no block is open or the block is used up. Nothing: the flash failed, and no value may
  // be used.
  [[nodiscard]] std::optional<std::uint64_t> next() noexcept {
    if (next_ == end_ && !reserve()) return std::nullopt;
    return next_++;
  }

 private:
  bool reserve() noexcept {
    std::array<std::uint8_t, 8> bytes{};
    std::uint64_t end = 0;
    if (records_.load(Key::kCounter, bytes) == bytes.size()) {
      for (std::size_t i = 0; i < bytes.size(); ++i) end |= std::uint64_t{bytes[i]} << (8 * i);
    }
    const std::uint64_t start = end;
    end += kBlock;
    for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::uint8_t>(end >> (8 * i));
    if (!records_.store(Key::kCounter, bytes)) return false;
    next_ = start;
    end_ = end;
    return true;
  }

  RecordStore<F> records_;
  std::uint64_t next_ = 0;
  std::uint64_t end_ = 0;
};

}  // namespace groma::storage
