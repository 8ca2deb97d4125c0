// How an antenna's own delay varies with direction: the quadrupole terms, the lowest that differ neither in
// sign from a lever arm's error nor between the two ends of a line.
#pragma once

#include <Eigen/Core>

namespace groma::model {

inline constexpr int kPatternTerms = 5;
using PatternTerms = Eigen::Matrix<double, kPatternTerms, 1>;

// What each coefficient (m) adds to a range, by the line of sight's unit vector in the frame that the antenna
// is fixed to. Either sense of the line gives the same.
[[nodiscard]] inline PatternTerms pattern_terms(const Eigen::Vector3d& direction) noexcept {
  const double x = direction.x();
  const double y = direction.y();
  const double z = direction.z();
  PatternTerms out;
  out << x * x - y * y, 2.0 * x * y, 2.0 * x * z, 2.0 * y * z, 3.0 * z * z - 1.0;
  return out;
}

}  // namespace groma::model
