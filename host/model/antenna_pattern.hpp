// How an antenna's delay varies with direction, by quadrupole terms: they are even in the direction, unlike
// the effect of a lever-arm error, which is a dipole.
#pragma once

#include <Eigen/Core>

namespace groma::model {

inline constexpr int kPatternTerms = 5;
using PatternTerms = Eigen::Matrix<double, kPatternTerms, 1>;

// d(range)/d(coefficient in m) for a unit vector along the line of sight, in the frame that the antenna is
// fixed to. The vector's sign does not matter.
[[nodiscard]] inline PatternTerms pattern_terms(const Eigen::Vector3d& direction) noexcept {
  const double x = direction.x();
  const double y = direction.y();
  const double z = direction.z();
  PatternTerms out;
  out << x * x - y * y, 2.0 * x * y, 2.0 * x * z, 2.0 * y * z, 3.0 * z * z - 1.0;
  return out;
}

}  // namespace groma::model
