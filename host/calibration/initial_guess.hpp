// Where an anchor may be, found without a start: a search over the spheres of a few ranges, and the mirror
// sides of what the search found.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"

namespace groma::calibration {

// At most max_rows_per_tag of each tag's rows, spread evenly along the way that the tag went: a long stop
// counts no more than a short one.
[[nodiscard]] std::vector<Observation> spread_along_the_way(std::span<const Observation> rows,
                                                            std::size_t tag_count,
                                                            std::size_t max_rows_per_tag);

// Axes of TagSpread to mirror along.
inline constexpr int kAcrossLine = 1;
inline constexpr int kAcrossPlane = 2;

// The principal frame of the antennas' positions.
struct TagSpread {
  Eigen::Vector3d center_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();     // columns: most spread first
  Eigen::Vector3d deviation_m = Eigen::Vector3d::Zero();  // standard deviation along each

  // The point on the other side of the tags along one axis, 0..2.
  [[nodiscard]] Eigen::Vector3d mirror(const Eigen::Vector3d& point_m, int axis) const noexcept;
};
[[nodiscard]] TagSpread tag_spread(std::span<const Observation> rows);

struct Candidate {
  AnchorSolution solution;  // its cost is a negative log likelihood: comparable between kernels
  KernelShape kernel;       // learnt from its own residuals
};

// The solution that lies in the same wide valley as the start, with its kernel: nothing of it depends on a
// first guess of the noise.
[[nodiscard]] Candidate descend(const AnchorProblem& problem, const AnchorVector& start);

// The best solution that the search finds, with its kernel. The rows should be few and spread out.
[[nodiscard]] Candidate search(const AnchorProblem& problem);

}  // namespace groma::calibration
