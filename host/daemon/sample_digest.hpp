// Which samples a calibration came from.
#pragma once

#include <span>
#include <string>

#include "host/model/types.hpp"

namespace groma::daemon {

// Hexadecimal SHA-256 of the samples, little-endian doubles and ids, as they are given: ranges (t_s, tag,
// anchor, range_m), then poses (all seven numbers).
[[nodiscard]] std::string sample_digest(std::span<const model::RangeSample> ranges,
                                        std::span<const model::PoseSample> poses);

}  // namespace groma::daemon
