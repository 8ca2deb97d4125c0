#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/storage/record_store.hpp"

namespace groma::storage {

// A counter that never gives a value twice, whatever resets and power cuts come between: it keeps in flash
// where the values that may have been given end, and reserves a block ahead. The values of a block that a
// reset cut short are lost. At some 250 boots an erase and 10^4 erases a page, flash bears 5 million boots.
template <Flash F>
class Counter {
 public:
  static constexpr std::uint64_t kBlock = 1U << 16;

  explicit Counter(F& flash) noexcept : records_(flash) {}

  // Once while booting, for it may take an erase: reserves the first block. Its number, 1 for the first ever,
  // is the boot's own; 0: the flash failed.
  std::uint32_t open_block() noexcept { return reserve() ? static_cast<std::uint32_t>(end_ / kBlock) : 0; }

  // Writes to flash where no block is open or it is used up. Nothing: the flash failed; no value may be used.
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
