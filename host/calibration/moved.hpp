// Anchors that moved during the drive, or whose id is duplicated: the stretches of the drive are solved
// separately.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"

namespace groma::calibration {

struct Site;

// How much each stretch of the drive gains from a position of its own, from the normal equations of a Huber
// cost at one solution: made in one pass over the observations, for all stretches.
class StretchGains {
 public:
  // Divides the fit's observations into bins of about equal number; without NLOS states.
  StretchGains(const AnchorFit& fit, std::size_t bins);

  // Bin i holds the observations [first_row[i], first_row[i + 1]).
  std::vector<std::size_t> first_row;
  // Decrease of the cost, with all other unknowns solved for, if the anchor is elsewhere in bins [from, to).
  [[nodiscard]] double gain(std::size_t from, std::size_t to) const;

 private:
  using Columns = Eigen::Matrix<double, Eigen::Dynamic, 3>;
  // Prefix sums over bins: information of the position, gradient by it, and L^-1 times the cross information
  // with all unknowns, with L L^T the information of all observations.
  std::vector<Eigen::Matrix3d> information_;
  std::vector<Eigen::Vector3d> gradient_;
  std::vector<Columns> half_cross_;
  Eigen::VectorXd half_gradient_;
};

// Shortest move in the plane, m, that counts as one. By hand; the tests of moves have 0.5 m, and
// Moved.FindsNoneWhereNoneMovedOverManyDrives holds with it.
inline constexpr double kMinMove_m = 0.15;

// Difference of two solutions of one anchor from different observations.
struct Shift {
  Eigen::Vector3d by_m = Eigen::Vector3d::Zero();  // later minus earlier, given equal biases
  double square_sigmas = 0.0;                      // squared Mahalanobis distance; 3 degrees of freedom
};
// Vectors and covariances are of position and biases only.
[[nodiscard]] Shift shift_between(const AnchorVector& earlier, const Eigen::MatrixXd& earlier_covariance,
                                  const AnchorVector& later, const Eigen::MatrixXd& later_covariance);

// Positions of one anchor during the drive.
struct AnchorPath {
  std::vector<double> moved_at_s;  // ascending; empty: it did not move
  Eigen::Vector3d last_move_m = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> places_m;  // before the first move, after it, ...; empty without moves
  // Second place, not separated from the first in time: duplicate id.
  std::optional<Eigen::Vector3d> duplicate_m;

  [[nodiscard]] bool has_moved() const noexcept { return !moved_at_s.empty(); }
};

// Fills in each anchor's path. The fit of an anchor that moved becomes that of the observations after its
// last move, and so do its NLOS states, if the site has any.
void find_moved(Site& site);

}  // namespace groma::calibration
