#include "firmware/arch/cortex_m4/startup.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

extern "C" {
void uarte0_entry();
void gpiote_entry();
void timer0_entry();
void ecb_entry();
void watchdog_entry();
}

namespace groma::nrf52832 {
namespace {

constexpr std::size_t kInterrupts = 39;

constexpr std::size_t number(Irq irq) noexcept {
  return static_cast<std::size_t>(irq);
}

[[gnu::section(".vectors"), gnu::used]] constexpr auto kVectors =
    cortex_m4::vector_table<kInterrupts>({{number(Irq::kUarte0), uarte0_entry},
                                          {number(Irq::kGpiote), gpiote_entry},
                                          {number(Irq::kTimer0), timer0_entry},
                                          {number(Irq::kEcb), ecb_entry},
                                          {number(Irq::kWatchdog), watchdog_entry}});

}  // namespace
}  // namespace groma::nrf52832
