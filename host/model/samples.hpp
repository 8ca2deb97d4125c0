// Samples in the order that estimators take them in.
#pragma once

#include <vector>

#include "host/model/types.hpp"

namespace groma::model {

// By time, then tag, then anchor.
void sort_ranges(std::vector<RangeSample>& ranges);

// By time. Of poses of one instant the first is kept: an interval of no length could not be interpolated.
void sort_poses(std::vector<PoseSample>& poses);

}  // namespace groma::model
