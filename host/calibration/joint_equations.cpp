#include "host/calibration/joint_equations.hpp"

#include <algorithm>
#include <cstddef>
#include <span>
#include <utility>

namespace groma::calibration {
namespace {

// One anchor's own sums, before it is eliminated.
struct AnchorSums {
  Eigen::MatrixXd cross;  // with the shared unknowns
  Eigen::MatrixXd own;    // of the shared unknowns, the lower triangle
  Eigen::VectorXd descent;
};

// Of one tag's rows: sums of derivatives by the pair (position, beta, gamma) and by the shared unknowns, of
// which the first `Shared` terms are wanted. Rows are taken up side by side, and summed when there are enough
// of them.
template <Eigen::Index Shared>
class Moments {
 public:
  static constexpr Eigen::Index kPair = 5;
  static constexpr Eigen::Index kSize = kPair + Shared;
  // Of the shared terms, those by the two knots.
  static constexpr Eigen::Index kKnots = 6;
  static constexpr Eigen::Index kRest = kPair + kKnots;
  using Row = Eigen::Array<double, 1, kSize>;
  // Where each term stands: those by the pair among the anchor's unknowns, those after the knots among the
  // shared ones.
  using Places = Eigen::Array<Eigen::Index, kSize, 1>;

  void add(const Row& j, double slope, double weight) noexcept {
    rows_.row(waiting_) = j;
    weight_(waiting_) = weight;
    slope_(waiting_) = slope;
    if (++waiting_ == kLanes) sum_up();
  }
  // Gives away what rows between the knots from index `first` on say of these: the next are between others.
  void leave_knots(Eigen::Index first, const Places& places, AnchorSums& sums) noexcept {
    sum_up();
    for (Eigen::Index column = 0; column < kKnots; ++column) {
      const Eigen::Index from = kPair + column;
      const Eigen::Index to = first + column;
      for (Eigen::Index row = 0; row < kPair; ++row) take(sums.cross(places(row), to), square_(from, row));
      for (Eigen::Index row = column; row < kKnots; ++row) {
        take(sums.own(first + row, to), square_(kPair + row, from));
      }
      for (Eigen::Index row = kRest; row < kSize; ++row) {
        take(sums.own(places(row), to), square_(row, from));
      }
      take(sums.descent(to), descent_(column));
    }
  }
  // The same of all other terms, in the end.
  void leave(const Places& places, AnchorSums& sums) noexcept {
    for (Eigen::Index from = kRest; from < kSize; ++from) {
      const Eigen::Index to = places(from);
      for (Eigen::Index row = 0; row < kPair; ++row) take(sums.cross(places(row), to), square_(from, row));
      for (Eigen::Index row = from; row < kSize; ++row) {
        take(sums.own(places(row), to), square_(row, from));
      }
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
    // Rows that are left of earlier ones have no weight.
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
    places.setZero();
    places.template head<Sums::kPair>() << 0, 1, 2, beta_index(tag), gamma_index(tag, tags);
    places(Sums::kRest) = unknowns.delay();
    for (Eigen::Index k = 0; Sums::kRest + 1 + k < Sums::kSize; ++k) {
      places(Sums::kRest + 1 + k) = unknowns.body(tag) + k;
    }
  }
  Eigen::Index first = 0;
  const auto leave_knots = [&] {
    for (Tag& tag : of_tag) tag.moments.leave_knots(first, tag.places, sums);
  };
  for (const Observation& row : fit.problem.rows) {
    const model::AntennaPrediction predicted = predict(row, fit.anchor, tags);
    const RowValue value =
        value_of(fit.problem, fit.kernels, row, row.range_m - predicted.range_m, fit.anchor);
    const double gamma = fit.anchor(gamma_index(row.tag, tags));
    const KnotShare share = knot_share(unknowns.knots, row.t_s);
    if (share.first != first) leave_knots();
    first = share.first;
    typename Sums::Row j;
    j.template head<Sums::kPair>() = pair_jacobian(predicted, gamma).array().transpose();
    j.template tail<Shared>() =
        shared_jacobian(row, predicted, gamma, share.fraction).template head<Shared>().array().transpose();
    // Ranges through walls too: they hold the anchor to the poses, and a shift of all of them shows in none.
    of_tag[row.tag].moments.add(j, value.seen.slope + value.wall_slope,
                                value.seen.weight + value.wall_weight);
    if (value.wall_weight == 0.0) continue;
    const RowSight& sight = fit.problem.sight->rows[row.index];
    const Eigen::Matrix<double, 1, Shared> by_wall = value.wall_weight * j.template tail<Shared>().matrix();
    const auto add_wall = [&](Eigen::Index at) {
      sums.cross.template block<1, Sums::kKnots>(at, first) += by_wall.template head<Sums::kKnots>();
      for (Eigen::Index k = Sums::kKnots; k < Shared; ++k) {
        sums.cross(at, of_tag[row.tag].places(Sums::kPair + k)) += by_wall(k);
      }
    };
    add_wall(wall_index(tags));
    if (sight.episode != kNoEpisode) add_wall(episode_index(sight.episode, tags));
  }
  leave_knots();
  for (Tag& tag : of_tag) tag.moments.leave(tag.places, sums);
}

}  // namespace

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
    const NormalEquations alone = linearize(fit.problem, fit.kernels, fit.anchor);
    AnchorPart& part = out.anchors.emplace_back();
    part.information.compute(alone.information);
    part.descent = -alone.gradient;
    // With L L^T the anchor's information: what it takes from the shared is (L^-1 cross)^T (L^-1 cross).
    const Eigen::MatrixXd half = part.information.matrixL().solve(sums.cross);
    part.gain = part.information.matrixU().solve(half);
    sums.own.selfadjointView<Eigen::Lower>().rankUpdate(half.transpose(), -1.0);
    sums.descent.noalias() -= part.gain.transpose() * part.descent;
    // The anchor's own solution is the same at any inflation: its equations are scaled as one.
    const double share_of_one = 1.0 / inflation[i];
    out.information += share_of_one * sums.own;
    out.descent += share_of_one * sums.descent;
  }
  out.information.triangularView<Eigen::StrictlyUpper>() = out.information.transpose();
  return out;
}

}  // namespace groma::calibration
