// Exception entry and return, B1.5.6 to B1.5.15.
#include <array>
#include <cstring>

#include "firmware/sim/emulator/cortex_m4_core.hpp"

namespace groma::sim {
namespace {

constexpr std::uint32_t kRam = 0x20000000;
constexpr std::uint32_t kExceptionNumber = 0x1FF;
constexpr std::uint32_t kRealigned = 1U << 9;  // of the stacked xPSR
constexpr std::uint32_t kBasicFrame = 0x20;
constexpr std::uint32_t kExtendedFrame = 0x68;
constexpr std::uint32_t kControlProcessStack = 1U << 1;
constexpr std::uint32_t kControlFloatingPoint = 1U << 2;

// EXC_RETURN (table B1-8 and B1-9).
constexpr std::uint32_t kReturnBase = 0xFFFFFFE1;
constexpr std::uint32_t kReturnBasicFrame = 1U << 4;
constexpr std::uint32_t kReturnToThread = 1U << 3;
constexpr std::uint32_t kReturnProcessStack = 1U << 2;

constexpr std::array kFrameRegisters{UC_ARM_REG_R0, UC_ARM_REG_R1,  UC_ARM_REG_R2,
                                     UC_ARM_REG_R3, UC_ARM_REG_R12, UC_ARM_REG_LR};
constexpr std::uint32_t kFramePc = 0x18;
constexpr std::uint32_t kFrameXpsr = 0x1C;
constexpr std::uint32_t kFrameS0 = 0x20;
constexpr std::uint32_t kFrameFpscr = 0x60;

bool valid_return(std::uint32_t exc_return) {
  const std::uint32_t mode = exc_return & 0xF;
  return (exc_return | 0x1F) == 0xFFFFFFFF && (mode == 0x1 || mode == 0x9 || mode == 0xD);
}

}  // namespace

bool CortexM4::Core::load_word(std::uint32_t address, std::uint32_t& value) const {
  const std::span<const std::uint8_t> memory = memory_at(address, sizeof value);
  if (memory.size() < sizeof value) return false;
  std::memcpy(&value, memory.data(), sizeof value);
  return true;
}

bool CortexM4::Core::store_word(std::uint32_t address, std::uint32_t value) {
  if (address < kRam || address - kRam > ram_.size() - sizeof value) return false;
  std::memcpy(&ram_[address - kRam], &value, sizeof value);
  return true;
}

bool CortexM4::Core::take_pending() {
  recheck_exceptions_ = false;
  const unsigned best = nvic_.best_pending();
  if (best == 0 || nvic_.group_priority(best) >= nvic_.execution_priority(engine_.masks())) return false;
  take(push_frame(), timing_.entry_cycles);
  return true;
}

// A synchronous exception of an instruction. If it cannot be taken it becomes a HardFault (B1.5.10 to 13).
void CortexM4::Core::fault(unsigned exception, std::uint32_t fault_bits, std::uint32_t return_pc) {
  next_pc_ = return_pc | (engine_.xpsr() >> 24 & 1U);
  control_.record_fault(fault_bits);
  const int running = nvic_.execution_priority(engine_.masks());
  if (nvic_.group_priority(exception) >= running || !nvic_.enabled(exception)) {
    hard_fault(hard_fault_status::kForced);
    return;
  }
  nvic_.pend(exception);
  take(push_frame(), timing_.entry_cycles);
}

void CortexM4::Core::hard_fault(std::uint32_t status) {
  control_.record_hard_fault(status);
  if (nvic_.execution_priority(engine_.masks()) < 0) {
    lock_up();
    return;
  }
  nvic_.pend(exception::kHardFault);
  take(push_frame(), timing_.entry_cycles);
}

void CortexM4::Core::lock_up() {
  lockup_ = true;
}

void CortexM4::Core::breakpoint() {
  const std::uint32_t pc = next_pc_ & ~1U;
  const thumb::Instruction i = thumb::instruction_at(memory_at(pc, 2));
  if (semihosting_ && (i.first & 0xFF) == 0xAB) {
    engine_.write(UC_ARM_REG_R0, semihosting_(engine_.read(UC_ARM_REG_R0), engine_.read(UC_ARM_REG_R1)));
    next_pc_ += 2;
    return;
  }
  hard_fault(hard_fault_status::kDebugEvent);
}

// A fault during an exception entry or return (B1.5.11). The original exception stays pending.
void CortexM4::Core::pend_derived(unsigned exception) {
  const int running = nvic_.execution_priority(engine_.masks());
  if (nvic_.group_priority(exception) >= running || !nvic_.enabled(exception)) {
    control_.record_hard_fault(hard_fault_status::kForced);
    if (running < 0) lock_up();
    exception = exception::kHardFault;
  }
  nvic_.pend(exception);
}

// PushStack(). Returns the EXC_RETURN value for LR. Floating-point registers are stored immediately.
std::uint32_t CortexM4::Core::push_frame() {
  const std::uint32_t xpsr = engine_.xpsr();
  const std::uint32_t control = engine_.read(UC_ARM_REG_CONTROL);
  const bool from_handler = (xpsr & kExceptionNumber) != 0;
  const bool process_stack = !from_handler && (control & kControlProcessStack) != 0;
  const bool extended = (control & kControlFloatingPoint) != 0;
  const bool align = extended || control_.aligns_stack();
  const std::uint32_t stack = engine_.read(UC_ARM_REG_R13);
  const bool realigned = align && (stack & 4U) != 0;
  const std::uint32_t frame = (stack - (extended ? kExtendedFrame : kBasicFrame)) & ~(align ? 7U : 3U);

  bool stored = true;
  const auto put = [&](std::uint32_t offset, std::uint32_t value) {
    stored = store_word(frame + offset, value) && stored;
  };
  std::uint32_t offset = 0;
  for (const int which : kFrameRegisters) {
    put(offset, engine_.read(which));
    offset += 4;
  }
  put(kFramePc, next_pc_ & ~1U);
  put(kFrameXpsr, (xpsr & ~kRealigned) | (realigned ? kRealigned : 0U));
  if (extended) {
    for (std::uint32_t s = 0; s < 16; ++s) {
      put(kFrameS0 + 4 * s, engine_.read(UC_ARM_REG_S0 + static_cast<int>(s)));
    }
    put(kFrameFpscr, engine_.read(UC_ARM_REG_FPSCR));
    control_.record_floating_point_frame(frame + kFrameS0);
  }
  engine_.write(UC_ARM_REG_R13, frame);
  if (!stored) {
    control_.record_fault(fault_status::kStacking);
    pend_derived(exception::kBusFault);
  }
  return kReturnBase | (extended ? 0U : kReturnBasicFrame) | (from_handler ? 0U : kReturnToThread) |
         (process_stack ? kReturnProcessStack : 0U);
}

// ExceptionTaken() for the pending exception of the highest priority.
void CortexM4::Core::take(std::uint32_t exc_return, std::uint32_t cycles) {
  if (lockup_) return;
  unsigned number = nvic_.best_pending();
  std::uint32_t vector = 0;
  while (!load_word(control_.vector_table() + 4 * number, vector)) {
    control_.record_hard_fault(hard_fault_status::kVectorTable);
    if (number == exception::kHardFault || number == exception::kNmi) {
      lock_up();
      return;
    }
    nvic_.pend(exception::kHardFault);
    number = nvic_.best_pending();
  }
  nvic_.activate(number);
  pending_before_ = nvic_.pending_bits();
  control_.set_current_exception(number);
  engine_.enter_handler(number, (vector & 1U) != 0);
  engine_.write(UC_ARM_REG_LR, exc_return);
  next_pc_ = vector;
  event_ = true;
  sleep_ = Sleep::kAwake;
  add_cycles(cycles);
  ++exceptions_;
  if (tracing_) trace_point(number);
  recheck_exceptions_ = true;
}

void CortexM4::Core::return_from_exception(std::uint32_t exc_return) {
  const unsigned returning = engine_.xpsr() & kExceptionNumber;
  const bool was_active = nvic_.active(returning);
  const bool to_thread = (exc_return & kReturnToThread) != 0;
  const bool last = nvic_.active_count() == 1;
  const bool consistent = to_thread ? last || control_.thread_below_handlers() : !last;
  nvic_.deactivate(returning);
  if (returning != exception::kNmi) engine_.write(UC_ARM_REG_FAULTMASK, 0);
  event_ = true;
  exceptions_changed();
  if (!was_active || !valid_return(exc_return) || !consistent) {
    invalid_return(exc_return);
    return;
  }
  const unsigned next = nvic_.best_pending();
  if (next != 0 && nvic_.group_priority(next) < nvic_.execution_priority(engine_.masks())) {
    take(exc_return, timing_.tail_chain_cycles);
    return;
  }
  if (!pop_frame(exc_return)) return;
  add_cycles(timing_.return_cycles);
  if (to_thread && nvic_.active_count() == 0 && control_.sleeps_on_exit()) fall_asleep(Sleep::kForInterrupt);
}

void CortexM4::Core::invalid_return(std::uint32_t exc_return) {
  control_.record_fault(fault_status::kInvalidReturn);
  pend_derived(exception::kUsageFault);
  take(0xF0000000 | exc_return, timing_.tail_chain_cycles);
}

// PopStack(). False: a fault was taken instead.
bool CortexM4::Core::pop_frame(std::uint32_t exc_return) {
  const bool to_thread = (exc_return & kReturnToThread) != 0;
  const bool process_stack = (exc_return & kReturnProcessStack) != 0;
  const bool extended = (exc_return & kReturnBasicFrame) == 0;
  const std::uint32_t frame = engine_.read(process_stack ? UC_ARM_REG_PSP : UC_ARM_REG_MSP);

  std::array<std::uint32_t, kExtendedFrame / 4> words{};
  bool loaded = true;
  for (std::uint32_t offset = 0; offset < (extended ? kExtendedFrame - 4 : kBasicFrame); offset += 4) {
    loaded = load_word(frame + offset, words[offset / 4]) && loaded;
  }
  if (!loaded) {
    control_.record_fault(fault_status::kUnstacking);
    pend_derived(exception::kBusFault);
    take(exc_return, timing_.tail_chain_cycles);
    return false;
  }
  const std::uint32_t xpsr = words[kFrameXpsr / 4];
  if (((xpsr & kExceptionNumber) == 0) != to_thread) {
    invalid_return(exc_return);
    return false;
  }
  if (to_thread) {
    engine_.leave_to_thread(process_stack, extended);
  } else {
    engine_.set_floating_point_active(extended);
  }
  std::uint32_t stack = frame + (extended ? kExtendedFrame : kBasicFrame);
  if ((xpsr & kRealigned) != 0 && (extended || control_.aligns_stack())) stack |= 4U;
  engine_.write(UC_ARM_REG_R13, stack);
  for (std::size_t i = 0; i < kFrameRegisters.size(); ++i) engine_.write(kFrameRegisters[i], words[i]);
  if (extended) {
    for (std::uint32_t s = 0; s < 16; ++s) {
      engine_.write(UC_ARM_REG_S0 + static_cast<int>(s), words[kFrameS0 / 4 + s]);
    }
    engine_.write(UC_ARM_REG_FPSCR, words[kFrameFpscr / 4]);
  }
  engine_.set_xpsr(xpsr & ~kRealigned);
  control_.set_current_exception(xpsr & kExceptionNumber);
  next_pc_ = (words[kFramePc / 4] & ~1U) | (xpsr >> 24 & 1U);
  return true;
}

}  // namespace groma::sim
