#include "firmware/sim/world/uneven_ground.hpp"

#include <algorithm>
#include <utility>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/world/smooth_noise.hpp"

namespace groma::sim {

namespace {

// 0 on the border of the rectangle and outside, 1 at edge_m inside and beyond.
double weight(const UnevenArea& area, double x_m, double y_m) {
  const double inside_m =
      std::min({x_m - area.from_m.x(), area.to_m.x() - x_m, y_m - area.from_m.y(), area.to_m.y() - y_m});
  const double u = std::clamp(inside_m / area.edge_m, 0.0, 1.0);
  return u * u * (3.0 - 2.0 * u);
}

}  // namespace

model::BSpline uneven_ground(const model::BSpline::Grid& grid, const std::vector<UnevenArea>& areas,
                             std::uint64_t seed) {
  std::vector<double> heights;
  heights.reserve(static_cast<std::size_t>(grid.nx) * static_cast<std::size_t>(grid.ny));
  const KeyedRandom random(seed);
  for (int i = 0; i < grid.nx; ++i) {
    for (int j = 0; j < grid.ny; ++j) {
      // Control point i, j has most influence at the centre of its basis function.
      const double x = grid.x0_m + (i - 1) * grid.dx_m;
      const double y = grid.y0_m + (j - 1) * grid.dy_m;
      double z = 0.0;
      std::uint64_t key = 0;
      for (const UnevenArea& area : areas) {
        const double waves = smooth_noise(random.of(key++), x / area.wave_m, y / area.wave_m);
        const double rise = area.slope.x() * (x - area.from_m.x()) + area.slope.y() * (y - area.from_m.y());
        z += weight(area, x, y) * (rise + area.height_m * waves);
      }
      heights.push_back(z);
    }
  }
  return {grid, std::move(heights)};
}

}  // namespace groma::sim
