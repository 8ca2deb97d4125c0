// Inputs and outputs of the tag's and the anchor's state machines.
//
// Each event returns a Step: the radio's next action, and an exchange if one is complete. Each action except
// kNone leads to exactly one event: on_transmitted() or on_late() for a transmission; on_received() for a
// reception, or on_timeout() if it brought no frame. A reception that could not be armed in time starts at
// once instead, or counts as a time-out if its end has passed. If the radio was stopped, call resume()
// instead of the event.
//
// The caller also calls three functions while the radio or its bus is busy, so that MICs are computed and
// verified then: begin_verify(frame) when a frame's bytes have been read, before on_received() with them,
// starts the verification; finish_signing() just before a transmission's frame is written to the chip
// finishes the frame; precompute() after the Step's action is armed precomputes cipher blocks and returns the
// size on the air of the most likely next frame to send, 0 if not known. on_received() verifies each frame
// that it uses: without begin_verify() and precompute() it only takes longer.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/radio/link_quality.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

struct Reception {
  ClockTime timestamp{};
  bool timestamp_valid = false;
  std::span<const std::uint8_t> frame{};  // without its frame check
  radio::LinkQuality quality{};
};

// The slot for which an action is armed. Same values as groma.SlotKind of the schema, except the last.
enum class SlotKind : std::uint8_t { kBeacon, kShared, kPoll, kResponse, kFinal, kNone };

struct Action {
  enum class Kind : std::uint8_t {
    kNone,       // the radio stays off
    kTransmit,   // `frame`, its RMARKER leaving the antenna at `at`
    kListen,     // from `at` until `until`
    kListenNow,  // from now until `until`
  };
  Kind kind = Kind::kNone;
  SlotKind slot = SlotKind::kNone;
  ClockTime at{};
  ClockTime until{};
  // The latest instant for a preamble; the listening may end then.
  std::optional<ClockTime> preamble_until{};
  // Complete after finish_signing(); valid until the machine's next event.
  std::span<const std::uint8_t> frame{};
};

struct Step {
  Action action;
  // Evaluate after the action is armed; valid until the next exchange is complete.
  const Exchange* completed = nullptr;
};

}  // namespace groma::mac
