#include "host/calibration/mirror.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/calibration/comparison.hpp"
#include "host/calibration/site.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Effort of the mirror tests, by hand against time.
constexpr std::size_t kRowsPerTag = 40;
constexpr int kIterations = 6;
// If the excess with few ranges is below this, the test is repeated with all ranges. By hand: 10 nats, odds
// of 22000 to 1, more than kPlausibleExcess of verdict.cpp.
constexpr double kCloseExcess = 10.0;
// If the fit moved by more than this, the test is repeated with all ranges. By hand.
constexpr double kRefitMove_m = 0.3;
// Ranges that differ by less than this (rms) do not distinguish two sides, however many ranges there are:
// the range model is not so exact. Less than a unit of DW1000 timestamps, 4.7 mm. Wrong sides of a low tag on
// a floor with bumps of 6 mm differ by 0.3 to 2 mm (simulated), those of tags at different heights by 16 mm
// or more.
constexpr double kIndistinct_m = 0.003;
// Largest cost of being away from the earlier place, as anchors do get moved: by hand, 10 nats.
// Update.ByAWeakDriveIsBetterThanEitherAloneOverManyDrives holds with it.
constexpr double kMovedCost = 10.0;
// Starts this close to each other are in one basin. By hand.
constexpr double kSameMirror_m = 0.1;
// Heights over the tags' plane to try, as shares of the distance to the nearest antenna. By hand:
// at that distance, 20 and 64 degrees from the plane; the campaigns hold with them.
constexpr double kProbes[] = {0.9, 0.35, -0.35, -0.9};
// Holds the anchor at a distance from the tags while the other unknowns are solved: by hand, well below the
// sigmas of heights.
constexpr double kHoldSigma_m = 0.01;
// Most rounds of the refinement after the tests: by hand, a bound on time.
constexpr int kMirrorRounds = 10;
// Sigma per axis between the frames of two drives, in addition to the earlier calibration's covariance. By
// hand; Update.ByAWeakDriveIsBetterThanEitherAloneOverManyDrives holds with it.
constexpr double kFrameSigma_m = 0.1;

double height_above(const TagSpread& spread, int axis, const AnchorVector& anchor) {
  return spread.axes.col(axis).dot(anchor.head<3>() - spread.center_m);
}

struct BothSides {
  AnchorSolution here;   // the best solution
  AnchorSolution there;  // the best solution on its other side
};

// The anchor, and starts on the other side and in another basin on either side: the mirror point and, across
// the plane, also points well above and below it. Between two basins the cost is flat and a solver stops.
std::vector<AnchorVector> starts_around(const AnchorProblem& problem, const AnchorVector& anchor,
                                        const TagSpread& spread, int axis) {
  const Eigen::Vector3d normal = spread.axes.col(axis);
  const double height_m = height_above(spread, axis, anchor);
  std::vector<AnchorVector> out(2, anchor);
  out.back().head<3>() = spread.mirror(anchor.head<3>(), axis);
  if (axis != kAcrossPlane || model::is_ablated(model::Mechanism::kCalibrationProbes)) return out;
  double nearest_m = std::numeric_limits<double>::infinity();
  for (const Observation& row : problem.rows) {
    nearest_m = std::min(nearest_m, (row.tag_m - anchor.head<3>()).norm());
  }
  for (const double share : kProbes) {
    out.push_back(anchor);
    out.back().head<3>() += (share * nearest_m - height_m) * normal;
  }
  return out;
}

void drop_doubles(std::vector<AnchorVector>& starts) {
  std::vector<Eigen::Vector3d> tried_m;
  std::erase_if(starts, [&](const AnchorVector& start) {
    const Eigen::Vector3d place_m = start.head<3>();
    const bool tried = std::any_of(tried_m.begin(), tried_m.end(), [&](const Eigen::Vector3d& other_m) {
      return (place_m - other_m).norm() < kSameMirror_m;
    });
    if (!tried) tried_m.push_back(place_m);
    return tried;
  });
}

BothSides solve_both_sides(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                           std::span<const AnchorVector> starts, const TagSpread& spread, int axis) {
  std::vector<AnchorSolution> found;
  for (const AnchorVector& start : starts)
    found.push_back(solve_anchor(problem, kernels, start, kIterations));
  const auto cheaper = [](const AnchorSolution& a, const AnchorSolution& b) { return a.cost < b.cost; };
  BothSides out;
  out.here = *std::min_element(found.begin(), found.end(), cheaper);
  const double height_m = height_above(spread, axis, out.here.anchor);
  std::erase_if(found, [&](const AnchorSolution& solution) {
    return height_above(spread, axis, solution.anchor) * height_m > 0.0;
  });
  if (!found.empty()) {
    out.there = *std::min_element(found.begin(), found.end(), cheaper);
    return out;
  }
  // No minimum on the other side: use the cost at the mirrored distance from the tags.
  AnchorVector mirrored = out.here.anchor;
  mirrored.head<3>() = spread.mirror(out.here.anchor.head<3>(), axis);
  const Eigen::Vector3d normal = spread.axes.col(axis);
  AnchorProblem held = problem;
  held.position.mean_m = mirrored.head<3>();
  held.position.information += normal * normal.transpose() / (kHoldSigma_m * kHoldSigma_m);
  out.there = solve_anchor(held, kernels, mirrored, kIterations);
  return out;
}

// Root mean square of the difference of the ranges that two solutions predict.
double difference_m(const AnchorProblem& problem, const AnchorVector& one, const AnchorVector& other) {
  double sum_m2 = 0.0;
  for (const Observation& row : problem.rows)
    sum_m2 +=
        model::square(residual_m(row, one, problem.tag_count) - residual_m(row, other, problem.tag_count));
  return std::sqrt(sum_m2 / static_cast<double>(problem.rows.size()));
}

// None if the earlier calibration has no position for the anchor. A height that is not trusted gets so large
// a variance that it decides nothing.
std::optional<EarlierPlace> earlier_place(const model::Calibration& earlier, model::NodeId id) {
  const model::AnchorCalibration* anchor = model::find_anchor(earlier, id);
  if (anchor == nullptr || !model::has_position(*anchor)) return std::nullopt;
  EarlierPlace out{.position_m = anchor->position_m,
                   .covariance_m2 = anchor->covariance.topLeftCorner<3, 3>()};
  out.covariance_m2.diagonal().array() += kFrameSigma_m * kFrameSigma_m;
  if (anchor->verdict != model::AnchorVerdict::kOk) out.covariance_m2(2, 2) += kWeakHeight_m * kWeakHeight_m;
  return out;
}

}  // namespace

Eigen::Vector3d TagSpread::mirror(const Eigen::Vector3d& point_m, int axis) const noexcept {
  const Eigen::Vector3d normal = axes.col(axis);
  return point_m - 2.0 * normal.dot(point_m - center_m) * normal;
}

TagSpread tag_spread(std::span<const Observation> rows) {
  TagSpread out;
  if (rows.empty()) return out;
  const double n = static_cast<double>(rows.size());
  for (const Observation& row : rows) out.center_m += row.tag_m / n;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (const Observation& row : rows) {
    const Eigen::Vector3d offset_m = row.tag_m - out.center_m;
    scatter += offset_m * offset_m.transpose() / n;
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(scatter);
  out.axes = eigen.eigenvectors().rowwise().reverse();
  return out;
}

MirrorHypothesis test_mirror(AnchorFit& fit, const TagSpread& spread, int axis) {
  AnchorProblem sketch = fit.problem;
  const std::vector<Observation> few = spread_along_the_way(sketch.rows, sketch.tag_count, kRowsPerTag);
  sketch.rows = few;
  BothSides result =
      solve_both_sides(sketch, fit.kernels, starts_around(sketch, fit.anchor, spread, axis), spread, axis);
  double scale = static_cast<double>(fit.problem.rows.size()) / static_cast<double>(few.size());
  const bool moved = (result.here.anchor - fit.anchor).head<3>().norm() > kRefitMove_m;
  if (moved || (result.there.cost - result.here.cost) * scale < kCloseExcess) {
    std::vector<AnchorVector> starts{fit.anchor, result.here.anchor, result.there.anchor, fit.anchor};
    // The few ranges may have a single basin between the two that all ranges have.
    starts.back().head<3>() = spread.mirror(fit.anchor.head<3>(), axis);
    drop_doubles(starts);
    result = solve_both_sides(fit.problem, fit.kernels, starts, spread, axis);
    sketch.rows = fit.problem.rows;
    scale = 1.0;
    fit.anchor = result.here.anchor;
    fit.cost = result.here.cost;
  }
  CostSum of_perfect;
  for (const Observation& row : sketch.rows) of_perfect.add(fit.kernels[row.tag].at(0.0));
  const double perfect = of_perfect.cost();
  MirrorHypothesis mirror;
  mirror.anchor = result.there.anchor;
  if (difference_m(sketch, result.here.anchor, result.there.anchor) > kIndistinct_m)
    mirror.cost_excess = scale * std::max(0.0, result.there.cost - result.here.cost);
  mirror.cost_ratio =
      std::clamp((result.here.cost - perfect) / std::max(result.there.cost - perfect, 1e-9), 0.0, 1.0);
  return mirror;
}

void test_both_mirrors(AnchorFit& fit) {
  const TagSpread spread = tag_spread(fit.problem.rows);
  for (const int axis : {kAcrossLine, kAcrossPlane}) static_cast<void>(test_mirror(fit, spread, axis));
}

void weigh_by_earlier(const EarlierPlace& earlier, AnchorFit& fit, MirrorHypothesis& mirror) {
  const Eigen::LDLT<Eigen::Matrix3d> factors(earlier.covariance_m2);
  const auto cost = [&](const AnchorVector& anchor) {
    const Eigen::Vector3d offset_m = anchor.head<3>() - earlier.position_m;
    return std::min(kMovedCost, 0.5 * offset_m.dot(factors.solve(offset_m)));
  };
  mirror.cost_excess += fit.inflation * (cost(mirror.anchor) - cost(fit.anchor));
  if (mirror.cost_excess >= 0.0) return;
  std::swap(fit.anchor, mirror.anchor);
  mirror.cost_excess = -mirror.cost_excess;
}

void test_mirrors(Site& site, const model::Calibration* earlier) {
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    AnchorFit& fit = site.fits[i];
    AnchorEvidence& evidence = site.evidence[i];
    if (fit.problem.rows.empty()) continue;
    evidence.spread = tag_spread(fit.problem.rows);
    if (fit.problem.position.surveyed) continue;
    // The ranges of an anchor that moved during the drive are not from its earlier place.
    std::optional<EarlierPlace> place;
    if (earlier != nullptr && !evidence.path.has_moved()) {
      place = earlier_place(*earlier, site.association.anchors[i].id);
    }
    for (const auto& [axis, mirror] :
         {std::pair{kAcrossLine, &evidence.side}, {kAcrossPlane, &evidence.mirror}}) {
      *mirror = test_mirror(fit, evidence.spread, axis);
      if (!place) continue;
      gather_evidence({&fit, 1});
      estimate_inflation({&fit, 1});
      weigh_by_earlier(*place, fit, **mirror);
    }
  }
  refine_site(site.fits, kMirrorRounds);
}

Eigen::Matrix3d mirror_covariance(const MirrorHypothesis& mirror, const AnchorFit& fit) {
  if (model::is_ablated(model::Mechanism::kCalibrationMirror)) return Eigen::Matrix3d::Zero();
  const double odds = std::exp(-mirror.cost_excess / std::max(1.0, fit.inflation));
  const Eigen::Vector3d offset_m = mirror.anchor.head<3>() - fit.anchor.head<3>();
  return odds / (1.0 + odds) * offset_m * offset_m.transpose();
}

}  // namespace groma::calibration
