// Anchors that did not stay where they were, or that are in two places: the stretches of the drive solved
// apart.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/sight_solver.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {

// How much each stretch of the rows gains from a place of its own, by the normal equations of a Huber cost
// about one solution: made once, in one pass over the rows, for all stretches.
class StretchGains {
 public:
  // The fit's rows in so many bins of about the same number; without NLOS states.
  StretchGains(const AnchorFit& fit, std::size_t bins);

  // Bin i holds the rows [first_row[i], first_row[i + 1]).
  std::vector<std::size_t> first_row;
  // What the cost falls by, all other unknowns solved for, where the anchor is elsewhere in bins [from, to).
  [[nodiscard]] double gain(std::size_t from, std::size_t to) const;

 private:
  using Columns = Eigen::Matrix<double, Eigen::Dynamic, 3>;
  // Sums over all bins before: information of the position, gradient by it, and L^-1 times the cross
  // information with all unknowns, L L^T that of all rows.
  std::vector<Eigen::Matrix3d> information_;
  std::vector<Eigen::Vector3d> gradient_;
  std::vector<Columns> half_cross_;
  Eigen::VectorXd half_gradient_;
};

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

// Where one anchor was.
struct AnchorPath {
  std::vector<double> moved_at_s;  // ascending; empty: it stayed
  Eigen::Vector3d last_move_m = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> places_m;  // before the first move, after it, and so on; where there are moves
  std::optional<Eigen::Vector3d> twin_m;  // another place that no time separates from its own
};

// Where an anchor was moved, its fit becomes that of the rows after its last move, and so does its sight,
// where the site has one. The result: of each anchor.
[[nodiscard]] std::vector<AnchorPath> find_moved(const PollTable& table, SiteSight& sight,
                                                 std::vector<AnchorFit>& fits);

}  // namespace groma::calibration
