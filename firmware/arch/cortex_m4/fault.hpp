// The fault that ended the previous run, preserved over the reset in RAM that start-up does not initialize.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/node/platform.hpp"

namespace groma::cortex_m4 {

enum class FaultCause : std::uint32_t {
  kFault = 1,     // hard fault, memory management, bus or usage fault, or an interrupt without a handler
  kWatchdog = 2,  // the watchdog expired; pc and lr are the program's at that time
};

struct SavedFault {
  FaultCause cause;
  node::Fault fault;
};

// Saves the program's place for the reset that follows. Call from the watchdog's interrupt. `frame`: the
// stack pointer at the interrupt, which may be invalid.
void save_watchdog_reset(const std::uint32_t* frame) noexcept;

// Returns the record of the previous run, or nullopt, and clears it.
[[nodiscard]] std::optional<SavedFault> take_saved_fault() noexcept;

}  // namespace groma::cortex_m4
