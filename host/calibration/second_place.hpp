// Whether one anchor's ranges tell of two places, and in which stretch of the drive of which: it was moved,
// and perhaps moved back, or another anchor answered under its id.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {

// How much each stretch of the rows gains from a place of its own, by the normal equations of a Huber cost
// about one solution: made once, in one pass over the rows, for all stretches.
class StretchGains {
 public:
  // The rows in so many bins of about the same number. `anchor`: position and biases alone.
  StretchGains(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
               const AnchorVector& anchor, std::size_t bins);

  [[nodiscard]] std::size_t bins() const noexcept { return first_row_.size() - 1; }
  // Bin i holds the rows [first_row(i), first_row(i + 1)).
  [[nodiscard]] std::size_t first_row(std::size_t bin) const noexcept { return first_row_[bin]; }
  // What the cost falls by, all other unknowns solved for, where the anchor is elsewhere in bins [from, to).
  [[nodiscard]] double gain(std::size_t from, std::size_t to) const;

 private:
  using Columns = Eigen::Matrix<double, Eigen::Dynamic, 3>;
  std::vector<std::size_t> first_row_;
  // Sums over all bins before: information of the position, gradient by it, and L^-1 times the cross
  // information with all unknowns, L L^T that of all rows.
  std::vector<Eigen::Matrix3d> information_;
  std::vector<Eigen::Vector3d> gradient_;
  std::vector<Columns> half_cross_;
  Eigen::VectorXd half_gradient_;
};

struct SecondPlace {
  std::size_t first = 0;  // the stretch of rows in which the anchor was elsewhere: [first, last)
  std::size_t last = 0;
  Eigen::Vector3d place_m = Eigen::Vector3d::Zero();        // there
  Eigen::Vector3d usual_place_m = Eigen::Vector3d::Zero();  // outside of the stretch
  // Of the rows that are clearly of one of the places: those that no time parts from those of the other.
  double torn_share = 0.0;
};

// A stretch of this many rows at least, beside as many; none where one place explains the rows as well. The
// fit's rows, kernels and solution are a start and a scale, its sight is not looked at.
inline constexpr std::size_t kLeastStretchRows = 60;
// Beyond this no time parts the places: the anchor is at both.
inline constexpr double kTornShare = 0.2;
[[nodiscard]] std::optional<SecondPlace> find_second_place(const AnchorFit& fit);

}  // namespace groma::calibration
