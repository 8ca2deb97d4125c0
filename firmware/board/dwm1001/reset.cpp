#include "firmware/board/dwm1001/reset.hpp"

#include "firmware/board/dwm1001/fault.hpp"
#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001 {

Reset take_reset() noexcept {
  namespace power = nrf52832::power;
  using node::ResetReason;
  const std::uint32_t bits = power::kBlock[power::kResetReason];
  // Bits accumulate until they are cleared by writing them back.
  power::kBlock[power::kResetReason] = bits;
  const auto saved = take_saved_fault();
  // Erratum 136: after a pin reset other bits may be set too.
  if ((bits & power::kResetPin) != 0) return {.reason = ResetReason::kPin};
  if (saved && saved->cause == FaultCause::kFault) return {ResetReason::kFault, saved->fault};
  if ((bits & power::kResetWatchdog) != 0) {
    return {ResetReason::kWatchdog, saved ? std::optional(saved->fault) : std::nullopt};
  }
  if ((bits & power::kResetLockup) != 0) return {.reason = ResetReason::kLockup};
  if ((bits & power::kResetSoftware) != 0) return {.reason = ResetReason::kSoftware};
  return {.reason = ResetReason::kPowerOn};
}

}  // namespace groma::dwm1001
