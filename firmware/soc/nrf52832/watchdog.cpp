#include "firmware/soc/nrf52832/watchdog.hpp"

#include "firmware/arch/cortex_m4/fault.hpp"
#include "firmware/soc/nrf52832/cpu.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832::watchdog {

void start() noexcept {
  constexpr std::uint32_t kTicksPerSecond = 32'768;
  wdt::kBlock[wdt::kConfig] = wdt::kRunsInSleepAlone;
  wdt::kBlock[wdt::kReloadValue] = kPeriod_s * kTicksPerSecond - 1;
  wdt::kBlock[wdt::kReloadEnable] = 1;
  wdt::kBlock[wdt::kInterruptSet] = wdt::kInterruptTimeout;
  enable_interrupt(Irq::kWatchdog, Priority::kWatchdog);
  wdt::kBlock[wdt::kStart] = 1;
  // A software reset does not stop the watchdog: without this it would keep the rest of its period.
  feed();
}

void feed() noexcept {
  wdt::kBlock[wdt::kReload] = wdt::kReloadKey;
}

}  // namespace groma::nrf52832::watchdog

extern "C" {

// The reset follows 61 us after the interrupt.
[[noreturn, gnu::used]] void save_place_until_reset(const std::uint32_t* frame) {
  groma::cortex_m4::save_watchdog_reset(frame);
  const groma::nrf52832::InterruptLock lock;
  for (;;) groma::nrf52832::sleep();
}

// Changes to the fault handlers' own stack.
[[gnu::naked]] void watchdog_entry() {
  asm volatile(
      "mov r0, sp\n"
      "ldr sp, =groma_fault_stack_end\n"
      "b save_place_until_reset\n"
      ".ltorg");
}
}
