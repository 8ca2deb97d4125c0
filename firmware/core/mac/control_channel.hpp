// Users of the shared slots and of free space in beacons: joining, replay protection, and messages.
//
// The station asks its channels in the order in which they were attached; the first with something to send
// gets the open slot. Each channel decides itself when to back off, what to repeat and what to relay.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

// The station makes all calls between two of its events, in their context.
class ControlChannel {
 public:
  struct Outgoing {
    std::uint16_t destination = kBroadcast;
    Body body{};  // a Join or a Data
  };

  // The next action is the shared slot of superframe `number`, which is open to all, and this node knows the
  // time well enough to send. Returns nothing to listen. Called once for each such slot.
  [[nodiscard]] virtual std::optional<Outgoing> open_slot(std::uint32_t number) noexcept = 0;
  // The next action is this back-up's own turn in the shared slot of superframe `number`. A returned frame
  // replaces the beacon that it would relay, in at most every other turn; nothing: it relays.
  [[nodiscard]] virtual std::optional<Outgoing> own_turn(std::uint32_t /*number*/) noexcept {
    return std::nullopt;
  }
  // The channel may send in the next open slot, so arming its listening ahead would waste time.
  [[nodiscard]] virtual bool wants_slot() const noexcept { return false; }
  // The frame of open_slot() or own_turn() has been sent, or was too late. Whether another node received it
  // is not known.
  virtual void on_sent(std::uint32_t /*number*/, bool /*sent*/) noexcept {}

  // A JOIN or a DATA of this network to any destination, heard in superframe `number`. `leading`: this node
  // is the acting master.
  virtual void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept = 0;

  // A beacon of the followed network, from the master or a relay.
  virtual void on_beacon(const Frame& /*frame*/, const Beacon& /*beacon*/) noexcept {}

  // This node is about to send a beacon. As acting master (`leading`) it may change `owners`; otherwise it
  // relays. Either may add a challenge response.
  virtual void on_beacon_out(Beacon& /*beacon*/, bool /*leading*/) noexcept {}

 protected:
  ~ControlChannel() = default;
};

}  // namespace groma::mac
