// Calibration while driving: the whole of what the store kept is solved as one drive, and the anchors in use
// are looked for where they are said to be.
#pragma once

#include <optional>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/comparison.hpp"
#include "host/calibration/drive_store.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

struct LearningInput {
  std::optional<DriveStore::Snapshot> places;  // none: nothing is learnt in this step
  DriveStore::Snapshot recent;
  model::Calibration live;  // anchors in use
  std::vector<model::Tag> tags;
  model::Surface surface;
  model::RangePriors priors;
};

struct LearningStep {
  std::optional<Result> learnt;  // from all places, where they were given; its fitted ranges are left out
  DriveStore::Samples samples;   // that it was learnt from
  std::vector<AnchorChange>
      rechecked;  // anchors in use against the last of the drive; none as long as it is short
};

// Fewer segments do not tell whether an anchor was moved.
inline constexpr std::size_t kMinRecheckSegments = 20;

// As calibrate() of the samples that the store has. Its time and memory are bounded by the store's limits.
[[nodiscard]] LearningStep learn(const LearningInput& input);

// How much of what an anchor needs is there, 0 to 1: 1 once its verdict lets it be used; until then the least
// of its share of ranges and of the information (1/sigma^2) that the verdict asks for.
[[nodiscard]] double coverage(const model::AnchorCalibration& anchor);

// Whether a filter may use the anchor.
[[nodiscard]] bool carries(const model::AnchorCalibration& anchor) noexcept;

}  // namespace groma::calibration
