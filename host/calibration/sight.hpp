// What is known of each range's way beside its residual: in sight, through a shadow, through a wall.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "host/calibration/robust_kernel.hpp"

namespace groma::calibration {

inline constexpr std::int32_t kNoEpisode = -1;

// The belief in one row's sight, from all but its own residual.
struct RowSight {
  float in_sight = 1.0F;
  float wall = 0.0F;
  // Of the rest, density of the row as it is, 1/m: a range through a shadow says nothing of where the anchor
  // is, so it does not change with the residual.
  float other_density = 0.0F;
  std::int32_t episode = kNoEpisode;  // of the anchor's stays behind a wall
};

// The belief in what walls add to an anchor's ranges: a part that all have in common, and one of each
// episode.
struct WallPrior {
  double mean_m = 0.4;
  double sigma_m = 0.2;
  double episode_sigma_m = 0.2;
};

// All rows of an anchor. Its unknowns then are position, beta and gamma of each tag, and, where there are
// rows behind walls, what those add: the common part, then the episodes' own.
struct AnchorSight {
  std::vector<RowSight> rows;  // by Observation::index
  bool behind_wall = false;    // in some of them
  std::size_t episodes = 0;
  WallPrior prior;
  RobustKernel wall;  // of what is left of a residual behind a wall

  // Unknowns beside position, beta and gamma.
  [[nodiscard]] std::size_t extra_unknowns() const noexcept { return behind_wall ? 1 + episodes : 0; }
};

}  // namespace groma::calibration
