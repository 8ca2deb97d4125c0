#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>

namespace groma::storage {

inline constexpr std::size_t kPages = 2;
inline constexpr std::uint32_t kPageBytes = 4096;
inline constexpr std::uint32_t kErasedWord = 0xFFFFFFFF;

// Two pages of NOR flash. Offsets are in bytes from the start of the first, multiples of 4.
// - erase(page): sets all bits of page 0 or 1; false: not done
// - write(offset, word): clears the bits that are 0 in `word`; false: not done
// - read(offset)
// A power cut in the middle leaves a page with any bits, or a word with any of its bits cleared that were to
// be.
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
