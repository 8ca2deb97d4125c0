#include "host/calibration/joint_equations.hpp"

#include <array>
#include <cstddef>
#include <utility>

namespace groma::calibration {
namespace {

// Of one tag's rows between two knots: sums over all pairs of derivatives, by the pair (position, beta,
// gamma) and by the shared unknowns, of which the first `Shared` terms are wanted.
template <Eigen::Index Shared>
struct Moments {
  static constexpr Eigen::Index kSize = 5 + Shared;
  using Row = Eigen::Matrix<double, kSize, 1>;

  Eigen::Matrix<double, kSize, kSize> square = Eigen::Matrix<double, kSize, kSize>::Zero();
  Eigen::Matrix<double, Shared, 1> descent = Eigen::Matrix<double, Shared, 1>::Zero();
  bool empty = true;

  void add(const Row& j, const KernelValue& value) noexcept {
    for (Eigen::Index column = 0; column < kSize; ++column)
      square.col(column) += (value.weight * j(column)) * j;
    descent += value.slope * j.template tail<Shared>();
    empty = false;
  }
};

// One anchor's own sums, before it is eliminated.
struct AnchorSums {
  Eigen::MatrixXd cross;  // with the shared unknowns
  Eigen::MatrixXd own;    // of the shared unknowns
  Eigen::VectorXd descent;
};

template <Eigen::Index Shared>
class Accumulator {
 public:
  Accumulator(const AnchorFit& fit, const SharedUnknowns& unknowns, AnchorSums& sums)
      : fit_(fit), unknowns_(unknowns), sums_(sums), moments_(fit.problem.tag_count) {}

  void add_all() {
    const std::size_t tags = fit_.problem.tag_count;
    for (const Observation& row : fit_.problem.rows) {
      const model::AntennaPrediction predicted = predict(row, fit_.anchor, tags);
      // What walls add differs from place to place as poses do: ranges through them tell nothing of those.
      const KernelValue value =
          value_of(fit_.problem, fit_.kernels, row, row.range_m - predicted.range_m, fit_.anchor).seen;
      const double gamma = fit_.anchor(gamma_index(row.tag, tags));
      const KnotShare share = knot_share(unknowns_.knots, row.t_s);
      if (share.first != first_) flush();
      first_ = share.first;
      typename Moments<Shared>::Row j;
      j.template head<5>() = pair_jacobian(predicted, gamma);
      j.template tail<Shared>() =
          shared_jacobian(row, predicted, gamma, share.fraction).template head<Shared>();
      moments_[row.tag].add(j, value);
    }
    flush();
  }

 private:
  void flush() {
    for (std::size_t tag = 0; tag < moments_.size(); ++tag) {
      if (moments_[tag].empty) continue;
      scatter(moments_[tag], tag);
      moments_[tag] = {};
    }
  }

  // A piece of the shared terms, and where it stands among the unknowns.
  struct Piece {
    Eigen::Index from;
    Eigen::Index to;
    Eigen::Index size;
  };

  void scatter(const Moments<Shared>& moments, std::size_t tag) {
    const std::size_t tags = fit_.problem.tag_count;
    std::array<Piece, 3> pieces{Piece{.from = 0, .to = first_, .size = 6},
                                Piece{.from = 6, .to = unknowns_.delay(), .size = 1},
                                Piece{.from = 7, .to = 0, .size = Shared - kMotionTerms}};
    if (Shared > kMotionTerms) pieces[2].to = unknowns_.body(tag);
    const auto shared = moments.square.template bottomRightCorner<Shared, Shared>();
    const auto cross = moments.square.template topRightCorner<5, Shared>();
    for (const Piece& a : pieces) {
      if (a.size == 0) continue;
      sums_.descent.segment(a.to, a.size) += moments.descent.segment(a.from, a.size);
      sums_.cross.middleCols(a.to, a.size).template topRows<3>() +=
          cross.middleCols(a.from, a.size).template topRows<3>();
      sums_.cross.row(beta_index(tag)).segment(a.to, a.size) += cross.row(3).segment(a.from, a.size);
      sums_.cross.row(gamma_index(tag, tags)).segment(a.to, a.size) += cross.row(4).segment(a.from, a.size);
      for (const Piece& b : pieces) {
        if (b.size == 0) continue;
        sums_.own.block(a.to, b.to, a.size, b.size) += shared.block(a.from, b.from, a.size, b.size);
      }
    }
  }

  const AnchorFit& fit_;
  const SharedUnknowns& unknowns_;
  AnchorSums& sums_;
  std::vector<Moments<Shared>> moments_;
  Eigen::Index first_ = 0;
};

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
      Accumulator<kSharedTerms>(fit, unknowns, sums).add_all();
    } else {
      Accumulator<kMotionTerms>(fit, unknowns, sums).add_all();
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
