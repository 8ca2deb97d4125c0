// What a sensor tells that depends on the core state alone.
#pragma once

#include <Eigen/Core>

#include "host/filter/state.hpp"

namespace groma::filter {

template <int kSize>
struct CoreMeasurement {
  Eigen::Matrix<double, kSize, 1> innovation;      // measured less predicted
  Eigen::Matrix<double, kSize, kCoreSize> d_core;  // of what is predicted
  Eigen::Matrix<double, kSize, kSize> noise;       // covariance of all that is not in the core
};

}  // namespace groma::filter
