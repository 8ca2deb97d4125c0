#include "host/calibration/drive_error.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include <Eigen/Cholesky>

namespace groma::calibration {
namespace {

// Knots at most this far apart where the drive is not too long for so many.
struct KnotGrid {
  double spacing_s;
  double max_count;
};
// Coarse is enough to choose a wander. What a line between knots misses of it stays in the residuals.
constexpr KnotGrid kCoarseKnots{.spacing_s = 8.0, .max_count = 48.0};
constexpr KnotGrid kFineKnots{.spacing_s = 4.0, .max_count = 96.0};
constexpr int kRounds = 2;
// Wanders to choose from, by the likelihood of the ranges: first the size of the shift, then all three by
// turns.
constexpr std::array kWander_m{0.02, 0.06, 0.2, 0.6};
constexpr WanderPrior kFirstWander{.sigma_m = 0.0, .sigma_yaw_rad = 0.004, .correlation_s = 20.0};
constexpr std::array kCorrelations_s{5.0, 20.0, 60.0};
constexpr std::array kYawFactors{0.4, 2.5};
constexpr std::array kShiftFactors{0.7, 1.4};
constexpr int kSweeps = 2;
// A wander has to make the ranges likelier by this much (natural logarithm) to be believed.
constexpr double kMinEvidence = 4.0;
constexpr double kDelaySigma_s = 0.03;
constexpr double kMinDelaySigmas = 6.0;
constexpr double kNoDelaySigma_s = 1e-7;
// No localization knows its map better than this; shared by all poses and never seen by ranges.
constexpr double kFrameSigma_m = 0.005;
constexpr double kFrameSigma_rad = 0.0005;

// Where the knots of the wander are; between them it is linear.
struct Knots {
  double begin_s = 0.0;
  double spacing_s = kCoarseKnots.spacing_s;
  Eigen::Index count = 2;

  [[nodiscard]] Eigen::Index size() const noexcept { return 3 * count + 1; }  // x, y, yaw each; the delay
  [[nodiscard]] Eigen::Index delay() const noexcept { return 3 * count; }
};

struct KnotShare {
  Eigen::Index first = 0;  // its knot's first index
  double fraction = 0.0;   // of the way to the next
};

KnotShare knot_share(const Knots& knots, double t_s) noexcept {
  const double position =
      std::clamp((t_s - knots.begin_s) / knots.spacing_s, 0.0, static_cast<double>(knots.count - 1));
  const auto k = std::min(static_cast<Eigen::Index>(position), knots.count - 2);
  return {.first = 3 * k, .fraction = position - static_cast<double>(k)};
}

std::optional<Knots> place_knots(std::span<const AnchorFit> fits, const KnotGrid& grid) {
  double begin_s = std::numeric_limits<double>::infinity();
  double end_s = -std::numeric_limits<double>::infinity();
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    begin_s = std::min(begin_s, fit.problem.rows.front().t_s);
    end_s = std::max(end_s, fit.problem.rows.back().t_s);
  }
  if (!(end_s > begin_s)) return std::nullopt;
  Knots knots;
  knots.begin_s = begin_s;
  knots.spacing_s = std::max(grid.spacing_s, (end_s - begin_s) / (grid.max_count - 1.0));
  knots.count = 2 + static_cast<Eigen::Index>((end_s - begin_s) / knots.spacing_s);
  return knots;
}

// One anchor's part of the joint normal equations, solved for the anchor.
struct AnchorPart {
  Eigen::LDLT<Eigen::MatrixXd> information;
  Eigen::VectorXd descent;
  Eigen::MatrixXd gain;  // information^-1 times the cross information with the drive's error
};

// The joint normal equations with the anchors eliminated (Schur complement).
struct JointEquations {
  std::vector<AnchorPart> anchors;
  Eigen::MatrixXd information;  // of the drive's error, its prior left out
  Eigen::VectorXd descent;
};

// `inflation` of each anchor: its ranges carry so many times less than were they independent.
JointEquations build(std::span<const AnchorFit> fits, std::span<const double> inflation, const Knots& knots) {
  JointEquations out;
  out.information = Eigen::MatrixXd::Zero(knots.size(), knots.size());
  out.descent = Eigen::VectorXd::Zero(knots.size());
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const AnchorFit& fit = fits[i];
    const std::size_t tags = fit.problem.tag_count;
    const double share_of_one = 1.0 / inflation[i];
    const NormalEquations alone = linearize(fit.problem, fit.kernels, fit.anchor);
    Eigen::MatrixXd cross = Eigen::MatrixXd::Zero(fit.anchor.size(), knots.size());
    Eigen::MatrixXd own = Eigen::MatrixXd::Zero(knots.size(), knots.size());
    Eigen::VectorXd descent = Eigen::VectorXd::Zero(knots.size());
    for (const Observation& row : fit.problem.rows) {
      const model::AntennaPrediction predicted = predict(row, fit.anchor, tags);
      const KernelValue value = fit.kernels[row.tag].at(row.range_m - predicted.range_m);
      const Eigen::Index beta = beta_index(row.tag);
      const Eigen::Index gamma = gamma_index(row.tag, tags);
      const PairRow j = pair_jacobian(predicted, fit.anchor(gamma));
      const Eigen::Vector3d by_antenna = -j.head<3>();
      const KnotShare share = knot_share(knots, row.t_s);
      Eigen::Matrix<double, 7, 1> by_error;
      const double by_yaw = by_antenna.head<2>().dot(row.yaw_arm_m);
      const double left = 1.0 - share.fraction;
      by_error << left * by_antenna.x(), left * by_antenna.y(), left * by_yaw,
          share.fraction * by_antenna.x(), share.fraction * by_antenna.y(), share.fraction * by_yaw,
          -by_antenna.dot(row.velocity_mps);
      const Eigen::Matrix<double, 7, 1> weighted = value.weight * by_error;
      const Eigen::Matrix<double, 7, 7> square = weighted * by_error.transpose();
      own.block<6, 6>(share.first, share.first) += square.topLeftCorner<6, 6>();
      own.block<6, 1>(share.first, knots.delay()) += square.topRightCorner<6, 1>();
      own.block<1, 6>(knots.delay(), share.first) += square.bottomLeftCorner<1, 6>();
      own(knots.delay(), knots.delay()) += square(6, 6);
      descent.segment<6>(share.first) += value.slope * by_error.head<6>();
      descent(knots.delay()) += value.slope * by_error(6);
      cross.block<3, 6>(0, share.first) += j.head<3>() * weighted.head<6>().transpose();
      cross.block<3, 1>(0, knots.delay()) += j.head<3>() * weighted(6);
      cross.block<1, 6>(beta, share.first) += weighted.head<6>().transpose();
      cross(beta, knots.delay()) += weighted(6);
      cross.block<1, 6>(gamma, share.first) += j(4) * weighted.head<6>().transpose();
      cross(gamma, knots.delay()) += j(4) * weighted(6);
    }
    if (fit.problem.position.surveyed) cross.topRows<3>().setZero();
    AnchorPart part;
    part.information.compute(alone.information);
    part.descent = -alone.gradient;
    part.gain = part.information.solve(cross);
    // The anchor's own solution is the same at any inflation: its equations are scaled as one.
    own.noalias() -= cross.transpose() * part.gain;
    descent.noalias() -= part.gain.transpose() * part.descent;
    out.information += share_of_one * own;
    out.descent += share_of_one * descent;
    out.anchors.push_back(std::move(part));
  }
  return out;
}

// What a knot keeps of the error at the one before.
double kept_share(const Knots& knots, const WanderPrior& wander) noexcept {
  return std::exp(-knots.spacing_s / wander.correlation_s);
}

// Information of the prior; a sigma of zero stands for one too small to matter.
Eigen::MatrixXd prior_information(const Knots& knots, const WanderPrior& wander, double delay_sigma_s) {
  // Of a first-order process at equal steps: tridiagonal.
  const double keep = kept_share(knots, wander);
  const double fresh = 1.0 / (1.0 - keep * keep);
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(knots.size(), knots.size());
  const double sigma_m = std::max(wander.sigma_m, 1e-6);
  const double sigma_rad = std::max(wander.sigma_yaw_rad, 1e-7);
  const std::array<double, 3> inverse{1.0 / (sigma_m * sigma_m), 1.0 / (sigma_m * sigma_m),
                                      1.0 / (sigma_rad * sigma_rad)};
  for (Eigen::Index k = 0; k < knots.count; ++k) {
    const bool inner = k > 0 && k + 1 < knots.count;
    for (Eigen::Index axis = 0; axis < 3; ++axis) {
      const double scale = inverse[static_cast<std::size_t>(axis)] * fresh;
      const Eigen::Index here = 3 * k + axis;
      out(here, here) = scale * (inner ? 1.0 + keep * keep : 1.0);
      if (k + 1 == knots.count) continue;
      out(here, here + 3) = -scale * keep;
      out(here + 3, here) = -scale * keep;
    }
  }
  out(knots.delay(), knots.delay()) = 1.0 / (delay_sigma_s * delay_sigma_s);
  return out;
}

double log_determinant(const Eigen::LLT<Eigen::MatrixXd>& factors) {
  return 2.0 * Eigen::MatrixXd(factors.matrixL()).diagonal().array().log().sum();
}

// Log likelihood of the ranges with the drive's error integrated out, but for a constant.
double evidence(const JointEquations& equations, const Knots& knots, const WanderPrior& wander) {
  const double delay_information = 1.0 / (kDelaySigma_s * kDelaySigma_s);
  if (!(wander.sigma_m > 0.0)) {
    const double information = equations.information(knots.delay(), knots.delay()) + delay_information;
    const double descent = equations.descent(knots.delay());
    return 0.5 * descent * descent / information - 0.5 * std::log(information / delay_information);
  }
  const Eigen::LLT<Eigen::MatrixXd> posterior(equations.information +
                                              prior_information(knots, wander, kDelaySigma_s));
  if (posterior.info() != Eigen::Success) return -std::numeric_limits<double>::infinity();
  // Of the prior's information: a first-order process is a product of its steps.
  const double keep = kept_share(knots, wander);
  const auto n = static_cast<double>(knots.count);
  const double log_determinant_before =
      -n * (4.0 * std::log(wander.sigma_m) + 2.0 * std::log(wander.sigma_yaw_rad)) -
      3.0 * (n - 1.0) * std::log1p(-keep * keep) + std::log(delay_information);
  return 0.5 * equations.descent.dot(posterior.solve(equations.descent)) -
         0.5 * (log_determinant(posterior) - log_determinant_before);
}

// All sigmas zero where none makes the ranges likelier by enough.
WanderPrior likeliest_wander(const JointEquations& equations, const Knots& knots) {
  WanderPrior best;
  double best_evidence = evidence(equations, knots, best) + kMinEvidence;
  const auto consider = [&](const WanderPrior& wander) {
    const double found = evidence(equations, knots, wander);
    if (found <= best_evidence) return false;
    best = wander;
    best_evidence = found;
    return true;
  };
  for (const double sigma_m : kWander_m) {
    WanderPrior wander = kFirstWander;
    wander.sigma_m = sigma_m;
    consider(wander);
  }
  if (!(best.sigma_m > 0.0)) return best;
  const auto scale = [&](double WanderPrior::*sigma, double factor) {
    WanderPrior wander = best;
    wander.*sigma *= factor;
    return consider(wander);
  };
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (const double correlation_s : kCorrelations_s) {
      WanderPrior wander = best;
      wander.correlation_s = correlation_s;
      consider(wander);
    }
    for (const double factor : kYawFactors) {
      if (scale(&WanderPrior::sigma_yaw_rad, factor)) scale(&WanderPrior::sigma_yaw_rad, factor);
    }
    for (const double factor : kShiftFactors) scale(&WanderPrior::sigma_m, factor);
  }
  return best;
}

// No wander, and a delay that the ranges do not show: poses and stamps are right as they are.
bool nothing_to_correct(const JointEquations& equations, const Knots& knots, const WanderPrior& wander) {
  if (wander.sigma_m > 0.0) return false;
  const double information =
      equations.information(knots.delay(), knots.delay()) + 1.0 / (kDelaySigma_s * kDelaySigma_s);
  return std::abs(equations.descent(knots.delay())) < kMinDelaySigmas * std::sqrt(information);
}

void move_rows(Association& association, const Knots& knots, const Eigen::VectorXd& step) {
  for (AnchorObservations& anchor : association.anchors) {
    for (Observation& row : anchor.rows) {
      const KnotShare share = knot_share(knots, row.t_s);
      const Eigen::Vector3d error = (1.0 - share.fraction) * step.segment<3>(share.first) +
                                    share.fraction * step.segment<3>(share.first + 3);
      row.tag_m.head<2>() += error.head<2>() + error.z() * row.yaw_arm_m;
      row.tag_m -= step(knots.delay()) * row.velocity_mps;
    }
  }
}

// Robust cost of all anchors as they would be after a step.
double cost_after(std::span<const AnchorFit> fits, std::span<const AnchorVector> anchors,
                  std::span<const double> inflation) {
  double cost = 0.0;
  for (std::size_t i = 0; i < fits.size(); ++i) {
    cost += robust_cost(fits[i].problem, fits[i].kernels, anchors[i]) / inflation[i];
  }
  return cost;
}

// Takes the step, or as much of it as lowers the cost; false: none of it does.
bool take_step(Association& association, std::vector<AnchorFit>& fits, std::span<const double> inflation,
               const JointEquations& equations, const Knots& knots, const Eigen::MatrixXd& prior,
               const Eigen::VectorXd& step, Eigen::VectorXd& error) {
  std::vector<AnchorVector> before;
  std::vector<AnchorVector> change;
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const AnchorPart& part = equations.anchors[i];
    before.push_back(fits[i].anchor);
    change.push_back(part.information.solve(part.descent) - part.gain * step);
  }
  const double cost_before = cost_after(fits, before, inflation) + 0.5 * error.dot(prior * error);
  double taken = 0.0;
  for (const double share : {1.0, 0.5, 0.25, 0.125, 0.0}) {
    move_rows(association, knots, (share - taken) * step);
    taken = share;
    if (share == 0.0) break;
    std::vector<AnchorVector> after;
    after.reserve(fits.size());
    for (std::size_t i = 0; i < fits.size(); ++i) after.push_back(before[i] + share * change[i]);
    const Eigen::VectorXd moved = error + share * step;
    const double cost = cost_after(fits, after, inflation) + 0.5 * moved.dot(prior * moved);
    if (!(cost < cost_before)) continue;
    for (std::size_t i = 0; i < fits.size(); ++i) fits[i].anchor = after[i];
    error = moved;
    return true;
  }
  return false;
}

Eigen::Vector2d mean_antenna_m(std::span<const AnchorFit> fits) {
  Eigen::Vector2d sum_m = Eigen::Vector2d::Zero();
  double n = 0.0;
  for (const AnchorFit& fit : fits) {
    for (const Observation& row : fit.problem.rows) sum_m += row.tag_m.head<2>();
    n += static_cast<double>(fit.problem.rows.size());
  }
  return n > 0.0 ? Eigen::Vector2d(sum_m / n) : sum_m;
}

// Covariance of the mean of all knots, and what no range can tell, about the map's origin.
Eigen::Matrix4d frame_covariance(const Knots& knots, const Eigen::MatrixXd& covariance,
                                 const Eigen::Vector2d& center_m) {
  Eigen::Matrix3d mean = Eigen::Matrix3d::Zero();
  const double knots_squared = static_cast<double>(knots.count * knots.count);
  for (Eigen::Index i = 0; i < knots.count; ++i) {
    for (Eigen::Index k = 0; k < knots.count; ++k)
      mean += covariance.block<3, 3>(3 * i, 3 * k) / knots_squared;
  }
  Eigen::Matrix4d about_center = Eigen::Matrix4d::Zero();
  about_center.topLeftCorner<2, 2>() = mean.topLeftCorner<2, 2>();
  about_center(3, 3) = mean(2, 2);
  const double square_m2 = kFrameSigma_m * kFrameSigma_m;
  about_center.diagonal() +=
      Eigen::Vector4d(square_m2, square_m2, square_m2, kFrameSigma_rad * kFrameSigma_rad);
  // A turn about the center is a turn about the origin and the shift that takes the center back.
  Eigen::Matrix4d about_origin = Eigen::Matrix4d::Identity();
  about_origin(0, 3) = center_m.y();
  about_origin(1, 3) = -center_m.x();
  return about_origin * about_center * about_origin.transpose();
}

std::vector<Evidence> evidence_of(std::span<const AnchorFit> fits) {
  std::vector<Evidence> out;
  out.reserve(fits.size());
  for (const AnchorFit& fit : fits) out.push_back(gather_evidence(fit));
  return out;
}

}  // namespace

DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits,
                         const model::RangePriors& priors) {
  DriveError out;
  for (const AnchorFit& fit : fits) {
    out.added_covariance.push_back(Eigen::MatrixXd::Zero(fit.anchor.size(), fit.anchor.size()));
  }
  out.evidence = evidence_of(fits);
  const std::optional<Knots> placed = place_knots(fits, kCoarseKnots);
  if (!placed) return out;
  Knots knots = *placed;

  std::vector<double> inflation;
  inflation.reserve(fits.size());
  for (const Evidence& of_anchor : out.evidence) inflation.push_back(moment_inflation(of_anchor));
  JointEquations equations = build(fits, inflation, knots);
  out.wander = likeliest_wander(equations, knots);
  if (nothing_to_correct(equations, knots, out.wander)) {
    out.frame_covariance =
        frame_covariance(knots, Eigen::MatrixXd::Zero(knots.size(), knots.size()), mean_antenna_m(fits));
    return out;
  }
  if (out.wander.sigma_m > 0.0) {
    knots = place_knots(fits, kFineKnots).value_or(knots);
    equations = build(fits, inflation, knots);
  }
  double delay_sigma_s = kDelaySigma_s;
  Eigen::VectorXd error = Eigen::VectorXd::Zero(knots.size());
  Eigen::MatrixXd covariance;
  for (int round = 0; round < kRounds; ++round) {
    if (round > 0) equations = build(fits, inflation, knots);
    Eigen::MatrixXd prior = prior_information(knots, out.wander, delay_sigma_s);
    const auto solve = [&] {
      const Eigen::LDLT<Eigen::MatrixXd> posterior(equations.information + prior);
      covariance = posterior.solve(Eigen::MatrixXd::Identity(knots.size(), knots.size()));
      return Eigen::VectorXd(posterior.solve(equations.descent - prior * error));
    };
    Eigen::VectorXd step = solve();
    if (round == 0) {
      const double sigma_s = std::sqrt(std::max(0.0, covariance(knots.delay(), knots.delay())));
      if (std::abs(step(knots.delay())) < kMinDelaySigmas * sigma_s) {
        delay_sigma_s = kNoDelaySigma_s;
        prior = prior_information(knots, out.wander, delay_sigma_s);
        step = solve();
      }
    }
    if (!step.allFinite() || !covariance.allFinite()) {
      out.evidence = evidence_of(fits);
      return out;
    }
    if (!take_step(association, fits, inflation, equations, knots, prior, step, error)) break;
    refine_site(fits, priors, 1);
  }
  out.range_delay_s = delay_sigma_s > kNoDelaySigma_s ? error(knots.delay()) : 0.0;
  out.range_delay_sigma_s =
      delay_sigma_s > kNoDelaySigma_s ? std::sqrt(covariance(knots.delay(), knots.delay())) : 0.0;
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const Eigen::MatrixXd& gain = equations.anchors[i].gain;
    out.added_covariance[i] = gain * covariance * gain.transpose();
  }
  out.frame_covariance = frame_covariance(knots, covariance, mean_antenna_m(fits));
  out.evidence = evidence_of(fits);
  return out;
}

}  // namespace groma::calibration
