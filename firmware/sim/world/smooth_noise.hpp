// Noise that varies smoothly along one or two coordinates: ground heights, slow drift of a pose prior, the
// delay within a wall. It has no state and does not depend on the order of the calls.
#pragma once

#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {

// Both are cubic B-splines over keyed normal draws at the whole numbers: twice continuously differentiable,
// mean 0, variance 1 within 5 % (10 % in two coordinates), uncorrelated beyond 4 units.
[[nodiscard]] double smooth_noise(const KeyedRandom& random, double u) noexcept;
[[nodiscard]] double smooth_noise(const KeyedRandom& random, double u, double v) noexcept;

}  // namespace groma::sim
