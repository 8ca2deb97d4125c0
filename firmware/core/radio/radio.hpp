// The seam between the node and its radio: the driver of a chip implements the concept Radio, and nothing
// above it names a chip. docs/explanation/porting.md describes another radio against it.
//
// A radio does one thing at a time: it transmits one frame, or listens for one, and reports the end by its
// interrupt line. Its times are instants of its own clock in the network's ticks (ranging/device_time.hpp). A
// radio whose counter has another tick, or fewer bits, extends and converts it.
#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/radio/link_quality.hpp"
#include "firmware/core/radio/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::radio {

struct Settings {
  Preamble preamble = Preamble::k128;
  // Nothing: the chip's own.
  std::optional<std::uint32_t> transmit_power{};  // as its register holds it
  std::optional<std::uint16_t> transmit_antenna_delay_dtu{};
  std::optional<std::uint16_t> receive_antenna_delay_dtu{};
};

enum class Start : std::uint8_t {
  kStarted,
  kLate,      // the instant had passed: nothing is sent or received, the radio is idle
  kTooClose,  // as kLate, but only the transmitter's power-up would have come too late
  kNotIdle,
  kTooLong,  // the frame does not fit
};

enum class EventKind : std::uint8_t {
  kNone,
  kTransmitted,
  kReceived,
  kPreambleTimeout,
  kSfdTimeout,
  kFrameTimeout,
  kCheckError,   // the frame check failed
  kHeaderError,  // the PHY header or the Reed-Solomon code failed
};

struct Event {
  EventKind kind = EventKind::kNone;
  ranging::DeviceTime timestamp{};        // of the RMARKER at the antenna, for kTransmitted and kReceived
  bool timestamp_valid = false;           // for kReceived: the leading edge was found and timestamped
  std::span<const std::uint8_t> frame{};  // for kReceived: no frame check; valid until the next operation
  LinkQuality quality{};                  // for kReceived
};

// Of the radio's chip.
struct Ambient {
  std::int16_t temperature_cdegc = 0;
  std::uint16_t supply_mv = 0;
};

// All calls are noexcept and come from one context.
// - bring_up(settings, reset, delay_us): resets and configures the radio, whose clock may start again.
//   `reset()` pulls its reset line, `delay_us(n)` waits. describe(result), an empty text for BringUp::kOk,
//   says in at most 31 characters why the radio is down
// - restart(delay_us): ends the present operation; returns whether the radio works and its clock has gone on
// - stop(): ends the present operation
// - woken(): the last bring-up found the chip asleep
// - warning(): what the host should know of a radio that came up; at most 47 characters, empty if nothing
// - pll_flags(): times that one of its clocks reported to lose its lock
// - phy(), transmit_antenna_delay(): since the last bring-up
// - now(): called at least every 1.2 s while the radio is up, so that it can extend a short counter
// - expect_length(bytes): a hint, the length of the next frame without its frame check; except while sending
// - load(timestamp, frame, complete): loads `frame` so that its RMARKER leaves the antenna at `timestamp`,
// less
//   than 8.6 s ahead, a result of transmit_timestamp_not_after() for phy() and transmit_antenna_delay().
//   `complete()` completes the bytes of `frame`; call it as late as possible. launch() starts the
//   transmission
// - receive_at(from, frame_timeout, preamble_timeout), receive_now(...): listens, from less than 8.6 s ahead,
//   until a frame has come, `frame_timeout` has passed, or no preamble came within `preamble_timeout`
//   (nothing: no such time-out). Between poll_event() and read_frame() it may arm the next listening
// - poll_event(): what ended the present operation, without the frame. The interrupt line is low afterwards.
//   A transmission that left as requested, to the radio's resolution, has the timestamp that was requested
// - read_frame(event, on_bytes): completes a kReceived, calls `on_bytes(bytes)` as soon as the frame is read,
//   and adds the quality only if that returns true
// - start_sampling(), and kSampling_us later finish_sampling(), in any operation
template <class R>
concept Radio = requires(R& radio, const R& known, const Settings& settings, ranging::DeviceTime at,
                         ranging::Ticks timeout, std::optional<ranging::Ticks> preamble_timeout,
                         std::span<const std::uint8_t> frame, Event& event, typename R::BringUp result,
                         void (*action)(), void (*delay_us)(std::uint32_t),
                         bool (*on_bytes)(std::span<const std::uint8_t>)) {
  { radio.bring_up(settings, action, delay_us) } -> std::same_as<typename R::BringUp>;
  { result == R::BringUp::kOk } -> std::same_as<bool>;
  { result == R::BringUp::kNoChip } -> std::same_as<bool>;
  { describe(result) } -> std::same_as<const char*>;
  { radio.restart(delay_us) } -> std::same_as<bool>;
  { radio.stop() } -> std::same_as<void>;
  { known.woken() } -> std::same_as<bool>;
  { known.warning() } -> std::same_as<const char*>;
  { known.pll_flags() } -> std::same_as<std::uint32_t>;
  { known.phy() } -> std::convertible_to<Phy>;
  { known.transmit_antenna_delay() } -> std::same_as<ranging::Ticks>;
  { radio.now() } -> std::same_as<ranging::DeviceTime>;
  { radio.expect_length(std::size_t{}) } -> std::same_as<void>;
  { radio.load(at, frame, action) } -> std::same_as<Start>;
  { radio.launch() } -> std::same_as<Start>;
  { radio.receive_at(at, timeout, preamble_timeout) } -> std::same_as<Start>;
  { radio.receive_now(timeout, preamble_timeout) } -> std::same_as<Start>;
  { radio.poll_event() } -> std::same_as<Event>;
  { radio.read_frame(event, on_bytes) } -> std::same_as<void>;
  { R::kSampling_us } -> std::convertible_to<std::uint32_t>;
  { radio.start_sampling() } -> std::same_as<void>;
  { radio.finish_sampling() } -> std::same_as<std::optional<Ambient>>;
};

}  // namespace groma::radio
