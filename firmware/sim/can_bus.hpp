// One CAN bus: arbitration, exact bit lengths, acknowledgement, error frames.
//
//   CanBus bus;
//   CanTap host(bus, {.nominal = can_bit_time(1'000'000), .data = can_bit_time(2'000'000), .fd = true});
//   Mcp2518fdChip chip(bus, {});
//   bus.advance(t);
//   for (const TimedCanFrame& frame : host.take(t)) ...
//
// Stations are not advanced in step: one may post a frame for an instant that another has already passed.
// The bus therefore decides which frame starts only kLookahead after the start. kLookahead is shorter than
// the shortest frame, so the decision is made before the frame's end. A frame that is posted even later
// starts when the bus is free after the frame's own instant. The same calls give the same run.
//
// Bit rates are enforced: a frame is sent at its sender's rates. A receiver with other rates, or without CAN
// FD, destroys it with an error frame, as on a real bus.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <string>
#include <vector>

#include "firmware/sim/time.hpp"
#include "proto/can_segment.hpp"

namespace groma::sim {

[[nodiscard]] constexpr SimTime can_bit_time(std::uint32_t bit_per_s) noexcept {
  return (kUnitsPerSecond + bit_per_s / 2) / bit_per_s;
}

struct CanRates {
  SimTime nominal = can_bit_time(1'000'000);  // bit time
  SimTime data = can_bit_time(2'000'000);
  bool fd = true;  // supports CAN FD
};

enum class CanError : std::uint8_t {
  kAcknowledge,  // no station acknowledged
  kBit,          // the bit on the bus differs from the bit sent
};

class CanStation {
 public:
  CanStation() = default;
  CanStation(const CanStation&) = delete;
  CanStation& operator=(const CanStation&) = delete;
  virtual ~CanStation() = default;

  struct Offer {
    SimTime since = 0;  // the earliest start
    const wire::CanFrame* frame = nullptr;
    bool error_passive = false;
    bool can_check_own_bits = true;  // at the frame's rates, despite the transceiver's delay
  };

  // The frame that the station would send next. The frame must live until sent() or send_failed().
  [[nodiscard]] virtual std::optional<Offer> offer() const = 0;
  // The station receives, acknowledges and sends error flags.
  [[nodiscard]] virtual bool participates() const = 0;
  // The station's error flags are recessive: it cannot destroy a frame.
  [[nodiscard]] virtual bool error_passive() const = 0;
  [[nodiscard]] virtual const CanRates& rates() const = 0;

  // A frame of any station begins at t: the bus is no longer recessive.
  virtual void frame_begins(SimTime t) = 0;
  virtual void sent(SimTime end) = 0;
  virtual void send_failed(SimTime t, CanError error) = 0;
  virtual void received(const wire::CanFrame& frame, SimTime end) = 0;
  virtual void receive_failed(SimTime t) = 0;
};

struct CanBusCounters {
  std::uint64_t frames = 0;
  std::uint64_t errors = 0;  // frames that an error frame destroyed
  SimTime busy = 0;          // frames and error frames, each with the intermission after it
};

class CanBus {
 public:
  static constexpr SimTime kLookahead = 55 * kUnitsPerMicrosecond;

  CanBus() = default;
  CanBus(const CanBus&) = delete;
  CanBus& operator=(const CanBus&) = delete;

  // The station must outlive the last call of advance().
  void attach(CanStation& station) { stations_.push_back(&station); }

  void advance(SimTime t);
  [[nodiscard]] SimTime next_event() const;
  [[nodiscard]] SimTime now() const noexcept { return now_; }

  // Injects error frames: every frame on the bus between the two instants is destroyed.
  void damage(SimTime from, SimTime until) { disturbances_.push_back({from, until, false}); }
  // Models a short circuit: frames on the bus are destroyed, and the bus is never idle.
  void hold_dominant(SimTime from, SimTime until) { disturbances_.push_back({from, until, true}); }
  // The time since which the bus has been recessive; nullopt while it is not.
  [[nodiscard]] std::optional<SimTime> recessive_since(SimTime t) const;

  [[nodiscard]] const CanBusCounters& counters() const noexcept { return counters_; }
  // The first misuse of the bus, for example two stations that send the same id at once; empty without one.
  [[nodiscard]] const std::string& fault() const noexcept { return fault_; }

 private:
  struct Transmission {
    CanStation* sender = nullptr;
    wire::CanFrame frame;
    SimTime begin = 0;
    SimTime end = 0;  // of the frame, or of the error frame
    SimTime fails_at = kNever;
    CanError error = CanError::kBit;
  };
  struct Disturbance {
    SimTime from;
    SimTime until;
    bool dominant;
  };

  [[nodiscard]] SimTime next_start() const;
  void begin(SimTime start);
  void finish();
  [[nodiscard]] bool understands(const CanStation& station, const Transmission& transmission) const;

  std::vector<CanStation*> stations_;
  std::vector<Disturbance> disturbances_;
  std::optional<Transmission> transmission_;
  SimTime now_ = 0;
  SimTime free_at_ = 0;  // end of the intermission
  SimTime recessive_since_ = 0;
  CanBusCounters counters_;
  std::string fault_;
};

struct TimedCanFrame {
  SimTime t = 0;  // the end of frame
  wire::CanFrame frame;
};

// An ideal controller that the caller drives.
class CanTap final : public CanStation {
 public:
  CanTap(CanBus& bus, const CanRates& rates);

  // Queues a frame that may start at t or later.
  void send(SimTime t, const wire::CanFrame& frame) { queue_.push_back({t, frame}); }
  // Takes the received frames that ended by t. The bus must have been advanced to t.
  [[nodiscard]] std::vector<TimedCanFrame> take(SimTime t);
  // While disconnected it neither sends, receives nor acknowledges.
  void set_connected(bool on) noexcept { connected_ = on; }
  [[nodiscard]] std::uint64_t failures() const noexcept { return failures_; }
  [[nodiscard]] std::size_t waiting() const noexcept { return queue_.size(); }

  [[nodiscard]] std::optional<Offer> offer() const override;
  [[nodiscard]] bool participates() const override { return connected_; }
  [[nodiscard]] bool error_passive() const override { return false; }
  [[nodiscard]] const CanRates& rates() const override { return rates_; }
  void frame_begins(SimTime) override {}
  void sent(SimTime) override { queue_.pop_front(); }
  void send_failed(SimTime, CanError) override { ++failures_; }
  void received(const wire::CanFrame& frame, SimTime end) override { received_.push_back({end, frame}); }
  void receive_failed(SimTime) override { ++failures_; }

 private:
  CanRates rates_;
  bool connected_ = true;
  std::deque<TimedCanFrame> queue_;
  std::deque<TimedCanFrame> received_;
  std::uint64_t failures_ = 0;
};

}  // namespace groma::sim
