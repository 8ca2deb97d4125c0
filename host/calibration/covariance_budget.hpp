// Covariance budget of an anchor: all terms of its covariance, with errors that its ranges do not show.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/site.hpp"

namespace groma::calibration {

// One term: its name, and what it adds to the covariance of the anchor's parameters.
struct BudgetTerm {
  const char* name = "";
  Eigen::MatrixXd adds;
};

// Terms of one anchor that apply; their sum is its covariance. The first is `solved`, the covariance by
// ranges, drive error and links, without the NLOS excesses.
[[nodiscard]] std::vector<BudgetTerm> covariance_budget(const Site& site, std::size_t index,
                                                        const Eigen::MatrixXd& solved);
[[nodiscard]] Eigen::MatrixXd total(const std::vector<BudgetTerm>& budget);

}  // namespace groma::calibration
