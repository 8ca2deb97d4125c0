// What a calibration is made from: one drive's ranges and poses, and what is known beforehand.
#pragma once

#include <span>

#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// All spans are sorted by time and outlive the calibration.
struct Drive {
  std::span<const model::RangeSample> ranges;
  std::span<const model::PoseSample> poses;
  std::span<const model::Tag> tags;
  const model::Surface* surface = nullptr;  // attitude of poses without roll and pitch
  model::RangePriors priors;
  std::span<const model::AnchorRange> anchor_ranges = {};  // of a survey, in any order; may be empty
  std::span<const model::Anchor> known_anchors = {};       // surveyed: their biases alone are estimated
};

}  // namespace groma::calibration
