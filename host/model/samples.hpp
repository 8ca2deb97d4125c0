// Sorts samples into the order that the estimators require.
#pragma once

#include <vector>

#include "host/model/types.hpp"

namespace groma::model {

// By time, then tag, then anchor.
void sort_ranges(std::vector<RangeSample>& ranges);

// By time. Of poses with equal times the first is kept: an empty interval could not be interpolated.
void sort_poses(std::vector<PoseSample>& poses);

}  // namespace groma::model
