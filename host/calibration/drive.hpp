// Input of a calibration: the ranges and poses of one drive, and prior knowledge.
#pragma once

#include <span>

#include "host/model/anchor_parameters.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// Samples are sorted by time. All spans must outlive the calibration.
struct Drive {
  std::span<const model::RangeSample> ranges;
  std::span<const model::PoseSample> poses;
  std::span<const model::Tag> tags;
  const model::Surface* surface = nullptr;  // attitude of poses without roll and pitch
  model::RangePriors priors;
  std::span<const model::AnchorRange> anchor_ranges = {};  // between anchors, in any order; may be empty
  std::span<const model::Anchor> known_anchors = {};       // surveyed: only their biases are estimated
};

}  // namespace groma::calibration
