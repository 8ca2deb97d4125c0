// What a schedule will give before it is written into any node: how long everything takes, how many ranges
// come, and what of it each link carries.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "groma.pb.h"

namespace groma::provision {

// The least at which the shipped image sends nothing late, at 1.5 times the emulator's cost of an instruction
// too: scripts/rates.
inline constexpr unsigned kLeastTurnRound_us = 300;
inline constexpr unsigned kLeastGap_us = 120;

// One way for reports to the host.
struct LinkLoad {
  std::string name;                // "UART", "CAN", "CAN FD"
  double report_bytes = 0.0;       // of one exchange's report, framed
  double busy = 0.0;               // share of the time with these reports; above 1: they do not fit
  double most_ranges_per_s = 0.0;  // at which it would be busy all the time
};

struct AirPlan {
  double superframe_s = 0.0;
  double beacon_s = 0.0;  // of the superframe: the beacon's slot, the shared one, each tag's
  double shared_s = 0.0;
  double slot_s = 0.0;
  std::size_t slots = 0;
  std::size_t tags = 0;       // more than slots where some share one out of each other's reach
  std::size_t responses = 0;  // anchors in one exchange
  // At no loss, of all tags together, at most one exchange a tag and superframe. Places in which a tag tries
  // anchors that it does not use yield none; where tags share a slot, those anchors are out of reach.
  double ranges_per_s = 0.0;
  double tag_ranges_per_s = 0.0;
  // If the frames in use followed each other without a pause.
  double bound_ranges_per_s = 0.0;
  double air_use = 0.0;  // share of the time in which somebody is on the air, in one cell
  // Share of the time that a node transmits.
  double tag_duty = 0.0;
  double anchor_duty = 0.0;  // one that answers in each slot; the master's beacons on top
  double master_duty = 0.0;
  double open_slots_per_s = 0.0;      // for joining and commands over the air
  std::vector<LinkLoad> links;        // UART: of one tag on its own line; CAN: of all tags on one bus
  std::vector<std::string> warnings;  // what an integrator should change or know, in full sentences
};

// `config` is without fault (node::fault_of()); the link's bit rates are those it names. `baud`: of the UART.
[[nodiscard]] AirPlan plan_air(const groma_Config& config, unsigned baud);

// Of the ranges of a perfect air those that are left if each frame is received with this probability: a range
// needs POLL and RESPONSE, and what closes it.
[[nodiscard]] double range_success(groma_RangingMethod method, double frame_success);

}  // namespace groma::provision
