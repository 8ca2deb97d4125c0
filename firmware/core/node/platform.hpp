#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <type_traits>

#include "firmware/core/dw1000/spi.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "groma.pb.h"

namespace groma::node {

// What the node's lights tell.
enum class Indicator : std::uint8_t {
  kRadioFault,    // the DW1000 did not come up
  kUnconfigured,  // silent, waiting for a configuration
  kSearching,     // configured, no beacon heard yet
  kRanging,       // in step with the master, or the master itself
  kIdentify,      // "here I am", asked for by the host
};

// Same values as groma.ResetReason of the schema.
enum class ResetReason : std::uint8_t { kPowerOn, kPin, kWatchdog, kSoftware, kLockup, kFault };

// What the fault handler kept over the reset.
struct Fault {
  std::uint32_t pc = 0;
  std::uint32_t lr = 0;
  std::uint32_t cfsr = 0;
};

// Of the stack that the node runs on; 0: not known.
struct StackUse {
  std::uint32_t size_bytes = 0;
  std::uint32_t high_water_bytes = 0;  // the deepest that it has been since the reset
};

// What the image says of itself in its hello.
struct Build {
  const char* version = "";
  std::uint32_t git_hash = 0;
};

// The hardware a node stands on. Everything is called from one context: the one that calls the Node.
// - spi(): the bus to the radio; interrupts of the radio may come at any time during a transfer
// - reset_radio(): pulls the radio's reset line low, lets it float, returns when the chip may be spoken to
// - delay_us(n): returns after at least n microseconds
// - now_us(): microseconds since boot, 64 bits, monotonic; any drift
// - link_write(frame): queues one whole frame of bytes for the host, or nothing and returns false
// - store_config(blob): keeps the blob over resets and power cuts in place of the one before; false: not
//   stored. An empty blob erases it. May take 100 ms: the node has left the air before
// - load_config(out): copies the kept blob to `out`, returns its size; 0: there is none, or it does not fit
// - cipher(): AES-128; one that outlives the node
// - set_indicator(i): shows it until the next call
// - restart(): resets the microcontroller. A simulated one may return; the node then does nothing more until
//   start()
// - reset_reason(), last_fault(): of the boot before this run
// - boot_count(): this boot's number, counted from 1 up over resets and power cuts; 0: it could not be
// counted
// - proof_of_life(): feeds the watchdog, which nothing else does. Comes from a radio interrupt alone: after a
//   completed superframe, or after a completed listening while searching or unconfigured (each second). A
//   radio that does not come up, or whose interrupt stays away, gives none, and the watchdog resets the node
// - stack_use(): now
template <class P>
concept Platform = requires(P& platform, std::uint32_t duration_us, std::span<const std::uint8_t> bytes,
                            std::span<std::uint8_t> out, Indicator indicator) {
  { platform.spi() }
  noexcept;
  requires dw1000::Spi<std::remove_reference_t<decltype(platform.spi())>>;
  { platform.reset_radio() }
  noexcept->std::same_as<void>;
  { platform.delay_us(duration_us) }
  noexcept->std::same_as<void>;
  { platform.now_us() }
  noexcept->std::same_as<std::uint64_t>;
  { platform.link_write(bytes) }
  noexcept->std::same_as<bool>;
  { platform.store_config(bytes) }
  noexcept->std::same_as<bool>;
  { platform.load_config(out) }
  noexcept->std::same_as<std::size_t>;
  { platform.cipher() }
  noexcept->std::same_as<security::BlockCipher&>;
  { platform.set_indicator(indicator) }
  noexcept->std::same_as<void>;
  { platform.restart() }
  noexcept->std::same_as<void>;
  { platform.reset_reason() }
  noexcept->std::same_as<ResetReason>;
  { platform.last_fault() }
  noexcept->std::same_as<std::optional<Fault>>;
  { platform.boot_count() }
  noexcept->std::same_as<std::uint32_t>;
  { platform.proof_of_life() }
  noexcept->std::same_as<void>;
  { platform.stack_use() }
  noexcept->std::same_as<StackUse>;
};

// A platform that has more than one link to the host also has:
// - configure_link(config): from now on link_write() uses config.link, which is brought up for it; empty and
//   zero fields mean the UART. Called after boot and whenever a configuration comes into force, the node off
//   the air: it may take 50 ms. Returns why the link did not come up, in at most 31 characters, empty where
//   it did; the UART then serves in its place.
// - link_answer(frame): as link_write(), over the link whose bytes the node was given last
// - count_link(counters): brings link_bytes_lost and the CAN fields up to date
template <class P>
concept ChoosesLink = Platform<P> && requires(P& platform, const groma_Config& config,
                                              groma_Counters& counters, std::span<const std::uint8_t> bytes) {
  { platform.configure_link(config) }
  noexcept->std::same_as<const char*>;
  { platform.link_answer(bytes) }
  noexcept->std::same_as<bool>;
  { platform.count_link(counters) }
  noexcept->std::same_as<void>;
};

// The node on top of it (node.hpp), all calls noexcept and from one context:
//   Node<P> node(platform, build);
//   node.start()                 once after boot
//   node.on_radio_interrupt()    whenever the radio's interrupt line is high; returns with it low
//   node.on_link_bytes(bytes)    bytes from the host, in any pieces
//   node.next_deadline_us()      the now_us() at which on_timer() wants to be called; UINT64_MAX: never
//   node.on_timer()              harmless if early
// The radio's own slots never wait for on_timer(): it serves recovery, telemetry and the lights.

}  // namespace groma::node
