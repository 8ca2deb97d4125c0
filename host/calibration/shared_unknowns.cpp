#include "host/calibration/shared_unknowns.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Numerics: the sigmas of poses that count as exact. Their information, 1e12 and 1e14, leaves some digits.
constexpr double kMinPoseSigma_m = 1e-6;
constexpr double kMinPoseSigma_rad = 1e-7;

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
// Least gain in log evidence (nats) to accept a drift, body terms, or body terms in addition to a drift; and
// a smooth or an oscillating drift in place of a rough one. By hand: 1, 4, 8 and 10 nats are odds of 2.7, 55,
// 3000 and 22000 to 1. DriveError.DistinguishesSmooth..., LeavesExactPoses... and
// DoesNotTakePlaceDependentErrors... hold with them.
constexpr double kMinDriftEvidence = 4.0;
constexpr double kMinBodyEvidence = 10.0;
constexpr double kMinMoreBodyEvidence = 8.0;
constexpr double kMinSmoothEvidence = 1.0;
constexpr double kMinOscillationEvidence = 4.0;
// Least gain that has to remain with the lasting inflation: errors that depend on place
// in each anchor's own ranges can look like shared ones. By hand;
// DriveError.DoesNotTakePlaceDependentErrors... holds with it: neither is accepted in any of six drives with
// place-dependent errors of 0.08 m.
constexpr double kMinLastingDrift = 4.0;
constexpr double kMinLastingBody = 2.0;

constexpr double inverse_square(double x) noexcept {
  return 1.0 / (x * x);
}

// Added to the unit variance at each knot: a smooth process is nearly equal at neighbouring knots, and its
// correlation matrix would be singular. Numerics: 1e-3 of the drift's sigma, far above a double's rounding.
constexpr double kLeastFresh = 1e-6;

// Correlation matrix of one axis over all knots.
Eigen::MatrixXd knot_correlation(const Knots& knots, const DriftPrior& drift) {
  Eigen::MatrixXd out(knots.count, knots.count);
  for (Eigen::Index i = 0; i < knots.count; ++i) {
    for (Eigen::Index k = 0; k < knots.count; ++k)
      out(i, k) = drift_correlation(drift, static_cast<double>(i - k) * knots.spacing_s);
    out(i, i) += kLeastFresh;
  }
  return out;
}

Eigen::MatrixXd knot_information(const Knots& knots, const DriftPrior& drift) {
  if (drift.damping_ratio) {
    return knot_correlation(knots, drift).llt().solve(Eigen::MatrixXd::Identity(knots.count, knots.count));
  }
  const double keep = drift_correlation(drift, knots.spacing_s);
  const double fresh = 1.0 / (1.0 - keep * keep);
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(knots.count, knots.count);
  for (Eigen::Index k = 0; k < knots.count; ++k) {
    const bool inner = k > 0 && k + 1 < knots.count;
    out(k, k) = fresh * (inner ? 1.0 + keep * keep : 1.0);
    if (k + 1 == knots.count) continue;
    out(k, k + 1) = -fresh * keep;
    out(k + 1, k) = -fresh * keep;
  }
  return out;
}

double knot_log_determinant(const Knots& knots, const DriftPrior& drift) {
  if (drift.damping_ratio) {
    const Eigen::LLT<Eigen::MatrixXd> factors(knot_correlation(knots, drift));
    return 2.0 * factors.matrixLLT().diagonal().array().log().sum();
  }
  // A first-order process factors into its steps.
  const double keep = drift_correlation(drift, knots.spacing_s);
  return (static_cast<double>(knots.count) - 1.0) * std::log1p(-keep * keep);
}

BodyVector body_information() noexcept {
  BodyVector out;
  out.head<3>().setConstant(inverse_square(kLeverArmSigma_m));
  out.tail<model::kPatternTerms>().setConstant(inverse_square(kPatternSigma_m));
  return out;
}

// Log evidence: log likelihood of the ranges with the drive's error marginalized, up to a constant.
double evidence(const SharedEquations& equations, const SharedUnknowns& unknowns, const SharedPrior& prior) {
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
void keep_likelier(const SharedEquations& equations, const SharedUnknowns& unknowns, const SharedPrior& prior,
                   double min_gain, Belief& best) {
  const double found = evidence(equations, unknowns, prior) - min_gain;
  if (found > best.evidence) best = {.prior = prior, .evidence = found};
}

// Most likely drift in addition to `before`; `before` itself if none gains enough evidence.
Belief select_drift(const SharedEquations& equations, const SharedUnknowns& unknowns, const Belief& before) {
  if (model::is_ablated(model::Mechanism::kCalibrationDrift)) return before;
  Belief best = before;
  best.evidence += kMinDriftEvidence;
  SharedPrior prior = before.prior;
  prior.drift = kFirstDrift;
  for (const double sigma_m : kDriftSigmas_m) {
    prior.drift.sigma_m = sigma_m;
    keep_likelier(equations, unknowns, prior, 0.0, best);
  }
  if (unknowns.typical) {
    prior.drift.sigma_m = unknowns.typical->sigma_m;
    prior.drift.sigma_yaw_rad = unknowns.typical->sigma_yaw_rad;
    keep_likelier(equations, unknowns, prior, 0.0, best);
  }
  return best.prior.drift.sigma_m > 0.0 ? best : before;
}

// The first-order drift that maximizes the evidence.
SharedPrior refine_drift(const SharedEquations& equations, const SharedUnknowns& unknowns,
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

Belief select_body(const SharedEquations& equations, const SharedUnknowns& unknowns, const Belief& before,
                   double min_evidence) {
  if (model::is_ablated(model::Mechanism::kCalibrationBody)) return before;
  SharedPrior prior = before.prior;
  prior.body = true;
  const Belief found{.prior = prior, .evidence = evidence(equations, unknowns, prior)};
  return found.evidence > before.evidence + min_evidence ? found : before;
}

}  // namespace

double drift_correlation(const DriftPrior& drift, double apart_s) noexcept {
  const double a = std::abs(apart_s) / drift.correlation_s;
  if (!drift.damping_ratio) return std::exp(-a);
  const double damping = *drift.damping_ratio;
  if (damping >= 1.0) return (1.0 + a) * std::exp(-a);
  const double frequency = std::sqrt(1.0 - damping * damping);
  return std::exp(-damping * a) * (std::cos(frequency * a) + damping / frequency * std::sin(frequency * a));
}

std::optional<SharedUnknowns> lay_out(std::span<const AnchorFit> fits, std::span<const PoseSpread> spreads,
                                      const KnotGrid& grid, std::size_t body_tags) {
  double begin_s = std::numeric_limits<double>::infinity();
  double end_s = -begin_s;
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    begin_s = std::min(begin_s, fit.problem.rows.front().t_s);
    end_s = std::max(end_s, fit.problem.rows.back().t_s);
  }
  const double duration_s = end_s - begin_s;
  if (!(duration_s > 0.0)) return std::nullopt;
  SharedUnknowns out;
  out.body_tags = body_tags;
  Knots& knots = out.knots;
  knots.begin_s = begin_s;
  knots.spacing_s = std::max(grid.spacing_s, duration_s / (grid.max_count - 1.0));
  knots.count = 2 + static_cast<Eigen::Index>(duration_s / knots.spacing_s);
  out.typical = typical_quality(spreads);
  if (out.typical) out.knot_scale = scale_knots(knots, spreads, *out.typical);
  return out;
}

std::optional<PoseQuality> typical_quality(std::span<const PoseSpread> spreads) {
  if (spreads.empty()) return std::nullopt;
  std::vector<double> place_m2;
  std::vector<double> yaw_rad2;
  for (const PoseSpread& spread : spreads) {
    place_m2.push_back(0.5 * (spread.covariance(0, 0) + spread.covariance(1, 1)));
    yaw_rad2.push_back(spread.covariance(2, 2));
  }
  return PoseQuality{.sigma_m = std::max(std::sqrt(median(std::move(place_m2))), kMinPoseSigma_m),
                     .sigma_yaw_rad = std::max(std::sqrt(median(std::move(yaw_rad2))), kMinPoseSigma_rad)};
}

std::vector<Eigen::Matrix3d> scale_knots(const Knots& knots, std::span<const PoseSpread> spreads,
                                         const PoseQuality& typical) {
  const auto count = static_cast<std::size_t>(knots.count);
  std::vector<Eigen::Matrix3d> sums(count, Eigen::Matrix3d::Zero());
  std::vector<double> poses(count, 0.0);
  for (const PoseSpread& spread : spreads) {
    const double position = std::round((spread.t_s - knots.begin_s) / knots.spacing_s);
    if (position < 0.0 || position > static_cast<double>(count - 1)) continue;
    const auto k = static_cast<std::size_t>(position);
    sums[k] += spread.covariance;
    poses[k] += 1.0;
  }
  const Eigen::Vector3d unit(1.0 / typical.sigma_m, 1.0 / typical.sigma_m, 1.0 / typical.sigma_yaw_rad);
  // Keeps a knot from being held so much tighter than a typical one that the equations lose precision.
  // Numerics: weights then differ by 1e6 at most.
  constexpr double kLeastScale = 1e-3;
  std::vector<Eigen::Matrix3d> out(count, Eigen::Matrix3d::Identity());
  for (std::size_t k = 0; k < count; ++k) {
    if (!(poses[k] > 0.0)) continue;
    Eigen::Matrix3d relative = unit.asDiagonal() * sums[k] * unit.asDiagonal() / poses[k];
    relative.diagonal().array() += kLeastScale * kLeastScale + 1e-6 * relative.diagonal().array();
    const Eigen::LLT<Eigen::Matrix3d> factors(relative);
    if (factors.info() != Eigen::Success) continue;
    out[k] = unit.cwiseInverse().asDiagonal() * Eigen::Matrix3d(factors.matrixL()) * unit.asDiagonal();
  }
  return out;
}

double white_share(const DriftPrior& drift, const PoseQuality& typical, double spacing_s) {
  const double slow = std::pow(drift.sigma_m / typical.sigma_m, 2);
  // Mean variance between two knots of the error of linear interpolation, for a process of unit variance.
  constexpr int kPlaces = 8;  // midpoint rule
  const double over_way = drift_correlation(drift, spacing_s);
  double missed = 0.0;
  for (int i = 0; i < kPlaces; ++i) {
    const double f = (i + 0.5) / kPlaces;
    missed += (1.0 + f * f + (1.0 - f) * (1.0 - f) + 2.0 * f * (1.0 - f) * over_way -
               2.0 * (1.0 - f) * drift_correlation(drift, f * spacing_s) -
               2.0 * f * drift_correlation(drift, (1.0 - f) * spacing_s)) /
              kPlaces;
  }
  return std::max(0.0, 1.0 - slow) + std::min(1.0, slow) * missed;
}

Eigen::MatrixXd prior_information(const SharedUnknowns& unknowns, const SharedPrior& prior) {
  const Knots& knots = unknowns.knots;
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(unknowns.size(), unknowns.size());
  const double shift = inverse_square(std::max(prior.drift.sigma_m, kMinPoseSigma_m));
  const double turn = inverse_square(std::max(prior.drift.sigma_yaw_rad, kMinPoseSigma_rad));
  const Eigen::Vector3d inverse(shift, shift, turn);
  std::vector<Eigen::Matrix3d> inverse_scale;
  inverse_scale.reserve(unknowns.knot_scale.size());
  for (const Eigen::Matrix3d& scale : unknowns.knot_scale) inverse_scale.emplace_back(scale.inverse());
  const Eigen::MatrixXd of_axis = knot_information(knots, prior.drift);
  for (Eigen::Index k = 0; k < knots.count; ++k) {
    for (Eigen::Index other = 0; other < knots.count; ++other) {
      if (of_axis(k, other) == 0.0) continue;
      auto block = out.block<3, 3>(3 * k, 3 * other);
      block.diagonal() = of_axis(k, other) * inverse;
      if (inverse_scale.empty()) continue;
      block = (inverse_scale[static_cast<std::size_t>(k)].transpose() * block *
               inverse_scale[static_cast<std::size_t>(other)])
                  .eval();
    }
  }
  out(unknowns.delay(), unknowns.delay()) = inverse_square(prior.delay_sigma_s);
  for (std::size_t tag = 0; tag < unknowns.body_tags; ++tag) {
    out.diagonal().segment<kBodyTerms>(unknowns.body(tag)) = body_information();
  }
  return out;
}

double prior_log_determinant(const SharedUnknowns& unknowns, const SharedPrior& prior) {
  double out = -2.0 * std::log(prior.delay_sigma_s);
  if (prior.drift.sigma_m > 0.0) {
    const auto n = static_cast<double>(unknowns.knots.count);
    out -= n * (4.0 * std::log(prior.drift.sigma_m) + 2.0 * std::log(prior.drift.sigma_yaw_rad)) +
           3.0 * knot_log_determinant(unknowns.knots, prior.drift);
    for (const Eigen::Matrix3d& scale : unknowns.knot_scale)
      out -= 2.0 * std::log(std::abs(scale.determinant()));
  }
  if (prior.body) {
    out += static_cast<double>(unknowns.body_tags) * body_information().array().log().sum();
  }
  return out;
}

SharedPrior likeliest_prior(const SharedEquations& equations, const SharedUnknowns& unknowns,
                            const std::function<SharedEquations()>& slow) {
  Belief nothing;
  if (model::is_ablated(model::Mechanism::kCalibrationDelay)) nothing.prior.delay_sigma_s = kNoDelaySigma_s;
  nothing.evidence = evidence(equations, unknowns, nothing.prior);
  // First the one with more evidence under `slow`, then the other.
  Belief drift = select_drift(equations, unknowns, nothing);
  Belief body = select_body(equations, unknowns, nothing, kMinBodyEvidence);
  if (!(drift.prior.drift.sigma_m > 0.0) && !body.prior.body) return nothing.prior;

  const SharedEquations lasting = slow();
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
  drift = select_drift(equations, unknowns, body);
  return gain(drift, body) < kMinLastingDrift ? body.prior : drift.prior;
}

SharedPrior likeliest_drift(const SharedEquations& equations, const SharedUnknowns& unknowns,
                            const SharedPrior& rough) {
  const SharedPrior first_order = refine_drift(equations, unknowns, rough);
  if (model::is_ablated(model::Mechanism::kCalibrationSmoothDrift)) return first_order;
  // A smooth or oscillating drift, if that gains enough evidence.
  Belief best{.prior = first_order, .evidence = evidence(equations, unknowns, first_order)};
  const auto least_gain = [](double damping_ratio) {
    return kMinSmoothEvidence + (damping_ratio < 1.0 ? kMinOscillationEvidence : 0.0);
  };
  for (const double factor : kSmoothFactors) {
    for (const double damping_ratio : kDampingRatios) {
      for (const double time_s : kSmoothTimes_s) {
        SharedPrior prior = first_order;
        prior.drift.sigma_m *= factor;
        prior.drift.correlation_s = time_s;
        prior.drift.damping_ratio = damping_ratio;
        keep_likelier(equations, unknowns, prior, least_gain(damping_ratio), best);
      }
    }
  }
  if (!best.prior.drift.damping_ratio) return first_order;
  for (const double factor : kYawFactors) {
    SharedPrior prior = best.prior;
    prior.drift.sigma_yaw_rad *= factor;
    keep_likelier(equations, unknowns, prior, least_gain(*prior.drift.damping_ratio), best);
  }
  return best.prior;
}

}  // namespace groma::calibration
