#include "firmware/soc/nrf52832/reset.hpp"

#include "firmware/arch/cortex_m4/fault.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {

Reset take_reset() noexcept {
  using node::ResetReason;
  const std::uint32_t bits = power::kBlock[power::kResetReason];
  // Bits accumulate until they are cleared by writing them back.
  power::kBlock[power::kResetReason] = bits;
  const auto saved = cortex_m4::take_saved_fault();
  // Erratum 136: after a pin reset other bits may be set too.
  if ((bits & power::kResetPin) != 0) return {.reason = ResetReason::kPin};
  if (saved && saved->cause == cortex_m4::FaultCause::kFault) return {ResetReason::kFault, saved->fault};
  if ((bits & power::kResetWatchdog) != 0) {
    return {ResetReason::kWatchdog, saved ? std::optional(saved->fault) : std::nullopt};
  }
  if ((bits & power::kResetLockup) != 0) return {.reason = ResetReason::kLockup};
  if ((bits & power::kResetSoftware) != 0) return {.reason = ResetReason::kSoftware};
  return {.reason = ResetReason::kPowerOn};
}

}  // namespace groma::nrf52832
