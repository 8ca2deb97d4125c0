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

struct Budget {
  std::vector<BudgetTerm> terms;  // that apply
  Eigen::MatrixXd covariance;     // their sum
};

// Of one anchor. The first term is `solved`, the covariance by ranges, drive error and links, without the
// NLOS excesses.
[[nodiscard]] Budget covariance_budget(const Site& site, std::size_t index, const Eigen::MatrixXd& solved);

}  // namespace groma::calibration
