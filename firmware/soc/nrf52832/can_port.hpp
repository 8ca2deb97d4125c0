// The MCP2518FD on SPIM1 at 8 MHz, and the link to the host over it. Its pins are used only if the
// configuration selects a CAN link.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mcp2518fd/spi.hpp"
#include "firmware/core/node/can_link.hpp"
#include "firmware/soc/nrf52832/gpio.hpp"
#include "firmware/soc/nrf52832/spim.hpp"
#include "firmware/soc/nrf52832/wiring.hpp"
#include "groma.pb.h"

namespace groma::nrf52832 {

class CanSpi {
 public:
  explicit constexpr CanSpi(const SpiPins& pins) noexcept : spim_(spim::kBase1, pins) {}
  void start() noexcept { spim_.start(SpiFrequency::k8MHz); }
  void transfer(std::span<std::uint8_t> inout) noexcept { spim_.transfer(inout, inout); }

 private:
  Spim spim_;
};

static_assert(mcp2518fd::Spi<CanSpi>);

class CanPort {
 public:
  // Without `wiring` the board has no controller, and no link comes up.
  explicit constexpr CanPort(const std::optional<CanWiring>& wiring) noexcept
      : exists_(wiring.has_value()),
        interrupt_pin_(wiring.value_or(CanWiring{}).interrupt),
        spi_(wiring.value_or(CanWiring{}).spi) {}

  // Starts the link that the configuration selects, or none. Queued bytes are sent first, for at most 20 ms.
  // Returns the error in at most 31 characters; empty: none.
  const char* configure(const groma_Config& config) noexcept;

  // Queues the whole frame, or nothing and returns false.
  bool write(std::span<const std::uint8_t> frame) noexcept { return link_.write(frame); }
  [[nodiscard]] bool up() const noexcept { return link_.up(); }

  // Makes one bounded step (can_link.hpp) if it ends before the radio may need the processor at
  // `quiet_until_us`; a step that was postponed for kMaxPostponement_us is made in any case. `sink(bytes)`
  // takes bytes from the host. True: there is more to do.
  template <class Sink>
  bool service(std::uint64_t now_us, std::uint64_t quiet_until_us, Sink&& sink) noexcept {
    if (!link_.started()) return false;
    const bool low = line_is_low();
    postponed_ = now_us + link_.step_us(low, now_us) > quiet_until_us && now_us < postpone_until_us_;
    if (postponed_) return false;
    postpone_until_us_ = now_us + kMaxPostponement_us;
    const bool more = link_.service(low, now_us, sink, delay);
    ignore_low_line_ = low && !more;
    return more;
  }

  // Sends queued bytes for at most 20 ms.
  void drain() noexcept;

  // For sleep_until(): whether the controller waits for service(), and when service() is due at the latest.
  [[nodiscard]] bool waiting() const noexcept {
    return link_.started() && !postponed_ && !ignore_low_line_ && line_is_low();
  }
  [[nodiscard]] std::uint64_t next_deadline_us() const noexcept {
    return link_.started() && postponed_ ? postpone_until_us_ : link_.next_deadline_us();
  }

  void count(groma_Counters& counters) const noexcept;

 private:
  // A step is postponed for at most this time.
  static constexpr std::uint64_t kMaxPostponement_us = 20'000;

  [[nodiscard]] bool line_is_low() const noexcept { return !pin::is_high(interrupt_pin_); }
  [[nodiscard]] static std::uint64_t now_us() noexcept;
  static void delay(std::uint32_t duration_us) noexcept;

  bool exists_;
  Pin interrupt_pin_;
  CanSpi spi_;
  node::CanLink<CanSpi> link_{spi_};
  std::uint64_t postpone_until_us_ = 0;
  bool postponed_ = false;        // a step is postponed for the radio
  bool connected_ = false;        // the pins are set up
  bool ignore_low_line_ = false;  // the line is low although service() found nothing to do
};

}  // namespace groma::nrf52832
