// An nRF52832 as seen by a debugger: flash and UICR with the NVMC, the core's halt and reset, and the
// CTRL-AP that unlocks it. It runs no program. Register names and addresses: nRF52832 product specification
// (NVMC, UICR, FICR, CTRL-AP) and the ARMv7-M architecture reference manual (C1, debug).
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <limits>
#include <map>
#include <optional>
#include <vector>

namespace groma::provision::test {

class EmulatedPart {
 public:
  static constexpr std::uint32_t kFlashBytes = 512 * 1024;

  EmulatedPart();

  // The state after UICR.APPROTECT was written and a reset.
  void lock();
  [[nodiscard]] bool locked() const noexcept { return locked_; }
  // Writes to this word of flash have no effect.
  void break_flash_at(std::uint32_t address) { broken_ = address; }

  // One access of the memory access port to an aligned word; `lanes` masks the bytes to write. Nothing or
  // false: a bus fault.
  [[nodiscard]] std::optional<std::uint32_t> read(std::uint32_t address);
  [[nodiscard]] bool write(std::uint32_t address, std::uint32_t value, std::uint32_t lanes);

  // CTRL-AP.
  [[nodiscard]] std::uint32_t read_control(std::uint32_t reg);
  void write_control(std::uint32_t reg, std::uint32_t value);

  [[nodiscard]] const std::vector<std::uint8_t>& flash() const noexcept { return flash_; }
  [[nodiscard]] bool halted() const noexcept { return halted_; }
  // Numbers of page erases, mass erases and words so far; these may be read while a debugger works.
  [[nodiscard]] int pages_erased() const noexcept { return pages_erased_; }
  [[nodiscard]] int mass_erases() const noexcept { return mass_erases_; }
  [[nodiscard]] int words_written() const noexcept { return words_written_; }
  // Blocks the debugger once this many words are written, until a larger number is set.
  void hold_at(int words) noexcept { hold_at_ = words; }

 private:
  void reset();
  void mass_erase();
  [[nodiscard]] bool write_flash(std::vector<std::uint8_t>& memory, std::uint32_t offset,
                                 std::uint32_t value);
  [[nodiscard]] std::optional<std::uint32_t> read_register(std::uint32_t address);
  [[nodiscard]] bool write_register(std::uint32_t address, std::uint32_t value);

  std::vector<std::uint8_t> flash_;
  std::vector<std::uint8_t> uicr_;
  std::vector<std::uint8_t> ram_;
  std::map<std::uint32_t, std::uint32_t> kept_;  // registers without side effects
  std::array<std::uint32_t, 128> core_{};        // by DCRSR.REGSEL
  std::uint32_t core_transfer_ = 0;              // DCRDR
  std::uint32_t nvmc_config_ = 0;
  std::uint32_t dhcsr_ = 0;
  std::uint32_t demcr_ = 0;
  bool halted_ = false;
  bool was_reset_ = true;
  bool locked_ = false;
  std::uint32_t control_reset_ = 0;
  int erase_polls_left_ = 0;
  std::optional<std::uint32_t> broken_;
  std::atomic<int> pages_erased_ = 0;
  std::atomic<int> mass_erases_ = 0;
  std::atomic<int> words_written_ = 0;
  std::atomic<int> hold_at_ = std::numeric_limits<int>::max();
};

}  // namespace groma::provision::test
