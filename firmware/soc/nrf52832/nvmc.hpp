// The two flash pages for the configuration, from 0x7E000 to the end.
#pragma once

#include <cstddef>
#include <cstdint>

#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {

// Offsets are from the start of the first page. An operation halts the processor: at most 89.7 ms for the
// erase of a page, 338 us for a word.
class Nvmc {
 public:
  static constexpr std::size_t kPages = 2;
  static constexpr std::uint32_t kPageBytes = 4096;

  // True if the page then reads as erased, or the word as written.
  bool erase(std::size_t page) noexcept;
  bool write(std::uint32_t offset, std::uint32_t word) noexcept;
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept;
};

// Writes a word of flash or UICR; a write can only clear bits.
void write_flash_word(Register& word, std::uint32_t value) noexcept;

}  // namespace groma::nrf52832
