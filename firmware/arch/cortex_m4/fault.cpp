#include "firmware/arch/cortex_m4/fault.hpp"

#include <array>
#include <cstddef>
#include <span>

#include "firmware/arch/cortex_m4/cpu.hpp"
#include "firmware/arch/cortex_m4/memory.hpp"
#include "firmware/arch/cortex_m4/registers.hpp"
#include "proto/crc32.hpp"

namespace groma::cortex_m4 {
namespace {

// All members are words, so that the record has no padding.
struct Record {
  std::uint32_t magic;
  std::uint32_t cause;
  std::uint32_t pc;
  std::uint32_t lr;
  std::uint32_t cfsr;
  std::uint32_t crc;  // over the members before it
};

constexpr std::uint32_t kMagic = 0x4752'4D46;

// Its bytes after power-on are random, which the CRC detects.
[[gnu::section(".noinit")]] Record record;

std::uint32_t crc_of(const Record& r) noexcept {
  return wire::crc32({reinterpret_cast<const std::uint8_t*>(&r), offsetof(Record, crc)});
}

void save(FaultCause cause, const node::Fault& fault) noexcept {
  record = {.magic = kMagic,
            .cause = static_cast<std::uint32_t>(cause),
            .pc = fault.pc,
            .lr = fault.lr,
            .cfsr = fault.cfsr,
            .crc = 0};
  record.crc = crc_of(record);
}

// The words that the processor stacks at an exception (ARM DDI 0403E, B1.5.6).
enum StackedWord : std::size_t { kStackedLr = 5, kStackedPc = 6, kStackedWords = 8 };

// CFSR: the frame could not be stacked because of a memory protection or bus fault.
constexpr std::uint32_t kMstkerr = 1U << 4;
constexpr std::uint32_t kStkerr = 1U << 12;

[[nodiscard]] bool in_stack(const std::uint32_t* frame) noexcept {
  return frame >= groma_stack_begin && frame + kStackedWords <= groma_stack_end;
}

// After a stack overflow there is no frame. The best estimate is the innermost return address on the stack:
// the lowest word on the stack that looks like one.
[[nodiscard]] std::uint32_t innermost_return_address() noexcept {
  for (const std::uint32_t* word = groma_stack_begin; word != groma_stack_end; ++word) {
    const bool thumb = (*word & 1U) != 0;
    if (thumb && *word >= address_of(groma_text_begin) && *word < address_of(groma_text_end))
      return *word & ~1U;
  }
  return 0;
}

}  // namespace

std::optional<SavedFault> take_saved_fault() noexcept {
  const Record saved = record;
  record.magic = 0;
  if (saved.magic != kMagic || saved.crc != crc_of(saved)) return std::nullopt;
  return SavedFault{.cause = static_cast<FaultCause>(saved.cause),
                    .fault = {.pc = saved.pc, .lr = saved.lr, .cfsr = saved.cfsr}};
}

void save_watchdog_reset(const std::uint32_t* frame) noexcept {
  node::Fault place;
  if (in_stack(frame)) place = {.pc = frame[kStackedPc], .lr = frame[kStackedLr]};
  save(FaultCause::kWatchdog, place);
}

}  // namespace groma::cortex_m4

extern "C" {

// Runs on the fault handlers' own stack. `frame`: the stack pointer at the exception, which may be invalid.
[[noreturn, gnu::used]] void save_fault_and_reset(const std::uint32_t* frame) {
  using namespace groma::cortex_m4;
  groma::node::Fault fault{.cfsr = scb::kBlock[scb::kFaultStatus]};
  if ((fault.cfsr & (kMstkerr | kStkerr)) == 0 && in_stack(frame)) {
    fault.pc = frame[kStackedPc];
    fault.lr = frame[kStackedLr];
  } else {
    fault.pc = innermost_return_address();
  }
  save(FaultCause::kFault, fault);
  reset_processor();
}

[[gnu::naked]] void fault_entry() {
  asm volatile(
      "mov r0, sp\n"
      "ldr sp, =groma_fault_stack_end\n"
      "b save_fault_and_reset\n"
      ".ltorg");
}
}
