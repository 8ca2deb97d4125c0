#include "firmware/soc/nrf52832/can_port.hpp"

#include "firmware/soc/nrf52832/clock.hpp"
#include "firmware/soc/nrf52832/cpu.hpp"

namespace groma::nrf52832 {
namespace {

// The second GPIOTE channel; the radio uses the first.
constexpr std::uint32_t kChannel = 1;

mcp2518fd::Settings settings_of(const groma_Config& config) noexcept {
  mcp2518fd::Settings settings;
  settings.node = static_cast<std::uint16_t>(config.id);
  if (config.link == groma_Link_LINK_CAN_FD) settings.format = wire::CanFormat::kFd;
  if (config.can_nominal_bit_per_s != 0) settings.nominal_bit_per_s = config.can_nominal_bit_per_s;
  if (config.can_data_bit_per_s != 0) settings.data_bit_per_s = config.can_data_bit_per_s;
  return settings;
}

}  // namespace

const char* CanPort::configure(const groma_Config& config) noexcept {
  const bool wanted = config.link == groma_Link_LINK_CAN || config.link == groma_Link_LINK_CAN_FD;
  const mcp2518fd::Settings settings = settings_of(config);
  if (link_.up() && wanted && link_.settings() == settings) return "";
  drain();
  link_.stop();
  if (!wanted) return "";
  if (!exists_) return "no CAN controller on this board";
  if (!connected_) {
    connected_ = true;
    spi_.start();
    // Pulled up, so that no interrupt occurs without a controller.
    pin::configure(interrupt_pin_, gpio::kInputPulledUp);
    gpiote::kBlock[gpiote::kConfig + 4 * kChannel] =
        gpiote::kEventMode | interrupt_pin_ << gpiote::kPinShift | gpiote::kFalling;
    gpiote::kBlock[gpiote::kEventIn + 4 * kChannel] = 0;
    gpiote::kBlock[gpiote::kInterruptSet] = 1U << kChannel;
  }
  return mcp2518fd::describe(link_.start(settings, now_us(), delay));
}

void CanPort::drain() noexcept {
  constexpr std::uint64_t kLongest_us = 20'000;
  // The controller's own FIFO may still hold a few frames; enough time for them at the lowest bit rate.
  constexpr std::uint32_t kTail_us = 5'000;
  if (!link_.up()) return;
  const std::uint64_t end_us = now_us() + kLongest_us;
  while (!link_.empty() && now_us() < end_us) {
    (void)link_.service(
        line_is_low(), now_us(), [](std::span<const std::uint8_t>) {}, delay);
  }
  delay(kTail_us);
}

void CanPort::count(groma_Counters& counters) const noexcept {
  const node::CanLinkCounters& seen = link_.counters();
  counters.can_frames_sent = seen.frames_sent;
  counters.can_frames_received = seen.frames_received;
  counters.can_receive_overruns = seen.receive_overruns;
  counters.can_bus_offs = seen.bus_offs;
  counters.can_restarts = seen.restarts;
  counters.can_transmit_errors = seen.errors.transmit;
  counters.can_receive_errors = seen.errors.receive;
}

std::uint64_t CanPort::now_us() noexcept {
  return clock::now_us();
}

void CanPort::delay(std::uint32_t duration_us) noexcept {
  clock::delay_us(duration_us);
}

}  // namespace groma::nrf52832
