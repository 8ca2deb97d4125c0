// What a diagnosis looks at: the samples of one drive, as given. Each table may be empty.
#pragma once

#include <algorithm>
#include <optional>
#include <span>
#include <vector>

#include "host/model/anchor_parameters.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::diagnosis {

// The pose that the drive is said to start from.
struct GivenStart {
  double t_s = 0.0;
  model::PlanarPose pose = {};
};

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
  std::optional<GivenStart> start = std::nullopt;  // of a filter or a smoother
};

// Of the tag that is farthest from base_link.
[[nodiscard]] inline double longest_lever_arm_m(std::span<const model::Tag> tags) noexcept {
  double longest_m = 0.0;
  for (const model::Tag& tag : tags) longest_m = std::max(longest_m, tag.lever_arm_m.norm());
  return longest_m;
}

}  // namespace groma::diagnosis
