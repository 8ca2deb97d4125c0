// Working state of calibrate(): each step fills in its part.
#pragma once

#include <vector>

#include "host/calibration/association.hpp"
#include "host/calibration/drive_error.hpp"
#include "host/calibration/los_chain.hpp"
#include "host/calibration/los_solver.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/calibration/verdict.hpp"

namespace groma::calibration {

// Vectors outside `association` are in the order of association.anchors.
struct Site {
  Association association;
  PollTable polls;
  std::vector<AnchorFit> beginning;  // solved without the held-out part
  std::vector<AnchorFit> fits;       // solved from the whole drive
  SiteLos los_states;                // empty if no pair is NLOS for longer than a moment
  std::vector<AnchorEvidence> evidence;
  DriveError error;

  [[nodiscard]] bool has_los_states() const noexcept { return !los_states.anchors.empty(); }
};

}  // namespace groma::calibration
