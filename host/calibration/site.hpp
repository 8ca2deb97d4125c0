// What is known of a drive while calibrate() works: each step fills in its part.
#pragma once

#include <limits>
#include <optional>
#include <vector>

#include "host/calibration/association.hpp"
#include "host/calibration/drive_error.hpp"
#include "host/calibration/moved.hpp"
#include "host/calibration/sight_chain.hpp"
#include "host/calibration/sight_solver.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/calibration/verdict.hpp"

namespace groma::calibration {

// The last part of the drive, scored with the solution of what was before.
struct HeldOut {
  std::optional<double> rms_m;
  std::optional<double> robust_rms_m;
  std::optional<double> share_of_scale;  // robust rms over what the fit expects; none where it cannot tell
  double height_variance_m2 = std::numeric_limits<double>::infinity();  // that the fit expects
};

// All vectors but the association's are in the order of the association's anchors.
struct Site {
  Association association;
  PollTable polls;
  double held_out_from_s = 0.0;
  std::vector<AnchorFit> beginning;  // solved without what is held out
  std::vector<AnchorFit> fits;       // solved from all of the drive
  SiteSight sight;                   // empty where no range is NLOS for longer than a moment
  std::vector<AnchorPath> paths;
  std::vector<AnchorEvidence> evidence;
  std::vector<HeldOut> held_out;
  DriveError error;

  [[nodiscard]] bool has_sight() const noexcept { return !sight.anchors.empty(); }
};

}  // namespace groma::calibration
