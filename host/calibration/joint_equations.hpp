// The normal equations of all anchors and of what they share, with the anchors eliminated.
#pragma once

#include <span>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "host/calibration/shared_unknowns.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {

// One anchor's part, solved for the anchor: its step is information^-1 descent - gain times the shared step.
struct AnchorPart {
  Eigen::LLT<Eigen::MatrixXd> information;
  Eigen::VectorXd descent;
  Eigen::MatrixXd gain;  // information^-1 times the cross information with the shared unknowns
};

struct JointEquations {
  std::vector<AnchorPart> anchors;
  Eigen::MatrixXd information;  // of the shared unknowns (Schur complement), their prior left out
  Eigen::VectorXd descent;
};

// `inflation` of each anchor: its ranges carry so many times less than were they independent.
[[nodiscard]] JointEquations eliminate_anchors(std::span<const AnchorFit> fits,
                                               std::span<const double> inflation,
                                               const SharedUnknowns& unknowns);

}  // namespace groma::calibration
