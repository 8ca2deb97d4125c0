#include "firmware/core/mac/station.hpp"

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

Station::Station(const Site& site, groma_Counters& counters) noexcept
    : site_(site),
      superframe_(site.schedule, dw1000::Phy(site.preamble)),
      hash_(schedule_hash(site.schedule, site.network_id, site.preamble)),
      sync_(superframe_),
      counters_(counters) {}

std::optional<Frame> Station::accept(const Reception& reception) noexcept {
  const ParseResult parsed = parse(reception.frame);
  if (!parsed.frame) {
    ++(parsed.error == ParseError::kForeign ? counters_.foreign_frames : counters_.malformed_frames);
    return std::nullopt;
  }
  if (parsed.frame->network != site_.network_id) {
    ++counters_.foreign_frames;
    return std::nullopt;
  }
  const std::uint16_t destination = parsed.frame->destination;
  if (destination != site_.id && destination != kBroadcast) return std::nullopt;
  return parsed.frame;
}

bool Station::take_beacon(const Frame& frame, const Beacon& beacon, const Reception& reception) noexcept {
  if (frame.source != site_.schedule.master_id || beacon.epoch != site_.schedule.epoch ||
      beacon.schedule_hash != hash_) {
    ++counters_.stale_frames;
    return false;
  }
  if (!reception.stamp_valid) {
    ++counters_.bad_stamps;
    return false;
  }
  const std::int32_t offset_ppb = dw1000::clock_offset_ppb(reception.quality.carrier_integral);
  if (!sync_.on_beacon(beacon.superframe, reception.stamp, offset_ppb)) {
    ++counters_.bad_stamps;
    return false;
  }
  ++counters_.beacons_received;
  return true;
}

void Station::beacon_missed(std::uint32_t superframe) noexcept {
  ++counters_.beacons_missed;
  sync_.on_beacon_missed(superframe);
}

Action Station::transmit(ClockTime stamp, std::uint16_t destination, const Body& body) noexcept {
  outgoing_ = serialize({.sequence = sequence_++,
                         .network = site_.network_id,
                         .destination = destination,
                         .source = site_.id,
                         .body = body});
  return {.kind = Action::Kind::kTransmit, .at = stamp, .frame = outgoing_.bytes()};
}

Action Station::listen(ClockTime due, std::size_t bytes, Ticks slack) const noexcept {
  const Ticks guard = superframe_.guard() + slack;
  const dw1000::Phy phy = superframe_.phy();
  return {.kind = Action::Kind::kListen,
          .at = due - phy.before_rmarker() - guard,
          .until = due + dw1000::Phy::after_rmarker(bytes) + guard,
          .preamble_until = due + guard};
}

Action Station::listen_for_beacon(std::uint32_t superframe) const noexcept {
  return listen(beacon_due(superframe), kBeaconBytes, sync_.margin(superframe));
}

Action Station::search(ClockTime now) noexcept {
  constexpr Ticks kWhile = Ticks::from_us(50'000);
  return {.kind = Action::Kind::kListenNow, .until = now + kWhile};
}

Action Station::listen_on(const Action& interrupted) noexcept {
  return {.kind = Action::Kind::kListenNow,
          .until = interrupted.until,
          .preamble_until = interrupted.preamble_until};
}

}  // namespace groma::mac
