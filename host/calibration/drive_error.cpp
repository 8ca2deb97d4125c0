#include "host/calibration/drive_error.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>
#include <span>
#include <utility>

#include "host/calibration/site_solver.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Coarse knots are enough to select a drift. What linear interpolation misses stays in the residuals. Tuned
// on the simulated demonstration: a correlation time chosen on knots 8 s apart, not 4 s, made the frame's
// sigma up to 0.07 m for an error of 0.01 m. The counts bound the time of a dense solution: by hand.
constexpr KnotGrid kCoarseKnots{.spacing_s = 8.0, .max_count = 48.0};
constexpr KnotGrid kFineKnots{.spacing_s = 4.0, .max_count = 96.0};
constexpr KnotGrid kNoKnots{.spacing_s = 1e9, .max_count = 2.0};  // two: the fewest, at the drive's ends
constexpr int kDriveRounds = 4;                                   // bounds on time, by hand
constexpr int kFollowingSteps = 3;
constexpr double kLastStepSigmas = 0.1;  // 0.01 in chi square
// 4 sigmas: 6e-5 by chance (normal, two-sided).
constexpr double kMinDelaySigmas = 4.0;
// Frame error common to all poses, which no range observes: no localization knows its map better. By
// hand; 0.005 m and 0.0005 rad until the drift's own share of the frame was estimated.
constexpr double kDriveFrameSigma_m = 0.002;
constexpr double kFrameSigma_rad = 0.0002;

// Sums of one anchor, before its elimination.
struct AnchorSums {
  Eigen::MatrixXd cross;  // with the shared unknowns
  Eigen::MatrixXd own;    // of the shared unknowns, lower triangle
  Eigen::VectorXd descent;
};

// Sums over one tag's observations of the derivatives by the pair (position, terms) and by the shared terms,
// without the body terms if these are no unknowns. Observations are buffered side by side and summed kLanes
// at a time.
class Moments {
 public:
  static constexpr Eigen::Index kPair = model::kPairSize;
  static constexpr Eigen::Index kSize = kPair + kSharedTerms;
  // The shared terms from here on are not of the two knots.
  static constexpr Eigen::Index kRest = kPair + 6;
  using Row = Eigen::Array<double, 1, kSize>;

  Moments(const SharedUnknowns& unknowns, std::size_t tag, std::size_t tags)
      : size_(unknowns.body_tags > 0 ? kSize : kSize - kBodyTerms) {
    const PairIndex pair = pair_index(tag, tags);
    std::copy(pair.begin(), pair.end(), places_.data());
    places_(kRest) = unknowns.delay();
    for (Eigen::Index k = kRest + 1; k < size_; ++k) places_(k) = unknowns.body(tag) + k - kRest - 1;
  }

  void add(const Row& j, double slope, double weight) noexcept {
    rows_.row(waiting_) = j;
    weight_(waiting_) = weight;
    slope_(waiting_) = slope;
    if (++waiting_ == kLanes) sum_up();
  }
  // Adds the sums of the two knots' terms, the first of which has the index `first`, to `sums` and clears
  // them.
  void move_knots_to(Eigen::Index first, AnchorSums& sums) noexcept {
    for (Eigen::Index k = kPair; k < kRest; ++k) places_(k) = first + k - kPair;
    move_to(kPair, kRest, sums);
  }
  void move_rest_to(AnchorSums& sums) noexcept { move_to(kRest, size_, sums); }
  // Adds weight times the derivatives by the shared terms to the cross information of one unknown.
  void add_cross(const Row& j, double weight, Eigen::Index first, Eigen::Index unknown,
                 AnchorSums& sums) const noexcept {
    for (Eigen::Index k = kPair; k < size_; ++k) {
      sums.cross(unknown, k < kRest ? first + k - kPair : places_(k)) += weight * j(k);
    }
  }

 private:
  static void take(double& to, double& from) noexcept {
    to += from;
    from = 0.0;
  }
  void move_to(Eigen::Index begin, Eigen::Index end, AnchorSums& sums) noexcept {
    sum_up();
    for (Eigen::Index from = begin; from < end; ++from) {
      const Eigen::Index to = places_(from);
      for (Eigen::Index row = 0; row < kPair; ++row) take(sums.cross(places_(row), to), square_(from, row));
      for (Eigen::Index row = from; row < size_; ++row) take(sums.own(places_(row), to), square_(row, from));
      take(sums.descent(to), descent_(from - kPair));
    }
  }
  void sum_up() noexcept {
    if (waiting_ == 0) return;
    // Lanes left over from earlier observations get no weight.
    weight_.tail(kLanes - waiting_).setZero();
    slope_.tail(kLanes - waiting_).setZero();
    waiting_ = 0;
    for (Eigen::Index column = 0; column < size_; ++column) {
      const Lanes weighted = weight_ * rows_.col(column);
      for (Eigen::Index row = std::max(column, kPair); row < size_; ++row) {
        square_(row, column) += (weighted * rows_.col(row)).sum();
      }
    }
    for (Eigen::Index k = 0; k < size_ - kPair; ++k) descent_(k) += (slope_ * rows_.col(kPair + k)).sum();
  }

  Eigen::Index size_;
  // Index of each term: those by the pair among the anchor's unknowns, the others among the shared ones.
  Eigen::Array<Eigen::Index, kSize, 1> places_;
  Eigen::Matrix<double, kSize, kSize> square_ =
      Eigen::Matrix<double, kSize, kSize>::Zero();  // lower triangle
  SharedRow descent_ = SharedRow::Zero();
  Eigen::Array<double, kLanes, kSize> rows_ = Eigen::Array<double, kLanes, kSize>::Zero();
  Lanes weight_;
  Lanes slope_;
  Eigen::Index waiting_ = 0;
};

void add_rows(const AnchorFit& fit, const SharedUnknowns& unknowns, AnchorSums& sums) {
  const std::size_t tags = fit.problem.tag_count;
  std::vector<Moments> moments;
  for (std::size_t tag = 0; tag < tags; ++tag) moments.emplace_back(unknowns, tag, tags);
  Eigen::Index first = 0;
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    const RowValue& value = at.value;
    const KnotShare share = knot_share(unknowns.knots, row.t_s);
    if (share.first != first) {
      for (Moments& of_tag : moments) of_tag.move_knots_to(first, sums);
      first = share.first;
    }
    Moments::Row j;
    j << at.j.array().transpose(), shared_jacobian(row, at.predicted, share.fraction).array().transpose();
    // Long NLOS ranges count too: they tie the anchor to the poses, so that a common shift of both changes no
    // residual.
    Moments& of_tag = moments[row.tag];
    of_tag.add(j, value.seen.slope + value.nlos_slope, value.seen.weight + value.nlos_weight);
    if (value.nlos_weight == 0.0) continue;
    const std::int32_t episode = fit.problem.los_states->rows[row.index].episode;
    of_tag.add_cross(j, value.nlos_weight, first, excess_index(tags), sums);
    if (episode != kNoEpisode) {
      of_tag.add_cross(j, value.nlos_weight, first, episode_index(episode, tags), sums);
    }
  }
  for (Moments& of_tag : moments) of_tag.move_knots_to(first, sums);
  for (Moments& of_tag : moments) of_tag.move_rest_to(sums);
}

std::vector<double> inflations(std::span<const AnchorFit> fits, double Evidence::*kind) {
  std::vector<double> out;
  for (const AnchorFit& fit : fits) out.push_back(fit.evidence.*kind);
  return out;
}

bool nothing_to_correct(const JointEquations& equations, const SharedUnknowns& unknowns,
                        const SharedPrior& prior) {
  if (prior.drift.sigma_m > 0.0 || prior.body) return false;
  const Eigen::Index delay = unknowns.delay();
  const double information =
      equations.information(delay, delay) + 1.0 / (prior.delay_sigma_s * prior.delay_sigma_s);
  return std::abs(equations.descent(delay)) < kMinDelaySigmas * std::sqrt(information);
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
    inflation = inflations(fits, &Evidence::lasting_inflation);
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

void begin_correction(std::vector<AnchorFit>& fits, DriveError& out) {
  out.added_covariance.clear();
  for (const AnchorFit& fit : fits) {
    out.added_covariance.push_back(Eigen::MatrixXd::Zero(fit.anchor.size(), fit.anchor.size()));
  }
  gather_evidence(fits);
}

}  // namespace

KnotShare knot_share(const Knots& knots, double t_s) noexcept {
  const double position =
      std::clamp((t_s - knots.begin_s) / knots.spacing_s, 0.0, static_cast<double>(knots.count - 1));
  const auto k = std::min(static_cast<Eigen::Index>(position), knots.count - 2);
  return {.first = 3 * k, .fraction = position - static_cast<double>(k)};
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
    add_rows(fit, unknowns, sums);
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

DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits) {
  DriveError out;
  begin_correction(fits, out);
  const auto arrange = [&](const KnotGrid& grid, std::size_t body_tags) {
    return lay_out(fits, association.pose_spreads, grid, body_tags);
  };
  const std::optional<SharedUnknowns> coarse = arrange(kCoarseKnots, association.tags.size());
  if (!coarse) return out;
  const std::vector<double> inflation = inflations(fits, &Evidence::brief_inflation);
  const JointEquations equations = eliminate_anchors(fits, inflation, *coarse);
  SharedPrior prior = likeliest_prior(equations, *coarse, [&] {
    return eliminate_anchors(fits, inflations(fits, &Evidence::lasting_inflation), *coarse);
  });
  if (nothing_to_correct(equations, *coarse, prior)) {
    // With the lasting inflation the ranges carry this much less information about what is constant over
    // the drive.
    const std::vector<double> lasting = inflations(fits, &Evidence::lasting_inflation);
    const double share = std::accumulate(inflation.begin(), inflation.end(), 0.0) /
                         std::accumulate(lasting.begin(), lasting.end(), 0.0);
    const Eigen::Index delay = coarse->delay();
    const double information =
        share * equations.information(delay, delay) + 1.0 / (prior.delay_sigma_s * prior.delay_sigma_s);
    out.range_delay_s = share * equations.descent(delay) / information;
    out.range_delay_sigma_s = 1.0 / std::sqrt(information);
    report_frame(coarse->knots, Eigen::MatrixXd::Zero(coarse->size(), coarse->size()), fits, out);
    return out;
  }
  const bool has_drift = prior.drift.sigma_m > 0.0;
  out.unknowns = *arrange(has_drift ? kFineKnots : kNoKnots, prior.body ? coarse->body_tags : 0);
  if (has_drift) {
    const JointEquations fine = eliminate_anchors(fits, inflation, out.unknowns);
    prior = likeliest_drift(fine, out.unknowns, prior);
    if (out.unknowns.typical) {
      const double share = white_share(prior.drift, *out.unknowns.typical, out.unknowns.knots.spacing_s);
      for (AnchorObservations& anchor : association.anchors) {
        for (Observation& row : anchor.rows) row.pose_spread_m2 *= static_cast<float>(share);
      }
    }
  }
  out.prior = prior;
  out.shared_mean = Eigen::VectorXd::Zero(out.unknowns.size());
  settle(association, fits, /*is_delay_open=*/true, inflation, out);
  return out;
}

void correct_further(Association& association, std::vector<AnchorFit>& fits, DriveError& drive_error) {
  begin_correction(fits, drive_error);
  if (drive_error.shared_gain.empty()) return;
  settle(association, fits, /*is_delay_open=*/false, inflations(fits, &Evidence::lasting_inflation),
         drive_error);
}

}  // namespace groma::calibration
