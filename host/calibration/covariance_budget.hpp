// Why an anchor may be further off than its ranges say: all that its covariance is made of, term by term.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/site.hpp"

namespace groma::calibration {

// One term: its name, and what it adds to the covariance of (position, beta of each tag, gamma of each tag).
struct BudgetTerm {
  const char* name = "";
  Eigen::MatrixXd adds;
};

// Of one anchor; the sum of all terms is its covariance. The first is `solved`, the covariance by ranges,
// drive error and links, without the excess of walls. A term that does not apply is left out.
[[nodiscard]] std::vector<BudgetTerm> covariance_budget(const Site& site, std::size_t anchor,
                                                        const Eigen::MatrixXd& solved);
[[nodiscard]] Eigen::MatrixXd total(const std::vector<BudgetTerm>& budget);

}  // namespace groma::calibration
