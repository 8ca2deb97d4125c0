// The kernel's density from its definition, one kind after the other; no table.
#pragma once

#include <cmath>
#include <numbers>

#include "host/calibration/robust_kernel.hpp"

namespace groma::test {

inline double normal_density(double x, double mean, double variance) {
  return std::exp(-0.5 * (x - mean) * (x - mean) / variance) / std::sqrt(2.0 * std::numbers::pi * variance);
}

// 1/m
inline double exact_density(const calibration::KernelShape& shape, double residual_m) {
  const double square_m2 = shape.scale_m * shape.scale_m;
  double core = 1.0 - shape.wide - shape.gross;
  double out = shape.gross / (1000.0 * shape.scale_m);
  out += shape.wide * normal_density(residual_m, 0.0, 8.0 * square_m2);
  double excess_m = 3.0 * shape.scale_m;
  for (const double bump : shape.bumps) {
    out += bump * normal_density(residual_m, excess_m, excess_m * excess_m / 9.0 + square_m2);
    core -= bump;
    excess_m *= 2.0;
  }
  return out + core * normal_density(residual_m, 0.0, square_m2);
}

}  // namespace groma::test
