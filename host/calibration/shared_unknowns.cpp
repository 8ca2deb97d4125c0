#include "host/calibration/shared_unknowns.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/LU>

namespace groma::calibration {
namespace {

// Numerics: the sigmas of poses that count as exact. Their information, 1e12 and 1e14, leaves some digits.
constexpr double kMinPoseSigma_m = 1e-6;
constexpr double kMinPoseSigma_rad = 1e-7;

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

// Sums of one anchor, before its elimination.
struct AnchorSums {
  Eigen::MatrixXd cross;  // with the shared unknowns
  Eigen::MatrixXd own;    // of the shared unknowns, lower triangle
  Eigen::VectorXd descent;
};

// Sums over one tag's observations of the derivatives by the pair (position, terms) and by the first `Shared`
// shared terms. Observations are buffered side by side and summed kLanes at a time.
template <Eigen::Index Shared>
class Moments {
 public:
  static constexpr Eigen::Index kPair = model::kPairSize;
  static constexpr Eigen::Index kSize = kPair + Shared;
  // Shared terms of the two knots.
  static constexpr Eigen::Index kKnots = 6;
  static constexpr Eigen::Index kRest = kPair + kKnots;
  using Row = Eigen::Array<double, 1, kSize>;
  // Index of each term: those by the pair among the anchor's unknowns, the others among the shared ones.
  using Places = Eigen::Array<Eigen::Index, kSize, 1>;

  void add(const Row& j, double slope, double weight) noexcept {
    rows_.row(waiting_) = j;
    weight_(waiting_) = weight;
    slope_(waiting_) = slope;
    if (++waiting_ == kLanes) sum_up();
  }
  // Adds the sums of the terms [begin, end) to `sums` at their indices, and clears them.
  void move_to(const Places& places, Eigen::Index begin, Eigen::Index end, AnchorSums& sums) noexcept {
    sum_up();
    for (Eigen::Index from = begin; from < end; ++from) {
      const Eigen::Index to = places(from);
      for (Eigen::Index row = 0; row < kPair; ++row) take(sums.cross(places(row), to), square_(from, row));
      for (Eigen::Index row = from; row < kSize; ++row) take(sums.own(places(row), to), square_(row, from));
      take(sums.descent(to), descent_(from - kPair));
    }
  }

 private:
  static void take(double& to, double& from) noexcept {
    to += from;
    from = 0.0;
  }
  void sum_up() noexcept {
    if (waiting_ == 0) return;
    // Lanes left over from earlier observations get no weight.
    for (Eigen::Index lane = waiting_; lane < kLanes; ++lane) {
      weight_(lane) = 0.0;
      slope_(lane) = 0.0;
    }
    waiting_ = 0;
    for (Eigen::Index column = 0; column < kSize; ++column) {
      const Lanes weighted = weight_ * rows_.col(column);
      for (Eigen::Index row = std::max(column, kPair); row < kSize; ++row) {
        square_(row, column) += (weighted * rows_.col(row)).sum();
      }
    }
    for (Eigen::Index k = 0; k < Shared; ++k) descent_(k) += (slope_ * rows_.col(kPair + k)).sum();
  }

  Eigen::Matrix<double, kSize, kSize> square_ =
      Eigen::Matrix<double, kSize, kSize>::Zero();  // lower triangle
  Eigen::Matrix<double, Shared, 1> descent_ = Eigen::Matrix<double, Shared, 1>::Zero();
  Eigen::Array<double, kLanes, kSize> rows_ = Eigen::Array<double, kLanes, kSize>::Zero();
  Lanes weight_;
  Lanes slope_;
  Eigen::Index waiting_ = 0;
};

template <Eigen::Index Shared>
void add_rows(const AnchorFit& fit, const SharedUnknowns& unknowns, AnchorSums& sums) {
  using Sums = Moments<Shared>;
  const std::size_t tags = fit.problem.tag_count;
  struct Tag {
    Sums moments;
    typename Sums::Places places;
  };
  std::vector<Tag> of_tag(tags);
  for (std::size_t tag = 0; tag < tags; ++tag) {
    typename Sums::Places& places = of_tag[tag].places;
    const PairIndex pair = pair_index(tag, tags);
    std::copy(pair.begin(), pair.end(), places.data());
    places(Sums::kRest) = unknowns.delay();
    for (Eigen::Index k = 0; Sums::kRest + 1 + k < Sums::kSize; ++k) {
      places(Sums::kRest + 1 + k) = unknowns.body(tag) + k;
    }
  }
  Eigen::Index first = 0;
  // The next observations are between other knots.
  const auto leave_knots = [&] {
    for (auto& [moments, places] : of_tag) {
      for (Eigen::Index k = 0; k < Sums::kKnots; ++k) places(Sums::kPair + k) = first + k;
      moments.move_to(places, Sums::kPair, Sums::kRest, sums);
    }
  };
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    const RowValue& value = at.value;
    const KnotShare share = knot_share(unknowns.knots, row.t_s);
    if (share.first != first) leave_knots();
    first = share.first;
    typename Sums::Row j;
    j.template head<Sums::kPair>() = at.j.array().transpose();
    j.template tail<Shared>() =
        shared_jacobian(row, at.predicted, share.fraction).template head<Shared>().array().transpose();
    // Long NLOS ranges count too: they tie the anchor to the poses, so that a common shift of both changes no
    // residual.
    of_tag[row.tag].moments.add(j, value.seen.slope + value.nlos_slope,
                                value.seen.weight + value.nlos_weight);
    if (value.nlos_weight == 0.0) continue;
    const RangeLos& los_states = fit.problem.los_states->rows[row.index];
    const Eigen::Matrix<double, 1, Shared> by_long_nlos =
        value.nlos_weight * j.template tail<Shared>().matrix();
    const auto add_long_nlos = [&](Eigen::Index to) {
      sums.cross.template block<1, Sums::kKnots>(to, first) += by_long_nlos.template head<Sums::kKnots>();
      for (Eigen::Index k = Sums::kKnots; k < Shared; ++k) {
        sums.cross(to, of_tag[row.tag].places(Sums::kPair + k)) += by_long_nlos(k);
      }
    };
    add_long_nlos(excess_index(tags));
    if (los_states.episode != kNoEpisode) add_long_nlos(episode_index(los_states.episode, tags));
  }
  leave_knots();
  for (auto& [moments, places] : of_tag) moments.move_to(places, Sums::kRest, Sums::kSize, sums);
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

std::optional<Knots> place_knots(std::span<const AnchorFit> fits, const KnotGrid& grid) {
  double begin_s = std::numeric_limits<double>::infinity();
  double end_s = -begin_s;
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    begin_s = std::min(begin_s, fit.problem.rows.front().t_s);
    end_s = std::max(end_s, fit.problem.rows.back().t_s);
  }
  const double duration_s = end_s - begin_s;
  if (!(duration_s > 0.0)) return std::nullopt;
  Knots knots{.begin_s = begin_s};
  knots.spacing_s = std::max(grid.spacing_s, duration_s / (grid.max_count - 1.0));
  knots.count = 2 + static_cast<Eigen::Index>(duration_s / knots.spacing_s);
  return knots;
}

KnotShare knot_share(const Knots& knots, double t_s) noexcept {
  const double position =
      std::clamp((t_s - knots.begin_s) / knots.spacing_s, 0.0, static_cast<double>(knots.count - 1));
  const auto k = std::min(static_cast<Eigen::Index>(position), knots.count - 2);
  return {.first = 3 * k, .fraction = position - static_cast<double>(k)};
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

SharedRow shared_jacobian(const Observation& row, const model::AntennaPrediction& predicted,
                          double fraction) noexcept {
  const Eigen::Vector3d by_antenna = predicted.scale * predicted.direction;
  const double by_yaw = by_antenna.head<2>().dot(row.yaw_arm_m);
  const Eigen::Vector3d drift(by_antenna.x(), by_antenna.y(), by_yaw);
  const Eigen::Vector3d in_body = row.attitude.conjugate().cast<double>() * predicted.direction;
  SharedRow out;
  out << (1.0 - fraction) * drift, fraction * drift, -by_antenna.dot(row.velocity_mps),
      predicted.scale * in_body, model::pattern_terms(in_body);
  return out;
}

void move_row(const SharedUnknowns& unknowns, const Eigen::VectorXd& step, const Eigen::Vector3d& anchor_m,
              Observation& row) noexcept {
  if (unknowns.body_tags > 0) {
    const Eigen::Quaterniond attitude = row.attitude.cast<double>();
    const BodyVector body = step.segment<kBodyTerms>(unknowns.body(row.tag));
    const Eigen::Vector3d in_body = attitude.conjugate() * (row.tag_m - anchor_m).normalized();
    row.range_m -= model::pattern_terms(in_body).dot(body.tail<model::kPatternTerms>());
    row.tag_m += attitude * body.head<3>();
  }
  const KnotShare share = knot_share(unknowns.knots, row.t_s);
  const Eigen::Vector3d error = (1.0 - share.fraction) * step.segment<3>(share.first) +
                                share.fraction * step.segment<3>(share.first + 3);
  row.tag_m.head<2>() += error.head<2>() + error.z() * row.yaw_arm_m;
  row.tag_m -= step(unknowns.delay()) * row.velocity_mps;
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

JointEquations eliminate_anchors(std::span<const AnchorFit> fits, std::span<const double> inflation,
                                 const SharedUnknowns& unknowns) {
  const Eigen::Index size = unknowns.size();
  JointEquations out;
  out.information = Eigen::MatrixXd::Zero(size, size);
  out.descent = Eigen::VectorXd::Zero(size);
  out.anchors.reserve(fits.size());
  AnchorSums sums;
  for (std::size_t i = 0; i < fits.size(); ++i) {
    const AnchorFit& fit = fits[i];
    sums.cross.setZero(fit.anchor.size(), size);
    sums.own.setZero(size, size);
    sums.descent.setZero(size);
    if (unknowns.body_tags > 0) {
      add_rows<kSharedTerms>(fit, unknowns, sums);
    } else {
      add_rows<kMotionTerms>(fit, unknowns, sums);
    }
    if (fit.problem.position.surveyed) sums.cross.topRows<3>().setZero();
    const NormalEquations alone = linearize(fit);
    AnchorPart& part = out.anchors.emplace_back();
    part.information.compute(alone.information);
    part.descent = -alone.gradient;
    // With L L^T the anchor's information, elimination subtracts (L^-1 cross)^T (L^-1 cross) from the shared
    // information.
    const Eigen::MatrixXd half = part.information.matrixL().solve(sums.cross);
    part.gain = part.information.matrixU().solve(half);
    sums.own.selfadjointView<Eigen::Lower>().rankUpdate(half.transpose(), -1.0);
    sums.descent.noalias() -= part.gain.transpose() * part.descent;
    // The anchor's own solution does not depend on the inflation: all its equations are scaled alike.
    const double share_of_one = 1.0 / inflation[i];
    out.information += share_of_one * sums.own;
    out.descent += share_of_one * sums.descent;
  }
  out.information.triangularView<Eigen::StrictlyUpper>() = out.information.transpose();
  return out;
}

}  // namespace groma::calibration
