// Start-up, and the table of the handlers of exceptions and interrupts.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <initializer_list>

#include "firmware/arch/cortex_m4/memory.hpp"

extern "C" {
// Runs at a reset: prepares processor and memory, and calls main().
[[noreturn]] void reset_entry();
// Runs at a fault (fault.cpp).
void fault_entry();
}

namespace groma::cortex_m4 {

// Defined by the chip's code: the settings and workarounds that the chip requires before anything else.
// Variables are not initialized yet.
void prepare_chip() noexcept;

using Handler = void (*)();

struct InterruptHandler {
  std::size_t number;
  Handler handler;
};

inline constexpr std::size_t kExceptions = 15;

template <std::size_t kInterrupts>
struct VectorTable {
  std::uint32_t* stack_end;
  std::array<Handler, kExceptions + kInterrupts> handlers;
};

// The vector table of a chip with `kInterrupts` interrupts; its place is the section .vectors. An exception,
// or an interrupt without a handler, is a fault.
template <std::size_t kInterrupts>
consteval VectorTable<kInterrupts> vector_table(std::initializer_list<InterruptHandler> served) {
  VectorTable<kInterrupts> table{.stack_end = groma_stack_end, .handlers = {}};
  table.handlers.fill(fault_entry);
  table.handlers[0] = reset_entry;
  for (const InterruptHandler& each : served) table.handlers[kExceptions + each.number] = each.handler;
  return table;
}

}  // namespace groma::cortex_m4
