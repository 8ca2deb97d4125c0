#include "host/calibration/rival.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>

#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kRowsPerTag = 40;
constexpr int kIterations = 6;
// An excess of the few rows' below this is looked at again with all rows.
constexpr double kCloseExcess = 10.0;
// A fit that moved by more than this is compared again with all rows.
constexpr double kRefitMove_m = 0.3;
// At most, of a place that is not the earlier one: anchors do get moved.
constexpr double kMovedCost = 10.0;
// Starts this close to each other are in one valley.
constexpr double kSameRival_m = 0.1;
// Heights over the tags' plane to try, as shares of the distance to the nearest antenna.
constexpr double kProbes[] = {0.9, 0.35, -0.35, -0.9};
// Holds the anchor at a distance from the tags while the rest of it is solved.
constexpr double kHoldSigma_m = 0.01;

double height_above(const TagSpread& spread, int axis, const AnchorVector& anchor) {
  return spread.axes.col(axis).dot(anchor.head<3>() - spread.center_m);
}

struct Contest {
  AnchorSolution here;   // the best of all
  AnchorSolution there;  // the best on its other side
};

double nearest_antenna_m(const AnchorProblem& problem, const Eigen::Vector3d& anchor_m) {
  double nearest_m = std::numeric_limits<double>::infinity();
  for (const Observation& row : problem.rows) nearest_m = std::min(nearest_m, (row.tag_m - anchor_m).norm());
  return nearest_m;
}

// Where the other side, and a further valley on either, may be: the mirror point, and across a plane also
// places well above and below it. Between two valleys the cost is flat and a solver comes to rest.
std::vector<AnchorVector> starts_around(const AnchorProblem& problem, const AnchorVector& anchor,
                                        const TagSpread& spread, int axis) {
  const Eigen::Vector3d normal = spread.axes.col(axis);
  const double height_m = height_above(spread, axis, anchor);
  std::vector<AnchorVector> out(1, anchor);
  out.back().head<3>() = spread.mirror(anchor.head<3>(), axis);
  if (axis != kAcrossPlane || model::is_ablated(model::Mechanism::kCalibrationProbes)) return out;
  const double nearest_m = nearest_antenna_m(problem, anchor.head<3>());
  for (const double share : kProbes) {
    out.push_back(anchor);
    out.back().head<3>() += (share * nearest_m - height_m) * normal;
  }
  return out;
}

// Those in the valley of the anchor's own start, or of one before them.
void drop_doubles(const AnchorVector& anchor, std::vector<AnchorVector>& starts) {
  std::vector<Eigen::Vector3d> tried_m{anchor.head<3>()};
  std::erase_if(starts, [&](const AnchorVector& start) {
    const Eigen::Vector3d place_m = start.head<3>();
    const bool tried = std::any_of(tried_m.begin(), tried_m.end(), [&](const Eigen::Vector3d& other_m) {
      return (place_m - other_m).norm() < kSameRival_m;
    });
    if (!tried) tried_m.push_back(place_m);
    return tried;
  });
}

Contest contest(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                const AnchorVector& anchor, std::span<const AnchorVector> starts, const TagSpread& spread,
                int axis) {
  std::vector<AnchorSolution> found;
  found.push_back(solve_anchor(problem, kernels, anchor, kIterations));
  for (const AnchorVector& start : starts)
    found.push_back(solve_anchor(problem, kernels, start, kIterations));
  const auto cheaper = [](const AnchorSolution& a, const AnchorSolution& b) { return a.cost < b.cost; };
  Contest out;
  out.here = *std::min_element(found.begin(), found.end(), cheaper);
  const double height_m = height_above(spread, axis, out.here.anchor);
  std::erase_if(found, [&](const AnchorSolution& solution) {
    return height_above(spread, axis, solution.anchor) * height_m > 0.0;
  });
  if (!found.empty()) {
    out.there = *std::min_element(found.begin(), found.end(), cheaper);
    return out;
  }
  // No valley over there: the cost at the mirrored distance from the tags has to speak for it.
  AnchorVector mirrored = out.here.anchor;
  mirrored.head<3>() = spread.mirror(out.here.anchor.head<3>(), axis);
  const Eigen::Vector3d normal = spread.axes.col(axis);
  AnchorProblem held = problem;
  held.position.mean_m = mirrored.head<3>();
  held.position.information += normal * normal.transpose() / (kHoldSigma_m * kHoldSigma_m);
  out.there = solve_anchor(held, kernels, mirrored, kIterations);
  return out;
}

}  // namespace

Rival challenge(AnchorFit& fit, const TagSpread& spread, int axis) {
  AnchorProblem sketch = fit.problem;
  const std::vector<Observation> few = spread_along_the_way(sketch.rows, sketch.tag_count, kRowsPerTag);
  sketch.rows = few;
  Contest result =
      contest(sketch, fit.kernels, fit.anchor, starts_around(sketch, fit.anchor, spread, axis), spread, axis);
  double scale = static_cast<double>(fit.problem.rows.size()) / static_cast<double>(few.size());
  const bool moved = (result.here.anchor - fit.anchor).head<3>().norm() > kRefitMove_m;
  if (moved || (result.there.cost - result.here.cost) * scale < kCloseExcess) {
    std::vector<AnchorVector> starts{result.here.anchor, result.there.anchor, fit.anchor};
    // The few rows may have but one valley, between the two that all of them have.
    starts.back().head<3>() = spread.mirror(fit.anchor.head<3>(), axis);
    drop_doubles(fit.anchor, starts);
    result = contest(fit.problem, fit.kernels, fit.anchor, starts, spread, axis);
    sketch.rows = fit.problem.rows;
    scale = 1.0;
    fit.anchor = result.here.anchor;
    fit.cost = result.here.cost;
  }
  CostSum of_perfect;
  for (const Observation& row : sketch.rows) of_perfect.add(fit.kernels[row.tag].at(0.0));
  const double perfect = of_perfect.cost();
  Rival rival;
  rival.anchor = result.there.anchor;
  rival.cost_excess = scale * std::max(0.0, result.there.cost - result.here.cost);
  rival.cost_ratio =
      std::clamp((result.here.cost - perfect) / std::max(result.there.cost - perfect, 1e-9), 0.0, 1.0);
  return rival;
}

void weigh_by_earlier(const EarlierPlace& earlier, double inflation, AnchorFit& fit, Rival& rival) {
  const Eigen::LDLT<Eigen::Matrix3d> factors(earlier.covariance_m2);
  const auto cost = [&](const AnchorVector& anchor) {
    const Eigen::Vector3d offset_m = anchor.head<3>() - earlier.position_m;
    return std::min(kMovedCost, 0.5 * offset_m.dot(factors.solve(offset_m)));
  };
  rival.cost_excess += inflation * (cost(rival.anchor) - cost(fit.anchor));
  if (rival.cost_excess >= 0.0) return;
  std::swap(fit.anchor, rival.anchor);
  fit.cost = robust_cost(fit.problem, fit.kernels, fit.anchor);
  rival.cost_excess = -rival.cost_excess;
}

Eigen::Matrix3d rival_spread(const Rival& rival, const AnchorFit& fit, double inflation) {
  if (model::is_ablated(model::Mechanism::kCalibrationMirror)) return Eigen::Matrix3d::Zero();
  const double odds = std::exp(-rival.cost_excess / std::max(1.0, inflation));
  const Eigen::Vector3d offset_m = rival.anchor.head<3>() - fit.anchor.head<3>();
  return odds / (1.0 + odds) * offset_m * offset_m.transpose();
}

}  // namespace groma::calibration
