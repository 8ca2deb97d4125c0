#include "host/calibration/drive_error.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>
#include <span>
#include <utility>

#include <Eigen/Cholesky>

#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Coarse knots are enough to select a drift. What linear interpolation misses stays in the residuals. Tuned
// on the simulated demonstration: a correlation time chosen on knots 8 s apart, not 4 s, made the frame's
// sigma up to 0.07 m for an error of 0.01 m. The counts bound the time of a dense solution: by hand.
constexpr KnotGrid kCoarseKnots{.spacing_s = 8.0, .max_count = 48.0};
constexpr KnotGrid kFineKnots{.spacing_s = 4.0, .max_count = 96.0};
constexpr KnotGrid kNoKnots{.spacing_s = 1e9, .max_count = 2.0};  // two: the fewest, at the drive's ends
constexpr int kDriveRounds = 4;                                   // a bound on time, by hand
// First sigmas of the drift to try. The marginal likelihood of the ranges chooses one of them, then refines
// sigma, yaw sigma and correlation time by these factors, until no factor gains kMinDriftGain. By hand:
// starts a factor of 3 apart, steps that shrink by square roots, a negligible gain, and a drift as in
// CalibrationCampaign.StaysConsistentWhenPosesDrift; DriveError.EstimatesSizeAndCorrelationTime... holds.
constexpr std::array kDriftSigmas_m{0.02, 0.06, 0.2, 0.6};
constexpr double kFirstDriftFactor = 2.0;
constexpr double kLastDriftFactor = 1.15;
constexpr double kMinDriftGain = 0.01;
constexpr DriftPrior kFirstDrift{.sigma_m = 0.0, .sigma_yaw_rad = 0.004, .correlation_s = 20.0};
constexpr std::array kYawFactors{0.4, 2.5};
// Then whether the drift is smooth, and how fast: inverse natural frequencies and damping ratios to try. By
// hand: factors of 1.5 and 3; DriveError.DistinguishesSmoothFromRoughDrift holds with them.
constexpr std::array kSmoothTimes_s{5.0, 7.5, 11.0, 17.0, 25.0, 37.0};
constexpr std::array kDampingRatios{1.0, 0.3, 0.1};
constexpr std::array kSmoothFactors{1.0, 0.7};
constexpr int kFollowingSteps = 3;       // a bound on time, by hand
constexpr double kLastStepSigmas = 0.1;  // 0.01 in chi square
// Least gain in log evidence (nats) to accept a drift, body terms, or body terms in addition to a drift; and
// a smooth or an oscillating drift in place of a rough one. By hand: 1, 4, 8 and 10 nats are odds of 2.7, 55,
// 3000 and 22000 to 1. DriveError.DistinguishesSmooth..., LeavesExactPoses... and
// DoesNotTakePlaceDependentErrors... hold with them.
constexpr double kMinDriftEvidence = 4.0;
constexpr double kMinBodyEvidence = 10.0;
constexpr double kMinMoreBodyEvidence = 8.0;
constexpr double kMinSmoothEvidence = 1.0;
constexpr double kMinOscillationEvidence = 4.0;
// Least gain that has to remain with the inflation of kWhile_s: errors that depend on place in each anchor's
// own ranges can look like shared ones. By hand; DriveError.DoesNotTakePlaceDependentErrors... holds with it:
// neither is accepted in any of six drives with place-dependent errors of 0.08 m.
constexpr double kMinLastingDrift = 4.0;
constexpr double kMinLastingBody = 2.0;
// Correlation within kMoment_s comes from the ranges themselves, as when they are filtered or repeated;
// within kWhile_s, also from errors that depend on place. By hand; the same test holds with them.
constexpr double kMoment_s = 1.0;
constexpr double kWhile_s = 8.0;
// Prior by hand; Calibrate.EstimatesTheRangeDelay finds 0.05 s with it. 4 sigmas: 6e-5 by chance (normal,
// two-sided). No delay: 1e-7 s is 3 um at 30 m/s.
constexpr double kDelaySigma_s = 0.03;
constexpr double kMinDelaySigmas = 4.0;
constexpr double kNoDelaySigma_s = 1e-7;
// Frame error common to all poses, which no range observes: no localization knows its map better. By
// hand; 0.005 m and 0.0005 rad until the drift's own share of the frame was estimated.
constexpr double kDriveFrameSigma_m = 0.002;
constexpr double kFrameSigma_rad = 0.0002;

double delay_sigma_s() noexcept {
  return model::is_ablated(model::Mechanism::kCalibrationDelay) ? kNoDelaySigma_s : kDelaySigma_s;
}

// Log evidence: log likelihood of the ranges with the drive's error marginalized, up to a constant.
double evidence(const JointEquations& equations, const SharedUnknowns& unknowns, const SharedPrior& prior) {
  // Unknowns that are not fixed at zero are contiguous.
  const Eigen::Index first = prior.drift.sigma_m > 0.0 ? 0 : unknowns.delay();
  const Eigen::Index size = (prior.body ? unknowns.size() : unknowns.body(0)) - first;
  const Eigen::LLT<Eigen::MatrixXd> posterior(
      equations.information.block(first, first, size, size) +
      prior_information(unknowns, prior).block(first, first, size, size));
  if (posterior.info() != Eigen::Success) return -std::numeric_limits<double>::infinity();
  const auto descent = equations.descent.segment(first, size);
  const double log_determinant = 2.0 * posterior.matrixLLT().diagonal().array().log().sum();
  return 0.5 * descent.dot(posterior.solve(descent)) -
         0.5 * (log_determinant - prior_log_determinant(unknowns, prior));
}

struct Belief {
  SharedPrior prior;
  double evidence = 0.0;
};

// Replaces `best` if the log evidence with the prior is higher by more than `min_gain`.
void keep_likelier(const JointEquations& equations, const SharedUnknowns& unknowns, const SharedPrior& prior,
                   double min_gain, Belief& best) {
  const double found = evidence(equations, unknowns, prior) - min_gain;
  if (found > best.evidence) best = {.prior = prior, .evidence = found};
}

// Layout of the unknowns to test, and `typical` if poses report their covariance.
struct DriftSetup {
  SharedUnknowns unknowns;
  std::optional<PoseQuality> typical;
};

// Most likely drift in addition to `before`; `before` itself if none gains enough evidence.
Belief select_drift(const JointEquations& equations, const DriftSetup& setup, const Belief& before) {
  if (model::is_ablated(model::Mechanism::kCalibrationDrift)) return before;
  Belief best = before;
  best.evidence += kMinDriftEvidence;
  SharedPrior prior = before.prior;
  prior.drift = kFirstDrift;
  for (const double sigma_m : kDriftSigmas_m) {
    prior.drift.sigma_m = sigma_m;
    keep_likelier(equations, setup.unknowns, prior, 0.0, best);
  }
  if (setup.typical) {
    prior.drift.sigma_m = setup.typical->sigma_m;
    prior.drift.sigma_yaw_rad = setup.typical->sigma_yaw_rad;
    keep_likelier(equations, setup.unknowns, prior, 0.0, best);
  }
  return best.prior.drift.sigma_m > 0.0 ? best : before;
}

// The first-order drift that maximizes the evidence. Needs fine knots: coarse ones do not show its time.
SharedPrior refine_drift(const JointEquations& equations, const SharedUnknowns& unknowns,
                         const SharedPrior& rough) {
  Belief best{.prior = rough, .evidence = evidence(equations, unknowns, rough)};
  for (double step = kFirstDriftFactor; step > kLastDriftFactor;) {
    const Belief before = best;
    const auto scale = [&](double correlation, double shift, double turn) {
      SharedPrior prior = before.prior;
      prior.drift.correlation_s *= correlation;
      prior.drift.sigma_m *= shift;
      prior.drift.sigma_yaw_rad *= turn;
      keep_likelier(equations, unknowns, prior, 0.0, best);
    };
    for (const double factor : {step, 1.0 / step}) {
      // Ranges determine sigma^2 / time, the rate of a first-order process, better than either: scale the
      // sigmas along with the time.
      scale(factor, std::sqrt(factor), std::sqrt(factor));
      scale(1.0, factor, 1.0);
      scale(1.0, 1.0, factor);
    }
    if (best.evidence < before.evidence + kMinDriftGain) step = std::sqrt(step);
  }
  return best.prior;
}

// Replaces the drift by a smooth or oscillating one if that gains enough evidence. Needs fine knots: coarse
// ones do not distinguish them.
SharedPrior likeliest_shape(const JointEquations& equations, const SharedUnknowns& unknowns,
                            const SharedPrior& rough) {
  if (model::is_ablated(model::Mechanism::kCalibrationSmoothDrift)) return rough;
  Belief best{.prior = rough, .evidence = evidence(equations, unknowns, rough)};
  const auto least_gain = [](double damping_ratio) {
    return kMinSmoothEvidence + (damping_ratio < 1.0 ? kMinOscillationEvidence : 0.0);
  };
  for (const double factor : kSmoothFactors) {
    for (const double damping_ratio : kDampingRatios) {
      for (const double time_s : kSmoothTimes_s) {
        SharedPrior prior = rough;
        prior.drift.sigma_m *= factor;
        prior.drift.correlation_s = time_s;
        prior.drift.damping_ratio = damping_ratio;
        keep_likelier(equations, unknowns, prior, least_gain(damping_ratio), best);
      }
    }
  }
  if (!best.prior.drift.damping_ratio) return rough;
  for (const double factor : kYawFactors) {
    SharedPrior prior = best.prior;
    prior.drift.sigma_yaw_rad *= factor;
    keep_likelier(equations, unknowns, prior, least_gain(*prior.drift.damping_ratio), best);
  }
  return best.prior;
}

Belief select_body(const JointEquations& equations, const SharedUnknowns& unknowns, const Belief& before,
                   double min_evidence) {
  if (model::is_ablated(model::Mechanism::kCalibrationBody)) return before;
  SharedPrior prior = before.prior;
  prior.body = true;
  const Belief found{.prior = prior, .evidence = evidence(equations, unknowns, prior)};
  return found.evidence > before.evidence + min_evidence ? found : before;
}

// Selects drift, body terms, both or neither: first the one with more evidence under `slow`, then the other.
// `slow` makes the equations with the inflation of kWhile_s; it is called only if the inflation of kMoment_s
// accepts something.
template <typename Slow>
SharedPrior likeliest_prior(const JointEquations& equations, const DriftSetup& setup, const Slow& slow) {
  const SharedUnknowns& unknowns = setup.unknowns;
  Belief nothing{.prior = {.drift = {}, .delay_sigma_s = delay_sigma_s()}};
  nothing.evidence = evidence(equations, unknowns, nothing.prior);
  Belief drift = select_drift(equations, setup, nothing);
  Belief body = select_body(equations, unknowns, nothing, kMinBodyEvidence);
  if (!(drift.prior.drift.sigma_m > 0.0) && !body.prior.body) return nothing.prior;

  const JointEquations lasting = slow();
  const auto gain = [&](const Belief& more, const Belief& less) {
    return evidence(lasting, unknowns, more.prior) - evidence(lasting, unknowns, less.prior);
  };
  const double by_drift = gain(drift, nothing);
  const double by_body = gain(body, nothing);
  if (by_drift >= kMinLastingDrift && by_drift >= by_body) {
    body = select_body(equations, unknowns, drift, kMinMoreBodyEvidence);
    return gain(body, drift) < kMinLastingBody ? drift.prior : body.prior;
  }
  if (by_body < kMinLastingBody) return nothing.prior;
  drift = select_drift(equations, setup, body);
  return gain(drift, body) < kMinLastingDrift ? body.prior : drift.prior;
}

bool nothing_to_correct(const JointEquations& equations, const SharedUnknowns& unknowns,
                        const SharedPrior& prior) {
  if (prior.drift.sigma_m > 0.0 || prior.body) return false;
  const Eigen::Index delay = unknowns.delay();
  const double information = equations.information(delay, delay) + 1.0 / (delay_sigma_s() * delay_sigma_s());
  return std::abs(equations.descent(delay)) < kMinDelaySigmas * std::sqrt(information);
}

SharedUnknowns arrange(std::span<const AnchorFit> fits, std::span<const PoseSpread> spreads,
                       const DriftSetup& setup, const SharedPrior& prior) {
  const SharedUnknowns& coarse = setup.unknowns;
  SharedUnknowns out;
  const KnotGrid& grid = prior.drift.sigma_m > 0.0 ? kFineKnots : kNoKnots;
  out.knots = place_knots(fits, grid).value_or(coarse.knots);
  out.body_tags = prior.body ? coarse.body_tags : 0;
  if (setup.typical) out.knot_scale = scale_knots(out.knots, spreads, *setup.typical);
  return out;
}

// Takes the largest share of the step that lowers the cost; false if none does.
bool take_step(Association& association, std::vector<AnchorFit>& fits, std::span<const double> inflation,
               const SharedUnknowns& unknowns, const Eigen::MatrixXd& prior, const Eigen::VectorXd& step,
               Eigen::VectorXd& error) {
  // The anchors follow by steps of their own: their open directions are too non-linear for the joint step.
  const auto follow = [&] {
    double cost = 0.0;
    std::vector<AnchorVector> anchors;
    for (std::size_t i = 0; i < fits.size(); ++i) {
      AnchorSolution solution =
          solve_anchor(fits[i].problem, fits[i].kernels, fits[i].anchor, kFollowingSteps);
      cost += solution.cost / inflation[i];
      anchors.push_back(std::move(solution.anchor));
    }
    return std::pair(cost, std::move(anchors));
  };
  const double cost_before = follow().first + 0.5 * error.dot(prior * error);
  double taken = 0.0;
  for (const double share : {1.0, 0.5, 0.25, 0.125, 0.0}) {
    const Eigen::VectorXd more = (share - taken) * step;
    for (std::size_t i = 0; i < fits.size(); ++i) {
      const Eigen::Vector3d anchor_m = fits[i].anchor.head<3>();
      for (Observation& row : association.anchors[i].rows) move_row(unknowns, more, anchor_m, row);
    }
    taken = share;
    if (share == 0.0) break;
    const Eigen::VectorXd moved = error + share * step;
    auto [cost, anchors] = follow();
    cost += 0.5 * moved.dot(prior * moved);
    if (!(cost < cost_before)) continue;
    for (std::size_t i = 0; i < fits.size(); ++i) fits[i].anchor = anchors[i];
    error = moved;
    return true;
  }
  return false;
}

// Frame covariance: that of the mean of all knots, and the part that no range observes, about the map's
// origin.
void report_frame(const Knots& knots, const Eigen::MatrixXd& covariance, std::span<const AnchorFit> fits,
                  DriveError& out) {
  if (std::any_of(fits.begin(), fits.end(),
                  [](const AnchorFit& fit) { return fit.problem.position.surveyed; })) {
    return;
  }
  if (model::is_ablated(model::Mechanism::kCalibrationFrame)) return;
  Eigen::Vector2d center_m = Eigen::Vector2d::Zero();
  double rows = 0.0;
  for (const AnchorFit& fit : fits) {
    for (const Observation& row : fit.problem.rows) center_m += row.tag_m.head<2>();
    rows += static_cast<double>(fit.problem.rows.size());
  }
  if (rows > 0.0) center_m /= rows;
  Eigen::Matrix3d mean = Eigen::Matrix3d::Zero();
  const double knots_squared = static_cast<double>(knots.count * knots.count);
  for (Eigen::Index i = 0; i < knots.count; ++i) {
    for (Eigen::Index k = 0; k < knots.count; ++k)
      mean += covariance.block<3, 3>(3 * i, 3 * k) / knots_squared;
  }
  Eigen::Matrix4d about_center = Eigen::Matrix4d::Zero();
  about_center.topLeftCorner<2, 2>() = mean.topLeftCorner<2, 2>();
  about_center(3, 3) = mean(2, 2);
  const double square_m2 = kDriveFrameSigma_m * kDriveFrameSigma_m;
  const Eigen::Vector4d unseen(square_m2, square_m2, square_m2, kFrameSigma_rad * kFrameSigma_rad);
  // A turn about the center is a turn about the origin plus the shift that keeps the center in place.
  Eigen::Matrix4d about_origin = Eigen::Matrix4d::Identity();
  about_origin(0, 3) = center_m.y();
  about_origin(1, 3) = -center_m.x();
  out.unseen_frame_covariance = about_origin * unseen.asDiagonal() * about_origin.transpose();
  out.frame_covariance = about_origin * about_center * about_origin.transpose() + out.unseen_frame_covariance;
}

double pattern_size_m(std::span<const BodyError> body) {
  double square_m2 = 0.0;
  for (const BodyError& tag : body) {
    const auto variance_m2 = tag.covariance.diagonal().tail<model::kPatternTerms>();
    square_m2 += tag.mean.tail<model::kPatternTerms>().squaredNorm() + variance_m2.sum();
  }
  const double terms = static_cast<double>(model::kPatternTerms) * static_cast<double>(body.size());
  return body.empty() ? 0.0 : std::sqrt(square_m2 / terms);
}

// A pattern has terms beyond the second degree. Those of the third (2 * 3 + 1), of equal size in the plane
// and at the poles.
constexpr Eigen::Index kThirdDegreeTerms = 7;
Eigen::Matrix<double, kThirdDegreeTerms, 1> third_degree_terms(const Eigen::Vector3d& b) noexcept {
  const double x = b.x();
  const double y = b.y();
  const double z = b.z();
  Eigen::Matrix<double, kThirdDegreeTerms, 1> out;
  out << x * (x * x - 3.0 * y * y), y * (3.0 * x * x - y * y), 2.0 * z * (x * x - y * y), 4.0 * x * y * z,
      x * (5.0 * z * z - 1.0), y * (5.0 * z * z - 1.0), z * (5.0 * z * z - 3.0);
  return out;
}

// Gradient of an anchor's cost by its unknowns per coefficient of a pattern of its own antenna, which is
// fixed in the map: sum of weight J h^T.
Eigen::MatrixXd influence_of_own_pattern(const AnchorFit& fit) {
  const std::size_t tags = fit.problem.tag_count;
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(fit.anchor.size(), model::kPatternTerms + kThirdDegreeTerms);
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    const PairRow j = at.value.seen.weight * at.j;
    Eigen::Matrix<double, 1, model::kPatternTerms + kThirdDegreeTerms> terms;
    terms << model::pattern_terms(at.predicted.direction).transpose(),
        third_degree_terms(at.predicted.direction).transpose();
    out(pair_index(row.tag, tags), Eigen::all) += j * terms;
  }
  if (fit.problem.position.surveyed) out.topRows<3>().setZero();
  return out;
}

std::vector<double> inflations(std::span<const AnchorFit> fits, double duration_s) {
  std::vector<double> out;
  for (const AnchorFit& fit : fits) out.push_back(inflation_within(fit.evidence, duration_s));
  return out;
}

// Solves for the unknowns that the prior leaves free, starting from the present estimate, until convergence;
// then fills in covariances. A free delay is fixed at zero if it is not significant.
void settle(Association& association, std::vector<AnchorFit>& fits, bool is_delay_open,
            std::vector<double> inflation, DriveError& out) {
  const SharedUnknowns& unknowns = out.unknowns;
  SharedPrior& prior = out.prior;
  Eigen::VectorXd& error = out.shared_mean;
  JointEquations equations;
  Eigen::MatrixXd covariance;
  for (int round = 0; round < kDriveRounds; ++round) {
    equations = eliminate_anchors(fits, inflation, unknowns);
    Eigen::MatrixXd believed = prior_information(unknowns, prior);
    const auto solve = [&] {
      const Eigen::LDLT<Eigen::MatrixXd> posterior(equations.information + believed);
      covariance = posterior.solve(Eigen::MatrixXd::Identity(unknowns.size(), unknowns.size()));
      return Eigen::VectorXd(posterior.solve(equations.descent - believed * error));
    };
    Eigen::VectorXd step = solve();
    if (round == 0 && is_delay_open) {
      const double sigma_s = std::sqrt(std::max(0.0, covariance(unknowns.delay(), unknowns.delay())));
      if (std::abs(step(unknowns.delay())) < kMinDelaySigmas * sigma_s) {
        out.range_delay_s = step(unknowns.delay());
        out.range_delay_sigma_s = sigma_s;
        prior.delay_sigma_s = kNoDelaySigma_s;
        believed = prior_information(unknowns, prior);
        step = solve();
      }
    }
    if (!step.allFinite() || !covariance.allFinite()) return;
    if (!take_step(association, fits, inflation, unknowns, believed, step, error)) break;
    refine_site(fits, 1);
    // Residuals that the estimate explains are white now; the remaining correlation depends on place.
    gather_evidence(fits);
    inflation = inflations(fits, kWhile_s);
    if (step.dot((equations.information + believed) * step) < kLastStepSigmas * kLastStepSigmas) break;
  }
  if (prior.delay_sigma_s > kNoDelaySigma_s) {
    out.range_delay_s = error(unknowns.delay());
    out.range_delay_sigma_s = std::sqrt(covariance(unknowns.delay(), unknowns.delay()));
  }
  out.body.clear();
  for (std::size_t tag = 0; tag < unknowns.body_tags; ++tag) {
    const Eigen::Index at = unknowns.body(tag);
    out.body.push_back({.mean = error.segment<kBodyTerms>(at),
                        .covariance = covariance.block<kBodyTerms, kBodyTerms>(at, at)});
  }
  const double pattern_m = pattern_size_m(out.body);
  out.shared_gain.clear();
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const AnchorPart& part = equations.anchors[i];
    out.shared_gain.push_back(part.gain);
    out.added_covariance[i] = part.gain * covariance * part.gain.transpose();
    if (!(pattern_m > 0.0) || model::is_ablated(model::Mechanism::kCalibrationOwnPattern)) continue;
    const Eigen::MatrixXd response = part.information.solve(influence_of_own_pattern(fits[i]));
    out.added_covariance[i] += pattern_m * pattern_m * response * response.transpose();
  }
  report_frame(unknowns.knots, covariance, fits, out);
  out.shared_covariance = std::move(covariance);
}

}  // namespace

DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits) {
  DriveError out;
  for (const AnchorFit& fit : fits) {
    out.added_covariance.push_back(Eigen::MatrixXd::Zero(fit.anchor.size(), fit.anchor.size()));
  }
  gather_evidence(fits);
  const std::optional<Knots> placed = place_knots(fits, kCoarseKnots);
  if (!placed) return out;
  DriftSetup setup;
  setup.typical = typical_quality(association.pose_spreads);
  SharedUnknowns& unknowns = setup.unknowns;
  unknowns.knots = *placed;
  unknowns.body_tags = association.tags.size();
  if (setup.typical)
    unknowns.knot_scale = scale_knots(unknowns.knots, association.pose_spreads, *setup.typical);

  std::vector<double> inflation = inflations(fits, kMoment_s);
  JointEquations equations = eliminate_anchors(fits, inflation, unknowns);
  const auto slow = [&] { return eliminate_anchors(fits, inflations(fits, kWhile_s), unknowns); };
  SharedPrior prior = likeliest_prior(equations, setup, slow);
  if (nothing_to_correct(equations, unknowns, prior)) {
    // With the inflation of kWhile_s the ranges carry this much less information about what is constant over
    // the drive.
    const std::vector<double> lasting = inflations(fits, kWhile_s);
    const double share = std::accumulate(inflation.begin(), inflation.end(), 0.0) /
                         std::accumulate(lasting.begin(), lasting.end(), 0.0);
    const Eigen::Index delay = unknowns.delay();
    const double information =
        share * equations.information(delay, delay) + 1.0 / (delay_sigma_s() * delay_sigma_s());
    out.range_delay_s = share * equations.descent(delay) / information;
    out.range_delay_sigma_s = 1.0 / std::sqrt(information);
    report_frame(unknowns.knots, Eigen::MatrixXd::Zero(unknowns.size(), unknowns.size()), fits, out);
    return out;
  }
  out.unknowns = arrange(fits, association.pose_spreads, setup, prior);
  if (prior.drift.sigma_m > 0.0) {
    equations = eliminate_anchors(fits, inflation, out.unknowns);
    prior = likeliest_shape(equations, out.unknowns, refine_drift(equations, out.unknowns, prior));
  }
  out.prior = prior;
  out.shared_mean = Eigen::VectorXd::Zero(out.unknowns.size());
  if (setup.typical && prior.drift.sigma_m > 0.0) {
    const double share = white_share(prior.drift, *setup.typical, out.unknowns.knots.spacing_s);
    for (AnchorObservations& anchor : association.anchors) {
      for (Observation& row : anchor.rows) row.pose_spread_m2 *= static_cast<float>(share);
    }
  }
  settle(association, fits, /*is_delay_open=*/true, inflation, out);
  return out;
}

void correct_further(Association& association, std::vector<AnchorFit>& fits, DriveError& drive_error) {
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const Eigen::Index size = fits[i].anchor.size();
    drive_error.added_covariance[i] = Eigen::MatrixXd::Zero(size, size);
  }
  gather_evidence(fits);
  if (drive_error.shared_gain.empty()) return;
  settle(association, fits, /*is_delay_open=*/false, inflations(fits, kWhile_s), drive_error);
}

}  // namespace groma::calibration
