// The site on a map: walls and anchors.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "host/model/calibration.hpp"
#include "host/report/chart.hpp"

namespace groma::report {

using WallLine = std::pair<Eigen::Vector2d, Eigen::Vector2d>;  // map frame, m

struct Walls {
  std::vector<WallLine> opaque;
  std::vector<WallLine> others;  // racks, partitions, machines
};

void add_walls(Chart& map, const Walls& walls);

// Adds the anchors that have a position, with their 95 % ellipses, by the tone of their verdicts. A click on
// an anchor leads to its part of the page if `has_parts`.
void add_anchors(Chart& map, const model::Calibration& calibration, bool has_parts = false);

// The id of an anchor's part of a page.
[[nodiscard]] std::string anchor_part(model::NodeId id);

// The ink of an anchor with this verdict.
[[nodiscard]] Ink anchor_ink(model::AnchorVerdict verdict);

}  // namespace groma::report
