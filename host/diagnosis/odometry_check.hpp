// Compares poses with odometry, without ranges.
#pragma once

#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"

namespace groma::diagnosis {

struct OdometryComparison {
  std::vector<Finding> findings;
  // Whether the odometry explains the poses, after the corrections: headings are then those of the motion.
  bool explains = false;
};

// Divides the drive into windows of a second. The motion within each, as the poses show it, is compared with
// the integral of the odometry over it. One robust estimate gives clock offset and drift, heading offset, the
// scales of speed and yaw rate and the yaw-rate bias together; it is repeated with the heading or the lateral
// speed of the other sign, and the likeliest one counts. Names clock-offset, clock-drift, heading-offset,
// heading-sign, lateral-sign, yaw-rate-sign, yaw-rate-scale, odometry-scale, angle-unit and length-unit of
// the odometry, or poses-contradict-odometry if no estimate explains the motion. Corrects poses and odometry.
[[nodiscard]] OdometryComparison compare_with_odometry(Data& data);

}  // namespace groma::diagnosis
