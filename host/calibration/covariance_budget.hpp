// Covariance budget of an anchor: all terms of its covariance, with errors that its ranges do not show.
#pragma once

#include <cstddef>

#include <Eigen/Core>

#include "host/calibration/site.hpp"

namespace groma::calibration {

// Covariance of one anchor's position and terms: the sum of all terms that apply. `solved`: the covariance by
// ranges, drive error and links.
[[nodiscard]] Eigen::MatrixXd covariance_budget(const Site& site, std::size_t index,
                                                const Eigen::MatrixXd& solved);

}  // namespace groma::calibration
