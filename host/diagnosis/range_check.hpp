// Compares ranges with poses, without knowing where the anchors are.
#pragma once

#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"

namespace groma::diagnosis {

// Solves the anchors from the poses under each hypothesis: clock offset or drift of the ranges, two tags
// swapped, all tags mirrored, the lever arm of one tag wrong, and unless the odometry shows the headings to
// be right, a heading offset or sign. The hypothesis under which the ranges are clearly likelier than as
// given is named and corrected, then the next one is looked for. Names clock-offset, clock-drift,
// swapped-tags, lateral-sign, lever-arm, heading-offset and heading-sign.
[[nodiscard]] std::vector<Finding> compare_with_poses(Data& data, bool heading_is_known);

// Compares where the ranges put the anchors with where anchors.csv has them, horizontally. Names
// renumbered-anchors if most that differ are where another id should be, and map-mismatch if most differ
// otherwise.
[[nodiscard]] std::vector<Finding> compare_with_survey(const Data& data);

}  // namespace groma::diagnosis
