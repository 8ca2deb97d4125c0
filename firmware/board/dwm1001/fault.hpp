// What ended the run before, kept over the reset in RAM that start-up leaves alone.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/node/platform.hpp"

namespace groma::dwm1001 {

enum class FaultCause : std::uint32_t {
  kFault = 1,     // hard fault, memory management, bus or usage fault, or an interrupt that nobody serves
  kWatchdog = 2,  // pc and lr are where the program was when the watchdog ran out
};

struct KeptFault {
  FaultCause cause;
  node::Fault fault;
};

// The record of the run before, or nothing; forgotten by this call.
[[nodiscard]] std::optional<KeptFault> take_kept_fault() noexcept;

}  // namespace groma::dwm1001
