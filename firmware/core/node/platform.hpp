#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <type_traits>

#include "firmware/core/radio/radio.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "groma.pb.h"

namespace groma::node {

// A deadline that never comes.
inline constexpr std::uint64_t kNever_us = std::numeric_limits<std::uint64_t>::max();

// The states that the node's LEDs show.
enum class Indicator : std::uint8_t {
  kRadioFault,    // the radio did not come up
  kUnconfigured,  // silent, waiting for a configuration
  kSearching,     // configured, no beacon heard yet
  kRanging,       // synchronized with the master, or the master itself
  kIdentify,      // requested by the host
};

// Same values as groma.ResetReason of the schema.
enum class ResetReason : std::uint8_t { kPowerOn, kPin, kWatchdog, kSoftware, kLockup, kFault };

// Registers that the fault handler saved over the reset.
struct Fault {
  std::uint32_t pc = 0;
  std::uint32_t lr = 0;
  std::uint32_t cfsr = 0;
};

// The stack that the node runs on; 0: not known.
struct StackUse {
  std::uint32_t size_bytes = 0;
  std::uint32_t high_water_bytes = 0;  // largest depth since the reset
};

// The image's version, for its hello.
struct Build {
  const char* version = "";
  std::uint32_t git_hash = 0;
};

// The hardware under a node. All calls are noexcept and come from one context, that of the Node's caller.
// - Radio: the radio's driver; spi(): the bus that it is constructed from; radio interrupts may come at any
//   time during a transfer
// - reset_radio(): pulls the radio's reset line low, releases it, and returns when the chip is ready for SPI
// - delay_us(n): returns after at least n microseconds
// - now_us(): microseconds since boot, 64 bits, monotonic; any drift
// - radio_interrupt_us(): now_us() when the radio's interrupt line last rose, even if the processor was busy
// - configure_link(config): brings up config.link, which link_write() uses from now on; empty and zero fields
//   mean the UART. Called after boot and whenever a configuration comes into force, while the node is off the
//   air: it may take 50 ms. Returns why the link did not come up, at most 31 characters, and then uses the
//   UART; empty if it came up
// - link_write(frame): queues one whole frame for the host, or nothing and returns false
// - link_answer(frame): as link_write(), over the link that last delivered bytes to the node
// - count_link(counters): updates link_bytes_lost and the CAN fields
// - store_config(blob): replaces the stored blob, which survives resets and power cuts; false: not stored. An
//   empty blob erases it. May take 100 ms: the node leaves the air before
// - load_config(out): copies the stored blob to `out` and returns its size; 0: there is none, or it does not
//   fit
// - cipher(): AES-128; outlives the node
// - set_indicator(i): shows `i` until the next call
// - restart(): resets the microcontroller. A simulated one may return; the node then does nothing until
//   start()
// - reset_reason(), last_fault(): of the boot before this run
// - boot_count(): number of this boot, counted from 1 over resets and power cuts; 0: it could not be counted
// - proof_of_life(): feeds the watchdog; no other call does. The node calls it only from a radio interrupt:
//   after a completed superframe, or after a completed listening while searching or unconfigured (each
//   second). If the radio does not come up or its interrupt fails, the watchdog resets the node
// - stack_use(): the present state
template <class P>
concept Platform = requires(P& platform, std::uint32_t duration_us, std::span<const std::uint8_t> bytes,
                            std::span<std::uint8_t> out, Indicator indicator, const groma_Config& config,
                            groma_Counters& counters) {
  requires radio::Radio<typename P::Radio> &&
      std::constructible_from<typename P::Radio, decltype(platform.spi())>;
  { platform.reset_radio() } -> std::same_as<void>;
  { platform.delay_us(duration_us) } -> std::same_as<void>;
  { platform.now_us() } -> std::same_as<std::uint64_t>;
  { platform.radio_interrupt_us() } -> std::same_as<std::uint64_t>;
  { platform.configure_link(config) } -> std::same_as<const char*>;
  { platform.link_write(bytes) } -> std::same_as<bool>;
  { platform.link_answer(bytes) } -> std::same_as<bool>;
  { platform.count_link(counters) } -> std::same_as<void>;
  { platform.store_config(bytes) } -> std::same_as<bool>;
  { platform.load_config(out) } -> std::same_as<std::size_t>;
  { platform.cipher() } -> std::same_as<security::BlockCipher&>;
  { platform.set_indicator(indicator) } -> std::same_as<void>;
  { platform.restart() } -> std::same_as<void>;
  { platform.reset_reason() } -> std::same_as<ResetReason>;
  { platform.last_fault() } -> std::same_as<std::optional<Fault>>;
  { platform.boot_count() } -> std::same_as<std::uint32_t>;
  { platform.proof_of_life() } -> std::same_as<void>;
  { platform.stack_use() } -> std::same_as<StackUse>;
};

}  // namespace groma::node
