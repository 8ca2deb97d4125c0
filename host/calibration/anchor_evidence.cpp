#include "host/calibration/anchor_evidence.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <utility>

#include "host/calibration/robust_kernel.hpp"

namespace groma::calibration {
namespace {

// By hand. A MAD of 10 residuals (efficiency 0.37) has a relative sigma of 1/sqrt(2 * 10 * 0.37) = 0.37.
constexpr std::size_t kMinHeldOut = 10;
// A solution with a larger horizontal sigma does not predict new ranges: over such distances its
// linearization fails. By hand: over 0.5 m, spheres of 2.5 m depart from their tangent planes by 0.05 m.
constexpr double kOpenSigma_m = 0.5;
// Residuals beyond what short and long NLOS explain. By hand; NlosSite.OutliersAndCollisionsAreNotNlos and
// DuplicateId.IsNeverTrusted hold with them.
constexpr double kFar_m = 1.5;
constexpr double kShort_m = 0.3;
// An anchor that moves at least this far, to this close to another's place, has swapped ids with it.
// By hand; the SwappedIds tests hold with them.
constexpr double kJump_m = 2.0;
constexpr double kSamePlace_m = 0.5;

double mean_scale_m(const AnchorFit& fit) {
  double sum_m = 0.0;
  for (const RobustKernel& kernel : fit.kernels) sum_m += kernel.shape().scale_m;
  return sum_m / std::max<double>(1.0, static_cast<double>(fit.kernels.size()));
}

// Includes ranges that choose_measurements() left out.
double count_ranges(const AnchorObservations& data) {
  return static_cast<double>(data.rows.size() + data.left_out);
}

// Standard deviation of a range, m, from differences of consecutive residuals within kNext_s: NLOS that lasts
// longer does not count. Zero if there are none.
double flicker_m(std::span<const FittedRange> rows) {
  constexpr double kNext_s = 2.0;  // by hand: shorter than a short NLOS episode, some 3 s (los_chain.cpp)
  std::map<model::NodeId, const FittedRange*> before;
  std::vector<double> differences_m;
  for (const FittedRange& row : rows) {
    const FittedRange*& last = before[row.tag_id];
    if (last != nullptr && row.t_s - last->t_s < kNext_s) {
      differences_m.push_back(std::abs(row.residual_m - last->residual_m));
    }
    last = &row;
  }
  return kSigmaOfMad * median(std::move(differences_m)) / std::numbers::sqrt2;
}

// Another anchor whose place, at any time, this one took by one of its moves.
std::optional<model::NodeId> find_stand_in(const Site& site, std::size_t anchor) {
  const std::vector<Eigen::Vector3d>& places_m = site.paths[anchor].places_m;
  for (std::size_t k = 1; k < places_m.size(); ++k) {
    if ((places_m[k] - places_m[k - 1]).norm() < kJump_m) continue;
    for (std::size_t other = 0; other < site.fits.size(); ++other) {
      if (other == anchor || site.fits[other].problem.rows.empty()) continue;
      std::vector<Eigen::Vector3d> others_m = site.paths[other].places_m;
      others_m.emplace_back(site.fits[other].anchor.head<3>());
      if (std::any_of(others_m.begin(), others_m.end(), [&](const Eigen::Vector3d& other_m) {
            return (other_m - places_m[k]).norm() < kSamePlace_m;
          })) {
        return site.association.anchors[other].id;
      }
    }
  }
  return std::nullopt;
}

std::optional<MoveEvidence> move_evidence(const Site& site, std::size_t anchor) {
  const AnchorPath& path = site.paths[anchor];
  if (path.moved_at_s.empty()) return std::nullopt;
  MoveEvidence out{.at_s = path.moved_at_s, .by_m = path.last_move_m};
  out.is_back = (path.places_m.back() - path.places_m.front()).norm() < kSamePlace_m;
  out.stand_in = find_stand_in(site, anchor);
  return out;
}

// Distances, LOS share and out-of-bounds residuals of one anchor's ranges.
void judge_rows(const Site& site, std::size_t i, std::span<const FittedRange> fitted, AnchorEvidence& out) {
  double judged = 0.0;
  double far = 0.0;
  double too_short = 0.0;
  if (!fitted.empty()) out.nearest_m = std::numeric_limits<double>::infinity();
  for (const FittedRange& row : fitted) {
    out.los_share += row.los;
    out.nearest_m = std::min(out.nearest_m, row.distance_m);
    if (row.is_ignored) continue;
    judged += 1.0;
    if (row.residual_m > kFar_m) far += 1.0;
    if (row.residual_m < -kShort_m) too_short += 1.0;
  }
  const double n = std::max(1.0, static_cast<double>(fitted.size()));
  out.los_share /= n;
  out.ignored_share = fitted.empty() ? 0.0 : 1.0 - judged / n;
  if (!site.has_los_states()) return;
  out.los_states = LosEvidence{.polls = site.los_states.poll_shares[i],
                               .counts_missed = site.polls.regular,
                               .excess_m = site.los_states.model.excess_prior.mean_m,
                               .far_share = far / std::max(1.0, judged),
                               .short_share = too_short / std::max(1.0, judged)};
}

}  // namespace

HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> rows, double from_s) {
  std::vector<double> absolute_m;
  double square_m2 = 0.0;
  double scale_m = 0.0;
  const Eigen::MatrixXd covariance = first.problem.position.surveyed
                                         ? anchor_covariance(gather_evidence(first), 1.0)
                                         : rough_covariance(first);
  for (const Observation& row : rows) {
    if (row.t_s <= from_s) continue;
    const RowAt at = row_at(first, row);
    square_m2 += at.residual_m * at.residual_m;
    const double noise_m = first.kernels[row.tag].shape().scale_m / at.noise_share;
    scale_m += std::hypot(noise_m, prediction_sigma_m(at.j, row.tag, covariance));
    absolute_m.push_back(std::abs(at.residual_m));
  }
  HeldOut out;
  if (absolute_m.size() < kMinHeldOut) return out;
  const double n = static_cast<double>(absolute_m.size());
  out.rms_m = std::sqrt(square_m2 / n);
  out.robust_rms_m = kSigmaOfMad * median(std::move(absolute_m));
  if (covariance.topLeftCorner<2, 2>().trace() < kOpenSigma_m * kOpenSigma_m) {
    out.share_of_scale = *out.robust_rms_m / (scale_m / n);
    out.height_variance_m2 = covariance(2, 2);
  }
  return out;
}

std::vector<FittedRange> fitted_ranges(const AnchorFit& fit, std::span<const model::Tag> tags) {
  std::vector<FittedRange> out;
  out.reserve(fit.problem.rows.size());
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    out.push_back(
        {.t_s = row.t_s,
         .tag_id = tags[row.tag].id,
         .antenna_m = row.tag_m.head<2>(),
         .distance_m = at.predicted.distance_m,
         .residual_m = at.residual_m,
         .los = fit.kernels[row.tag].shares(at.noise_share * at.residual_m).los() * at.value.los_count,
         .is_ignored =
             fit.problem.los_states != nullptr && is_ignored(fit.problem.los_states->rows[row.index])});
  }
  return out;
}

void gather_anchor_evidence(Site& site, std::span<const std::vector<FittedRange>> fitted) {
  // Medians over the anchors that have ranges.
  std::vector<double> scales_m;
  std::vector<double> ranges;
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    if (site.fits[i].problem.rows.empty()) continue;
    scales_m.push_back(mean_scale_m(site.fits[i]));
    ranges.push_back(count_ranges(site.association.anchors[i]));
  }
  const double typical_scale_m = median(std::move(scales_m));
  const double typical_ranges = median(std::move(ranges));
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    AnchorEvidence& out = site.evidence[i];
    out.inflation = site.fits[i].inflation;
    out.moved = move_evidence(site, i);
    out.duplicate_m = site.paths[i].duplicate_m;
    out.surveyed = site.fits[i].problem.position.surveyed;
    out.rows = site.fits[i].problem.rows.size();
    judge_rows(site, i, fitted[i], out);
    if (typical_scale_m > 0.0) {
      out.flicker = flicker_m(fitted[i]) / typical_scale_m;
      out.scale_ratio = mean_scale_m(site.fits[i]) / typical_scale_m;
    }
    if (typical_ranges > 0.0) out.count_ratio = count_ranges(site.association.anchors[i]) / typical_ranges;
  }
}

}  // namespace groma::calibration
