// Identifies the samples that a calibration was computed from.
#pragma once

#include <span>
#include <string>

#include "host/model/types.hpp"

namespace groma::daemon {

// Hexadecimal SHA-256 of the samples in the given order, as little-endian doubles and ids: ranges (t_s, tag,
// anchor, range_m), then poses (seven numbers, then the covariance if there is one).
[[nodiscard]] std::string sample_digest(std::span<const model::RangeSample> ranges,
                                        std::span<const model::PoseSample> poses);

}  // namespace groma::daemon
