#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>

namespace groma::storage {

inline constexpr std::size_t kPages = 2;
inline constexpr std::uint32_t kPageBytes = 4096;
inline constexpr std::uint32_t kErasedWord = 0xFFFFFFFF;

// Two pages of NOR flash. Offsets are in bytes from the start of the first page, multiples of 4.
// - erase(page): sets all bits of page 0 or 1; returns false on failure
// - write(offset, word): clears the bits that are 0 in `word`; returns false on failure
// - read(offset)
//
// A power cut during an erase leaves any bits in the page. A power cut during a write leaves any of the bits
// to be cleared uncleared.
template <class F>
concept Flash = requires(F& flash, const F& unchanged, std::size_t page, std::uint32_t offset,
                         std::uint32_t word) {
  { flash.erase(page) }
  noexcept->std::same_as<bool>;
  { flash.write(offset, word) }
  noexcept->std::same_as<bool>;
  { unchanged.read(offset) }
  noexcept->std::same_as<std::uint32_t>;
};

}  // namespace groma::storage
