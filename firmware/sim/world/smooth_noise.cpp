#include "firmware/sim/world/smooth_noise.hpp"

#include <array>
#include <cmath>
#include <cstdint>

namespace groma::sim {

namespace {

// The sum of the squares of the four weights, averaged over a cell.
constexpr double kMeanSquare = 151.0 / 315.0;

struct Cell {
  std::int64_t index;
  std::array<double, 4> weights;
};

Cell cell_of(double u) noexcept {
  const double floor = std::floor(u);
  const double t = u - floor;
  const double s = 1.0 - t;
  return {static_cast<std::int64_t>(floor),
          {s * s * s / 6.0, (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
           (-3.0 * t * t * t + 3.0 * t * t + 3.0 * t + 1.0) / 6.0, t * t * t / 6.0}};
}

}  // namespace

double smooth_noise(const KeyedRandom& random, double u) noexcept {
  const Cell cell = cell_of(u);
  double sum = 0.0;
  for (std::size_t i = 0; i < 4; ++i) {
    const auto knot = static_cast<std::uint64_t>(cell.index + static_cast<std::int64_t>(i));
    sum += cell.weights[i] * random.of(knot).normal();
  }
  return sum / std::sqrt(kMeanSquare);
}

double smooth_noise(const KeyedRandom& random, double u, double v) noexcept {
  const Cell across = cell_of(u);
  double sum = 0.0;
  for (std::size_t i = 0; i < 4; ++i) {
    const auto knot = static_cast<std::uint64_t>(across.index + static_cast<std::int64_t>(i));
    sum += across.weights[i] * smooth_noise(random.of(knot), v);
  }
  return sum / std::sqrt(kMeanSquare);
}

}  // namespace groma::sim
