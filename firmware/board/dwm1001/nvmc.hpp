// The two flash pages that hold the configuration, 0x7E000 to the end.
#pragma once

#include <cstddef>
#include <cstdint>

#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001 {

// Offsets count from the first of the two pages. The processor stands still while the flash works: 85 ms for
// a page's erase, 338 us for a word (nRF52832 PS v1.4, 11.2).
class Nvmc {
 public:
  static constexpr std::size_t kPages = 2;
  static constexpr std::uint32_t kPageBytes = 4096;

  // True if the page reads as erased, or the word as written, afterwards.
  bool erase(std::size_t page) noexcept;
  bool write(std::uint32_t offset, std::uint32_t word) noexcept;
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept;
};

// A word of flash or of UICR: its bits can only be cleared.
void write_flash_word(nrf52832::Register& word, std::uint32_t value) noexcept;

}  // namespace groma::dwm1001
