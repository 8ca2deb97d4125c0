// Unicorn 2.0's ARM engine configured as a Cortex-M4, with functions to change its state from outside.
#pragma once

#include <unicorn/unicorn.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/sim/emulator/nvic.hpp"

namespace groma::sim {

// Unicorn's numbers for r0 to r15, which are not consecutive.
[[nodiscard]] constexpr int core_register(unsigned index) noexcept {
  constexpr std::array kHigh{UC_ARM_REG_R13, UC_ARM_REG_R14, UC_ARM_REG_R15};
  return index < 13 ? UC_ARM_REG_R0 + static_cast<int>(index) : static_cast<int>(kHigh[(index - 13) % 3]);
}

class UnicornEngine {
 public:
  // Throws SimulationError.
  UnicornEngine();
  UnicornEngine(const UnicornEngine&) = delete;
  UnicornEngine& operator=(const UnicornEngine&) = delete;
  ~UnicornEngine();

  // Maps memory as readable, with the additional permissions. Stores go only to hooks of
  // UC_HOOK_MEM_WRITE_PROT, which have to perform them.
  void map_read_only(std::uint32_t address, std::span<std::uint8_t> memory, unsigned permissions);
  // The callbacks get offsets from `address`.
  void map_io(std::uint32_t address, std::size_t bytes, uc_cb_mmio_read_t on_read,
              uc_cb_mmio_write_t on_write, void* user);
  // For addresses from `begin` to `end` inclusive; all addresses if end < begin. Throws SimulationError.
  void add_hook(int type, void* callback, void* user, std::uint64_t begin = 1, std::uint64_t end = 0);
  // Discards the translated code there. Not while the engine runs.
  void drop_code(std::uint32_t begin, std::uint32_t end);

  // Runs from `pc`, whose bit 0 is the T bit, until stop() or an event.
  uc_err start(std::uint32_t pc) { return uc_emu_start(engine_, pc, 0, 0, 0); }
  // From within a callback.
  void stop() { uc_emu_stop(engine_); }

  [[nodiscard]] std::uint32_t read(int which) const;
  void write(int which, std::uint32_t value);
  // R0 to R15.
  [[nodiscard]] std::array<std::uint32_t, 16> core_registers() const;

  [[nodiscard]] std::uint32_t xpsr() const { return read(UC_ARM_REG_XPSR); }
  // Switches the stack if the mode changes.
  void set_xpsr(std::uint32_t value);
  [[nodiscard]] bool unprivileged() const;
  [[nodiscard]] ExceptionMasks masks();
  // As exception entry does (B1.5.6): from any mode to handler mode, on the main stack.
  void enter_handler(unsigned exception, bool thumb);
  // As exception return does: from handler mode to thread mode, with these bits of CONTROL (nPRIV is kept).
  void leave_to_thread(bool process_stack, bool floating_point);
  void set_floating_point_active(bool on);  // CONTROL.FPCA, in handler mode
  void reset();

 private:
  uc_engine* engine_ = nullptr;
};

}  // namespace groma::sim
