// The configuration of a simulated run: site, nodes, drives, radio errors and links.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "firmware/sim/world/path.hpp"
#include "firmware/sim/world/robot.hpp"
#include "firmware/sim/world/site.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::sim {

// One drive of the robot. The next one begins where it ends, after a stop.
struct DriveLeg {
  std::string name;
  std::vector<Waypoint> waypoints;
};

// All drives as one path. The robot stops between two drives, so that they can be distinguished.
[[nodiscard]] std::vector<Waypoint> joined(const std::vector<DriveLeg>& drives);

// The distribution of the biases z = gamma d + beta of each pair of tag and anchor: Gaussian; beta is
// truncated.
struct BiasOptions {
  model::ScalarPrior beta_m{0.0, 0.0};
  double beta_min_m = -1.0;
  double beta_max_m = 1.2;
  model::ScalarPrior gamma{1.0, 0.0};
};

struct RadioOptions {
  double clock_ppm = 20.0;          // offset of each node's crystal, uniform within +-clock_ppm
  double timestamp_sigma_ns = 0.1;  // of each receive timestamp
  double loss = 0.02;               // of each frame at each receiver
  // See sim::ChipQuirks; not negative.
  double delayed_transmit_gain_ppm = 0.0;
};

// The superframe and the physical layer, as the nodes are configured.
struct ScheduleOptions {
  enum class Method { kFinal, kNextPoll };
  model::NodeId master_id = 0;                             // the anchor that sends the master beacon
  std::optional<std::vector<model::NodeId>> backup_ids{};  // by rank; nullopt: the default of a site plan
  Method method = Method::kNextPoll;
  unsigned preamble = 128;       // symbols: 64, 128 or 256
  unsigned turn_round_us = 350;  // turnaround: end of a received frame to the preamble of the reply
  unsigned response_gap_us =
      0;  // end of a RESPONSE to the preamble of the next; 0: the default of a site plan
  unsigned guard_us = 30;
  bool arm_ahead = false;
};

struct LinkOptions {
  unsigned bit_per_s = 1'000'000;  // 8N1: ten bits per byte
};

struct Scenario {
  std::string name;
  model::Surface ground;
  std::vector<Material> materials;
  std::vector<Wall> walls;
  RadioClimate climate;
  std::vector<model::Anchor> anchors;  // by id
  std::vector<model::Tag> tags;        // by id
  BiasOptions biases;
  PathOptions path;
  std::vector<DriveLeg> drives;  // at least one
  OdometryOptions odometry;
  PosePriorOptions pose_prior;
  RadioOptions radio;
  ScheduleOptions schedule;
  LinkOptions link;
  double range_sigma_m = 0.08;  // the nominal range noise given to the estimators
};

}  // namespace groma::sim
