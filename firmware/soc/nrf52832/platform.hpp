// A board with an nRF52832 and a DW1000 as a node's platform (firmware/core/node/platform.hpp). The board is
// the one whose board.hpp the image's include path has.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "board.hpp"
#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/storage/config_store.hpp"
#include "firmware/soc/nrf52832/can_port.hpp"
#include "firmware/soc/nrf52832/ecb.hpp"
#include "firmware/soc/nrf52832/leds.hpp"
#include "firmware/soc/nrf52832/nvmc.hpp"
#include "firmware/soc/nrf52832/radio_bus.hpp"
#include "firmware/soc/nrf52832/reset.hpp"
#include "firmware/soc/nrf52832/uarte.hpp"

namespace groma::nrf52832 {

static_assert(is_valid(board::kWiring), "board.hpp: a pin has two uses, or is reserved");

class Platform {
 public:
  using Radio = dw1000::Dw1000<RadioBus>;

  // Call once after boot.
  void start() noexcept;

  // ---- interface to the node -----------------------------------------------------------------------------
  RadioBus& spi() noexcept { return radio_; }
  void reset_radio() noexcept;
  void delay_us(std::uint32_t duration_us) noexcept;
  std::uint64_t now_us() noexcept;
  std::uint64_t radio_interrupt_us() noexcept;
  bool link_write(std::span<const std::uint8_t> frame) noexcept {
    return can_.up() ? can_.write(frame) : uart_.write(frame);
  }
  const char* configure_link(const groma_Config& config) noexcept { return can_.configure(config); }
  bool link_answer(std::span<const std::uint8_t> frame) noexcept {
    return command_over_can_ ? can_.write(frame) : uart_.write(frame);
  }
  void count_link(groma_Counters& counters) noexcept {
    can_.count(counters);
    counters.link_bytes_lost = uart_.lost();
  }
  bool store_config(std::span<const std::uint8_t> blob) noexcept { return config_store_.store(blob); }
  std::size_t load_config(std::span<std::uint8_t> out) noexcept { return config_store_.load(out); }
  security::BlockCipher& cipher() noexcept { return ecb_; }
  void set_indicator(node::Indicator indicator) noexcept { leds_.show(indicator, now_us()); }
  void restart() noexcept;
  node::ResetReason reset_reason() noexcept { return reset_.reason; }
  std::optional<node::Fault> last_fault() noexcept { return reset_.fault; }
  std::uint32_t boot_count() noexcept { return boot_count_; }
  void proof_of_life() noexcept;
  node::StackUse stack_use() noexcept;

  // ---- interface to main() -------------------------------------------------------------------------------
  [[nodiscard]] bool radio_interrupt() const noexcept;
  Uarte& uart() noexcept { return uart_; }
  CanPort& can() noexcept { return can_; }
  Ecb& ecb() noexcept { return ecb_; }
  // Selects the link for link_answer() until the next call.
  void set_command_over_can(bool over_can) noexcept { command_over_can_ = over_can; }
  void update_leds(std::uint64_t now_us) noexcept { leds_.update(now_us); }
  // Sleeps until `t_us` or until there is something to do. The program's only sleep.
  void sleep_until(std::uint64_t t_us) noexcept;

 private:
  RadioBus radio_{board::kWiring.radio.spi};
  Uarte uart_;
  CanPort can_{board::kWiring.can};
  bool command_over_can_ = false;
  Leds leds_;
  Ecb ecb_;
  Nvmc flash_;
  storage::ConfigStore<Nvmc> config_store_{flash_};
  std::uint32_t boot_count_ = 0;
  Reset reset_;
};

static_assert(node::Platform<Platform>);

}  // namespace groma::nrf52832
