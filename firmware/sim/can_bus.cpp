#include "firmware/sim/can_bus.hpp"

#include <algorithm>
#include <cstdlib>

#include "firmware/sim/can_bits.hpp"

namespace groma::sim {

namespace {

// The error flags of both sides one after the other (the worst case), and the delimiter.
constexpr unsigned kErrorFrameBits = 12 + 8;
// The bit at which a classic controller reads FDF, and at which wrong bit rates violate the stuffing at the
// latest.
constexpr unsigned kBitsToErrorFlag = 34;

// The two bit times differ by no more than resynchronization can correct.
bool close(SimTime a, SimTime b) noexcept {
  constexpr SimTime kTolerance = 100;  // a hundredth
  return std::abs(a - b) <= std::max(a, b) / kTolerance;
}

}  // namespace

void CanBus::advance(SimTime t) {
  for (;;) {
    if (transmission_) {
      if (transmission_->end > t) break;
      finish();
      continue;
    }
    const SimTime start = next_start();
    if (start == kNever || start + kLookahead > t) break;
    begin(start);
  }
  now_ = std::max(now_, t);
}

SimTime CanBus::next_event() const {
  if (transmission_) return transmission_->end;
  const SimTime start = next_start();
  return start == kNever ? kNever : start + kLookahead;
}

std::optional<SimTime> CanBus::recessive_since(SimTime t) const {
  if (transmission_ ? t >= transmission_->begin : t > next_start()) return std::nullopt;
  SimTime since = recessive_since_;
  for (const Disturbance& d : disturbances_) {
    if (!d.dominant) continue;
    if (d.from <= t && t < d.until) return std::nullopt;
    if (d.until <= t) since = std::max(since, d.until);
  }
  return since;
}

SimTime CanBus::next_start() const {
  SimTime start = kNever;
  for (const CanStation* station : stations_) {
    if (const auto offer = station->offer()) start = std::min(start, std::max(offer->since, free_at_));
  }
  return start;
}

bool CanBus::understands(const CanStation& station, const Transmission& transmission) const {
  const CanRates& own = station.rates();
  const CanRates& sender = transmission.sender->rates();
  if (!close(own.nominal, sender.nominal)) return false;
  if (transmission.frame.format == wire::CanFormat::kClassic) return true;
  if (!own.fd) return false;
  return !transmission.frame.bit_rate_switch || close(own.data, sender.data);
}

void CanBus::begin(SimTime start) {
  Transmission transmission;
  transmission.begin = start;
  CanStation::Offer winner;
  for (CanStation* station : stations_) {
    const auto offer = station->offer();
    if (!offer || offer->since > start) continue;
    if (winner.frame != nullptr && offer->frame->id == winner.frame->id && fault_.empty()) {
      fault_ = "CAN bus: two stations send the same id " + std::to_string(offer->frame->id) + " at once";
    }
    if (winner.frame == nullptr || offer->frame->id < winner.frame->id) {
      winner = *offer;
      transmission.sender = station;
    }
  }
  if (winner.frame == nullptr) return;
  transmission.frame = *winner.frame;
  const CanRates& rates = transmission.sender->rates();
  const CanBits bits = can_bits(transmission.frame, winner.error_passive);
  transmission.end = start + bits.nominal * rates.nominal + bits.data * rates.data;

  const auto fails = [&transmission](SimTime t, CanError error) {
    if (t >= transmission.fails_at) return;
    transmission.fails_at = t;
    transmission.error = error;
  };
  bool acknowledged = false;
  for (const CanStation* station : stations_) {
    if (station == transmission.sender || !station->participates()) continue;
    if (understands(*station, transmission)) {
      acknowledged = true;
    } else if (!station->error_passive()) {
      fails(start + kBitsToErrorFlag * rates.nominal, CanError::kBit);
    }
  }
  if (!winner.can_check_own_bits) fails(start + kBitsToErrorFlag * rates.nominal, CanError::kBit);
  if (!acknowledged) fails(transmission.end - kRecessiveEndBits * rates.nominal, CanError::kAcknowledge);
  for (const Disturbance& d : disturbances_) {
    if (d.from < transmission.end && d.until > start) {
      fails(std::max(start, d.from) + rates.nominal, CanError::kBit);
    }
  }
  if (transmission.fails_at != kNever) {
    transmission.end = transmission.fails_at + kErrorFrameBits * rates.nominal;
  }
  for (CanStation* station : stations_) station->frame_begins(start);
  transmission_ = transmission;
}

void CanBus::finish() {
  const Transmission done = *transmission_;
  transmission_.reset();
  const SimTime bit = done.sender->rates().nominal;
  free_at_ = done.end + kIntermissionBits * bit;
  recessive_since_ = done.end - kRecessiveEndBits * bit;
  counters_.busy += free_at_ - done.begin;
  std::erase_if(disturbances_, [&](const Disturbance& d) { return d.until <= done.begin; });
  if (done.fails_at != kNever) {
    ++counters_.errors;
    done.sender->send_failed(done.end, done.error);
    for (CanStation* station : stations_) {
      if (station != done.sender && station->participates()) station->receive_failed(done.end);
    }
    return;
  }
  ++counters_.frames;
  // Receivers first: their reaction to this frame must not collide with the sender's next one.
  for (CanStation* station : stations_) {
    if (station == done.sender || !station->participates()) continue;
    if (understands(*station, done)) {
      station->received(done.frame, done.end);
    } else {
      station->receive_failed(done.end);
    }
  }
  done.sender->sent(done.end);
}

CanTap::CanTap(CanBus& bus, const CanRates& rates) : rates_(rates) {
  bus.attach(*this);
}

std::vector<TimedCanFrame> CanTap::take(SimTime t) {
  std::vector<TimedCanFrame> out;
  while (!received_.empty() && received_.front().t <= t) {
    out.push_back(received_.front());
    received_.pop_front();
  }
  return out;
}

std::optional<CanStation::Offer> CanTap::offer() const {
  if (queue_.empty() || !connected_) return std::nullopt;
  return Offer{.since = queue_.front().t, .frame = &queue_.front().frame};
}

}  // namespace groma::sim
