// Checks of single tables and of their times, without an estimate. Each names a mistake that would spoil
// every comparison, and corrects it in the data if it can.
#pragma once

#include <set>
#include <string_view>
#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"

namespace groma::diagnosis {

// Tags that tags.csv lacks, and anchors that are not among `anchors`, but heard: `unknown-tag` and
// `unknown-anchor`. `where`: what lacks the anchors, and has none if there are no `anchors`.
[[nodiscard]] std::vector<Finding> find_unknown_nodes(const Data& data,
                                                      const std::set<model::NodeId>& anchors,
                                                      std::string_view where);

// Times that are not in seconds (`time-unit`, corrected) or do not overlap (`time-overlap`).
[[nodiscard]] std::vector<Finding> find_wrong_times(Data& data);

// Ranges that change by more, or far less, than the robot moves by its poses, or without any by its odometry:
// `length-unit`, corrected. Moves ranges that are then within bounds from dropped_ranges to ranges.
[[nodiscard]] std::vector<Finding> find_wrong_lengths(Data& data);

// Lever arms that are too long for a robot: `length-unit`. The unit is a guess; ranges that are compared with
// the motion tell it.
[[nodiscard]] std::vector<Finding> find_long_lever_arms(const Data& data);

// Yaw of poses in degrees: `angle-unit`, corrected.
[[nodiscard]] std::vector<Finding> find_wrong_angles(Data& data);

// Poses above or below the surface by a constant height: `surface-height`.
[[nodiscard]] std::vector<Finding> find_wrong_height(const Data& data);

}  // namespace groma::diagnosis
