// The pose that a filter or smoother starts from, against the ranges of a window of the drive.
#pragma once

#include <optional>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/diagnosis/range_fit.hpp"
#include "host/diagnosis/window_scene.hpp"

namespace groma::diagnosis {

// `heading-offset`, `heading-sign` or `angle-unit` of the heading; `length-unit` or `map-mismatch` of the
// position. None if the ranges leave the pose open. `best`: the fit of the scene, which it explains.
[[nodiscard]] std::optional<Finding> find_wrong_start(const GivenStart& start, const WindowScene& scene,
                                                      const RangeFit& best);

}  // namespace groma::diagnosis
