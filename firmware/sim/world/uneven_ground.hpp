// Ground that is flat except for areas with a slope and gentle waves.
#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>

#include "host/model/surface.hpp"

namespace groma::sim {

// A rectangle. Slope and waves grow smoothly from its border to their full size at edge_m inside.
struct UnevenArea {
  Eigen::Vector2d from_m = Eigen::Vector2d::Zero();
  Eigen::Vector2d to_m = Eigen::Vector2d::Zero();
  double edge_m = 2.0;
  Eigen::Vector2d slope = Eigen::Vector2d::Zero();  // dz/dx, dz/dy, from the corner from_m
  double height_m = 0.0;                            // standard deviation of the waves
  double wave_m = 4.0;                              // length scale of the waves
};

// Control heights at the grid's points. Outside all areas z is 0.
[[nodiscard]] model::BSpline uneven_ground(const model::BSpline::Grid& grid,
                                           const std::vector<UnevenArea>& areas, std::uint64_t seed);

}  // namespace groma::sim
