// What goes in and out of the tag's and the anchor's state machines.
//
// Each event returns a Step: what the radio is to do next, and an exchange if one is complete. The machine
// expects exactly one event for each action but kNone: on_transmitted() or on_late() for a transmission;
// on_received(), on_timeout() or on_error() for a reception. A listening that could not be armed in time
// starts at once instead, or counts as a time-out when its end has passed. Or resume() instead of any, where
// the radio was stopped.
//
// Beside that it is told at three moments, so that codes are made and checked while the radio's bus or the
// air is busy: glance(frame) once a frame's bytes are there, before on_received() with them; complete() where
// a transmission's frame is about to be handed over, which it is not whole before; and prepare() once what a
// Step asked for is armed, which tells how many bytes are on the air of the frame that it will most likely
// send next; 0: open.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/dw1000/receive_quality.hpp"
#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

struct Reception {
  ranging::ClockTime stamp{};
  bool stamp_valid = false;
  std::span<const std::uint8_t> frame{};  // without its frame check
  dw1000::ReceiveQuality quality{};
};

struct Action {
  enum class Kind : std::uint8_t {
    kNone,       // the radio stays off
    kTransmit,   // `frame`, its RMARKER leaving the antenna at `at`
    kListen,     // from `at` until `until`
    kListenNow,  // from now until `until`
  };
  Kind kind = Kind::kNone;
  ranging::ClockTime at{};
  ranging::ClockTime until{};
  // A preamble that has not come by then will not come.
  std::optional<ranging::ClockTime> preamble_until{};
  // Whole after complete(); stays valid until the machine's next event.
  std::span<const std::uint8_t> frame{};
};

struct Step {
  Action action;
  // To be evaluated after the action is armed; stays valid until the next one is complete.
  const Exchange* completed = nullptr;
};

}  // namespace groma::mac
