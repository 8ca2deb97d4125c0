// Anchors that did not stay where they were, or that are in two places: the stretches of the drive solved
// apart.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/sight_solver.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {

// A move is one of at least this length in the plane.
inline constexpr double kMinMove_m = 0.15;

// How two solutions of one anchor differ, from different rows.
struct Shift {
  Eigen::Vector3d by_m = Eigen::Vector3d::Zero();  // later minus earlier, were their biases the same
  double square_sigmas = 0.0;                      // in the metric of its covariance; 3 degrees of freedom
};
// Vectors and covariances of position and biases alone.
[[nodiscard]] Shift shift_between(const AnchorVector& earlier, const Eigen::MatrixXd& earlier_covariance,
                                  const AnchorVector& later, const Eigen::MatrixXd& later_covariance);

struct Move {
  double t_s = 0.0;
  Shift shift;
};

// What one anchor's ranges tell of where it was.
struct AnchorPath {
  std::vector<Move> moves;                // by time; empty: it stayed
  std::vector<Eigen::Vector3d> places_m;  // before the first move, after it, and so on; where there are moves
  std::optional<Eigen::Vector3d> twin_m;  // another place that no time parts from its own
};

// Where an anchor was moved, its fit becomes that of the rows after its last move, and so does its sight,
// where the site has one. The result: of each anchor.
[[nodiscard]] std::vector<AnchorPath> find_moved(const PollTable& table, SiteSight& sight,
                                                 std::vector<AnchorFit>& fits,
                                                 const model::RangePriors& priors);

}  // namespace groma::calibration
