// Compares ranges with odometry and a calibration, without poses: what `groma replay` and `smooth` have.
#pragma once

#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/model/calibration.hpp"

namespace groma::diagnosis {

// Solves the place of each ten seconds of dead reckoning under each hypothesis, as compare_with_poses()
// solves anchors: clock offset or drift of the ranges against the odometry, scale and sign of yaw rate, speed
// and lateral speed, yaw rate in degrees, swapped, mirrored or displaced tags, renumbered anchors, and the
// height of the surface. If none explains the ranges, names map-mismatch where the odometry puts most anchors
// elsewhere, relative to each other, than the calibration.
[[nodiscard]] std::vector<Finding> compare_with_calibration(Data& data,
                                                            const model::Calibration& calibration);

}  // namespace groma::diagnosis
