// The system control space, 0xE000E000 to 0xE000EFFF: control block, NVIC and SysTick registers, FPU control.
// ARMv7-M Architecture Reference Manual (DDI 0403E), B3.2 to B3.4. No MPU, no debug.
#pragma once

#include <cstdint>

#include "firmware/sim/emulator/nvic.hpp"
#include "firmware/sim/emulator/sys_tick.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

// Bits of CFSR (B3.2.15).
namespace fault_status {
inline constexpr std::uint32_t kInstructionAccess = 1U << 0;  // MMFSR.IACCVIOL
inline constexpr std::uint32_t kInstructionBus = 1U << 8;     // BFSR.IBUSERR
inline constexpr std::uint32_t kPreciseData = 1U << 9;        // BFSR.PRECISERR
inline constexpr std::uint32_t kUnstacking = 1U << 11;        // BFSR.UNSTKERR
inline constexpr std::uint32_t kStacking = 1U << 12;          // BFSR.STKERR
inline constexpr std::uint32_t kBusAddressValid = 1U << 15;   // BFSR.BFARVALID
inline constexpr std::uint32_t kUndefined = 1U << 16;         // UFSR.UNDEFINSTR
inline constexpr std::uint32_t kInvalidState = 1U << 17;      // UFSR.INVSTATE
inline constexpr std::uint32_t kInvalidReturn = 1U << 18;     // UFSR.INVPC
inline constexpr std::uint32_t kNoCoprocessor = 1U << 19;     // UFSR.NOCP
inline constexpr std::uint32_t kDivideByZero = 1U << 25;      // UFSR.DIVBYZERO
}  // namespace fault_status

// Bits of HFSR (B3.2.16).
namespace hard_fault_status {
inline constexpr std::uint32_t kVectorTable = 1U << 1;
inline constexpr std::uint32_t kForced = 1U << 30;
inline constexpr std::uint32_t kDebugEvent = 1U << 31;
}  // namespace hard_fault_status

class SystemControl {
 public:
  // Keeps both references.
  SystemControl(Nvic& nvic, SysTick& sys_tick) noexcept : nvic_(nvic), sys_tick_(sys_tick) {}

  void reset() noexcept;

  // `offset`: within the space, a multiple of `bytes`, which is 1, 2 or 4. False: the register, or the value
  // written to it, is not modelled.
  [[nodiscard]] bool read(std::uint32_t offset, unsigned bytes, SimTime now, std::uint32_t& value) noexcept;
  [[nodiscard]] bool write(std::uint32_t offset, unsigned bytes, SimTime now, std::uint32_t value) noexcept;

  // IPSR, for ICSR.VECTACTIVE.
  void set_current_exception(unsigned number) noexcept { current_exception_ = number; }

  [[nodiscard]] std::uint32_t vector_table() const noexcept { return vtor_; }
  [[nodiscard]] bool floating_point_enabled() const noexcept { return (cpacr_ >> 20 & 3U) == 3; }
  [[nodiscard]] bool sleeps_on_exit() const noexcept { return (scr_ & 1U << 1) != 0; }
  [[nodiscard]] bool sleeps_deep() const noexcept { return (scr_ & 1U << 2) != 0; }
  [[nodiscard]] bool pending_sends_event() const noexcept { return (scr_ & 1U << 4) != 0; }
  [[nodiscard]] bool thread_below_handlers() const noexcept {
    return (ccr_ & 1U << 0) != 0;
  }  // NONBASETHRDENA
  [[nodiscard]] bool traps_division() const noexcept { return (ccr_ & 1U << 4) != 0; }
  [[nodiscard]] bool aligns_stack() const noexcept { return (ccr_ & 1U << 9) != 0; }
  [[nodiscard]] bool reset_requested() const noexcept { return reset_requested_; }

  void record_fault(std::uint32_t cfsr_bits) noexcept { cfsr_ |= cfsr_bits; }
  void record_bus_address(std::uint32_t address) noexcept;
  void record_hard_fault(std::uint32_t hfsr_bits) noexcept { hfsr_ |= hfsr_bits; }
  // FPCAR: the address of S0 in the last extended frame.
  void record_floating_point_frame(std::uint32_t address) noexcept { fpcar_ = address; }

 private:
  [[nodiscard]] bool read_word(std::uint32_t offset, SimTime now, std::uint32_t& value) noexcept;
  [[nodiscard]] bool write_word(std::uint32_t offset, SimTime now, std::uint32_t value) noexcept;
  [[nodiscard]] std::uint32_t interrupt_state() const noexcept;          // ICSR
  void write_interrupt_control(std::uint32_t value) noexcept;            // ICSR
  [[nodiscard]] bool write_reset_control(std::uint32_t value) noexcept;  // AIRCR
  [[nodiscard]] std::uint32_t handler_state() const noexcept;            // SHCSR
  void write_handler_state(std::uint32_t value) noexcept;                // SHCSR

  Nvic& nvic_;
  SysTick& sys_tick_;
  unsigned current_exception_ = 0;
  std::uint32_t vtor_ = 0;
  std::uint32_t scr_ = 0;
  std::uint32_t ccr_ = 0;
  std::uint32_t cfsr_ = 0;
  std::uint32_t hfsr_ = 0;
  std::uint32_t dfsr_ = 0;
  std::uint32_t mmfar_ = 0;
  std::uint32_t bfar_ = 0;
  std::uint32_t cpacr_ = 0;
  std::uint32_t fpccr_ = 0;
  std::uint32_t fpcar_ = 0;
  bool reset_requested_ = false;
};

}  // namespace groma::sim
