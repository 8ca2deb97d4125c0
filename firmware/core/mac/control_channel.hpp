// What travels in the shared slots and rides on beacons beside the beat itself: joining, and messages.
//
// A station asks its channels, in the order in which they were attached, and the first that has something to
// send gets the open slot. What a channel decides is its own: when to back off, what to repeat, what to pass
// on.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

// All calls come between two events of the station's node, in its context.
class ControlChannel {
 public:
  struct Outgoing {
    std::uint16_t destination = kBroadcast;
    Body body{};  // a Join or a Data
  };

  // The shared slot of superframe `number` is the next thing to do, it is open to all, and this node knows
  // the time well enough to send. Nothing: it listens. Called once for each such slot.
  [[nodiscard]] virtual std::optional<Outgoing> open_slot(std::uint32_t number) noexcept = 0;
  // This back-up's own turn in the shared slot of superframe `number` is the next thing to do. What comes is
  // sent in the place of the beacon that it would relay, at most every other turn of its; nothing: it relays.
  [[nodiscard]] virtual std::optional<Outgoing> own_turn(std::uint32_t /*number*/) noexcept {
    return std::nullopt;
  }
  // It may well send in the next open slot: to arm the listening there ahead of time would only cost time.
  [[nodiscard]] virtual bool wants_slot() const noexcept { return false; }
  // What open_slot() or own_turn() gave has left the antenna, or was too late for it. Whether anybody heard
  // it is not known.
  virtual void on_sent(std::uint32_t number, bool sent) noexcept = 0;

  // A JOIN or a DATA of this network, whatever its destination, heard in superframe `number`. `leading`: this
  // node is the acting master.
  virtual void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept = 0;

  // A beacon of the network that this node is in step with, the master's or a relayed one.
  virtual void on_beacon(const Frame& frame, const Beacon& beacon) noexcept = 0;

  // This node is about to send a beacon: its own as the acting master's (`leading`), whose holders it may
  // change, or one that it relays; either may carry a welcome.
  virtual void on_beacon_out(Beacon& beacon, bool leading) noexcept = 0;

 protected:
  ~ControlChannel() = default;
};

}  // namespace groma::mac
