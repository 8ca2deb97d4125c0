// What a diagnosis looks at: the samples of one drive, as given. Each table may be empty.
#pragma once

#include <vector>

#include "host/model/anchor_parameters.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::diagnosis {

// Samples are sorted by time. A correction of a mistake changes this copy, so that the next one can be found.
struct Data {
  std::vector<model::PoseSample> poses;
  std::vector<model::OdometrySample> odometry;
  std::vector<model::RangeSample> ranges;          // of known tags and anchors, within bounds
  std::vector<model::RangeSample> dropped_ranges;  // out of bounds, or of unknown tags or anchors
  std::vector<model::Tag> tags;
  std::vector<model::Anchor> anchors;  // surveyed
  model::RangePriors priors;
  model::Surface surface;
};

}  // namespace groma::diagnosis
