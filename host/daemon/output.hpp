// A receiver of poses: the pose stream, and whatever else gromad gives them to.
#pragma once

#include <string_view>

#include "host/daemon/localizer.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {

// Called on the loop's thread for each pose: an output never waits, and bounds what it keeps for a slow
// receiver.
class Output {
 public:
  Output(const Output&) = delete;
  Output& operator=(const Output&) = delete;
  virtual ~Output() = default;

  // line: the pose as a line of the pose stream.
  virtual void on_pose(const PoseEstimate& pose, std::string_view line) = 0;
  // Another line of the pose stream: STATUS, CALIBRATION.
  virtual void on_line(std::string_view line) = 0;
  // The calibration in use from now on.
  virtual void on_calibration(const model::Calibration& /*calibration*/) {}

 protected:
  Output() = default;
};

}  // namespace groma::daemon
