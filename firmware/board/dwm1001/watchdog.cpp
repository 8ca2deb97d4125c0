#include "firmware/board/dwm1001/watchdog.hpp"

#include "firmware/board/dwm1001/cpu.hpp"
#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001::watchdog {

namespace wdt = nrf52832::wdt;

void start() noexcept {
  constexpr std::uint32_t kTicksPerSecond = 32'768;
  wdt::kBlock[wdt::kConfig] = wdt::kRunsInSleepAlone;
  wdt::kBlock[wdt::kReloadValue] = kPeriod_s * kTicksPerSecond - 1;
  wdt::kBlock[wdt::kReloadEnable] = 1;
  wdt::kBlock[wdt::kInterruptSet] = wdt::kInterruptTimeout;
  enable_interrupt(nrf52832::Irq::kWatchdog, Priority::kWatchdog);
  wdt::kBlock[wdt::kStart] = 1;
  // A software reset does not stop the watchdog: without this it would keep the rest of its period.
  feed();
}

void feed() noexcept {
  wdt::kBlock[wdt::kReload] = wdt::kReloadKey;
}

}  // namespace groma::dwm1001::watchdog
