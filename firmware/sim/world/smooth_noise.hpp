// Noise that varies smoothly along one or two coordinates: what is slow in the world (floors, errors of a
// localization, the inside of a wall) without a state that would tie it to the order of the questions.
#pragma once

#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {

// Both are cubic B-splines over keyed normal draws at the whole numbers: twice continuously differentiable,
// mean 0, variance 1 within 5 % (10 % in two coordinates), uncorrelated beyond 4 units.
[[nodiscard]] double smooth_noise(const KeyedRandom& random, double u) noexcept;
[[nodiscard]] double smooth_noise(const KeyedRandom& random, double u, double v) noexcept;

}  // namespace groma::sim
