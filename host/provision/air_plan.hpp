// Predicts the performance of a schedule before any node is configured: durations, range rates and the load
// of each link.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "groma.pb.h"

namespace groma::provision {

// One link for reports to the host.
struct LinkLoad {
  std::string name;                // "UART", "CAN", "CAN FD"
  double report_bytes = 0.0;       // of one exchange's report, framed
  double busy = 0.0;               // utilization by these reports; above 1: they do not fit
  double most_ranges_per_s = 0.0;  // at full utilization
};

struct AirPlan {
  double superframe_s = 0.0;
  double beacon_s = 0.0;  // durations of the beacon's slot, the shared slot and one tag slot
  double shared_s = 0.0;
  double slot_s = 0.0;
  std::size_t slots = 0;
  std::size_t tags = 0;       // more than slots if tags out of each other's reach share one
  std::size_t responses = 0;  // anchors in one exchange
  // Without loss, of all tags together, at most one exchange a tag and superframe. A POLL's places for
  // trials of unused anchors yield no range; if tags share a slot, unused anchors are taken to be out of
  // reach.
  double ranges_per_s = 0.0;
  double tag_ranges_per_s = 0.0;
  // If the frames followed each other without a pause.
  double bound_ranges_per_s = 0.0;
  double air_use = 0.0;  // share of the time in which any node transmits, in one cell
  // Share of the time in which a node transmits.
  double tag_duty = 0.0;
  double anchor_duty = 0.0;           // one that answers in each slot
  double master_duty = 0.0;           // such an anchor that also sends the beacons
  double open_slots_per_s = 0.0;      // for joining and commands over the air
  std::vector<LinkLoad> links;        // UART: of one tag on its own line; CAN: of all tags on one bus
  std::vector<std::string> warnings;  // full sentences for the integrator
};

// `config` must pass node::fault_of(); it gives the CAN bit rates. `baud`: of the UART, in bit/s.
[[nodiscard]] AirPlan plan_air(const groma_Config& config, unsigned baud);

// The share of ranges that remains if each frame is received with this probability, 0 to 1: a range needs
// POLL, RESPONSE and the closing frames.
[[nodiscard]] double range_success(groma_RangingMethod method, double frame_success);

}  // namespace groma::provision
