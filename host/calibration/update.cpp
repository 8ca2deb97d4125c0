#include "host/calibration/update.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iterator>
#include <limits>
#include <map>
#include <set>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/QR>

#include "host/calibration/verdict.hpp"

namespace groma::calibration {
namespace {

using model::AnchorCalibration;
using model::AnchorVerdict;
using model::has_position;

constexpr double kLeastVariance = 1e-12;

// How far a verdict can be trusted: less is better.
int rank(AnchorVerdict verdict) {
  switch (verdict) {
    case AnchorVerdict::kOk:
      return 0;
    case AnchorVerdict::kWeakZ:
      return 1;
    case AnchorVerdict::kWeak:
      return 2;
    case AnchorVerdict::kNeverInSight:
      return 3;
    case AnchorVerdict::kMoved:
      return 4;
    case AnchorVerdict::kNoData:
      return 5;
  }
  return 5;
}

// An anchor's whole block of parameters as a vector: position, then beta of each pair, then gamma.
Eigen::VectorXd values_of(const AnchorCalibration& anchor) {
  const auto pairs = static_cast<Eigen::Index>(anchor.pairs.size());
  return Eigen::VectorXd::NullaryExpr(3 + 2 * pairs, [&](Eigen::Index i) {
    if (i < 3) return anchor.position_m(i);
    const model::PairBias& pair = anchor.pairs[static_cast<std::size_t>((i - 3) % pairs)];
    return i < 3 + pairs ? pair.beta_m : pair.gamma;
  });
}

void set_values(AnchorCalibration& anchor, const Eigen::VectorXd& values, const Eigen::MatrixXd& covariance) {
  const auto pairs = static_cast<Eigen::Index>(anchor.pairs.size());
  anchor.position_m = values.head<3>();
  anchor.covariance = 0.5 * (covariance + covariance.transpose());
  for (Eigen::Index i = 0; i < pairs; ++i) {
    model::PairBias& pair = anchor.pairs[static_cast<std::size_t>(i)];
    pair.beta_m = values(3 + i);
    pair.beta_sigma_m = std::sqrt(anchor.covariance(3 + i, 3 + i));
    pair.gamma = values(3 + pairs + i);
    pair.gamma_sigma = std::sqrt(anchor.covariance(3 + pairs + i, 3 + pairs + i));
  }
}

// Shifts and turns the anchor by a small offset of the frame, and adds that offset's uncertainty.
void shift(AnchorCalibration& anchor, const Eigen::Vector4d& offset, const Eigen::Matrix4d& covariance) {
  const Eigen::Matrix<double, 3, 4> frame = model::place_by_frame(anchor.position_m);
  anchor.position_m += frame * offset;
  anchor.covariance.topLeftCorner<3, 3>() += frame * covariance * frame.transpose();
}

// Takes the frame that all anchors share from the anchor's covariance, but for kKeptShare of the whole: else
// an anchor that owes all to the frame along some axis is known exactly there, and outweighs every other
// drive.
void keep_own(AnchorCalibration& anchor, const model::Calibration& of) {
  constexpr double kKeptShare = 0.01;
  if (!has_position(anchor)) return;
  anchor.covariance = (1.0 - kKeptShare) * model::own_covariance(anchor, of.common_frame_covariance) +
                      kKeptShare * anchor.covariance;
}

// The parameters of several calibrations' blocks, each tag once.
class Parameters {
 public:
  Parameters(const AnchorCalibration& a, const AnchorCalibration& b) {
    std::set<model::NodeId> tags;
    for (const AnchorCalibration* anchor : {&a, &b}) {
      for (const model::PairBias& pair : anchor->pairs) tags.insert(pair.tag_id);
    }
    tags_.assign(tags.begin(), tags.end());
  }
  [[nodiscard]] const std::vector<model::NodeId>& tags() const noexcept { return tags_; }
  [[nodiscard]] Eigen::Index size() const noexcept { return 3 + 2 * static_cast<Eigen::Index>(tags_.size()); }
  // Where each of the anchor's own parameters stands.
  [[nodiscard]] std::vector<Eigen::Index> places(const AnchorCalibration& anchor) const {
    std::vector<Eigen::Index> out{0, 1, 2};
    for (const Eigen::Index begin : {Eigen::Index{3}, 3 + static_cast<Eigen::Index>(tags_.size())}) {
      for (const model::PairBias& pair : anchor.pairs) {
        out.push_back(begin + (std::lower_bound(tags_.begin(), tags_.end(), pair.tag_id) - tags_.begin()));
      }
    }
    return out;
  }

 private:
  std::vector<model::NodeId> tags_;
};

Eigen::MatrixXd inverse(Eigen::MatrixXd matrix) {
  matrix.diagonal().array() += kLeastVariance;
  return matrix.ldlt().solve(Eigen::MatrixXd::Identity(matrix.rows(), matrix.cols()));
}

// What the later drive's ranges tell, without the priors of the biases that both calibrations have: unless
// the anchor's covariance was widened so far that nothing would be left.
Eigen::MatrixXd without_priors(const Eigen::MatrixXd& information, std::size_t pairs,
                               const model::RangePriors& priors) {
  const auto n = static_cast<Eigen::Index>(pairs);
  Eigen::MatrixXd out = information;
  out.diagonal().segment(3, n).array() -= 1.0 / (priors.beta_m.sigma * priors.beta_m.sigma);
  out.diagonal().tail(n).array() -= 1.0 / (priors.gamma.sigma * priors.gamma.sigma);
  return Eigen::LLT<Eigen::MatrixXd>(out).info() == Eigen::Success ? out : information;
}

// 99 % of the chi-square distribution with one degree of freedom.
constexpr double kHeightsDisagree = 6.63;

// A height that is not trusted gives way to one that is, and to any that it disagrees with.
void settle_heights(AnchorCalibration& earlier, AnchorCalibration& later) {
  const double difference_m = later.position_m.z() - earlier.position_m.z();
  const double variance_m2 = earlier.covariance(2, 2) + later.covariance(2, 2);
  const bool disagree = difference_m * difference_m > kHeightsDisagree * variance_m2;
  if (!disagree && earlier.verdict != AnchorVerdict::kOk && later.verdict != AnchorVerdict::kOk) return;
  for (AnchorCalibration* anchor : {&earlier, &later}) {
    if (anchor->verdict == AnchorVerdict::kWeakZ || anchor->verdict == AnchorVerdict::kWeak) {
      anchor->covariance(2, 2) += kWeakHeight_m * kWeakHeight_m;
    }
  }
}

// By how much the spheres of ranges leave their tangent over such a way: where one solution is so far from
// another, what its covariance says of the directions that ranges leave open is no better.
double bend_over(double way_m) noexcept {
  constexpr double kRange_m = 2.5;
  return way_m * way_m / (2.0 * kRange_m);
}

// Both are in one frame, and independent but for the priors of the biases.
AnchorCalibration fuse(AnchorCalibration earlier, AnchorCalibration later, const model::RangePriors& priors) {
  settle_heights(earlier, later);
  const double bend_m = bend_over((later.position_m - earlier.position_m).norm());
  AnchorCalibration& weaker =
      earlier.covariance.topLeftCorner<3, 3>().trace() > later.covariance.topLeftCorner<3, 3>().trace()
          ? earlier
          : later;
  weaker.covariance.diagonal().head<3>().array() += bend_m * bend_m;
  const Parameters parameters(earlier, later);
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(parameters.size(), parameters.size());
  Eigen::VectorXd right_side = Eigen::VectorXd::Zero(parameters.size());
  for (const AnchorCalibration* anchor : {&earlier, &later}) {
    Eigen::MatrixXd own = inverse(anchor->covariance);
    Eigen::VectorXd own_side = own * values_of(*anchor);
    if (anchor == &later) {
      const Eigen::MatrixXd reduced = without_priors(own, anchor->pairs.size(), priors);
      const Eigen::MatrixXd taken = own - reduced;
      Eigen::VectorXd means = values_of(*anchor);
      const auto n = static_cast<Eigen::Index>(anchor->pairs.size());
      means.segment(3, n).setConstant(priors.beta_m.mean);
      means.tail(n).setConstant(priors.gamma.mean);
      own_side -= taken * means;
      own = reduced;
    }
    const std::vector<Eigen::Index> places = parameters.places(*anchor);
    for (std::size_t i = 0; i < places.size(); ++i) {
      right_side(places[i]) += own_side(static_cast<Eigen::Index>(i));
      for (std::size_t j = 0; j < places.size(); ++j) {
        information(places[i], places[j]) += own(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
      }
    }
  }
  AnchorCalibration out = later;
  out.pairs.clear();
  for (const model::NodeId tag : parameters.tags()) out.pairs.push_back({.tag_id = tag});
  const Eigen::LDLT<Eigen::MatrixXd> factors(information);
  set_values(out, factors.solve(right_side),
             factors.solve(Eigen::MatrixXd::Identity(information.rows(), information.cols())));
  if (rank(earlier.verdict) < rank(later.verdict)) {
    out.verdict = earlier.verdict;
    out.advice = earlier.advice;
  }
  return out;
}

std::string moved_advice(const AnchorChange& change, bool solved) {
  char text[160];
  std::snprintf(text, sizeof text, "moved by %.2f m since it was calibrated; %s",
                change.displacement_m.norm(),
                solved ? "its new place is learnt" : "drive past it to learn its new place");
  return text;
}

AnchorCalibration moved_anchor(const AnchorCalibration& later, const AnchorChange& change) {
  AnchorCalibration out = later;
  const bool solved = has_position(later) && model::is_usable(later.verdict);
  out.verdict = AnchorVerdict::kMoved;
  out.advice = moved_advice(change, solved);
  if (!solved) {
    out.position_m.setConstant(std::numeric_limits<double>::quiet_NaN());
    out.covariance.resize(0, 0);
    out.pairs.clear();
  }
  return out;
}

}  // namespace

Update update(const model::Calibration& earlier, const model::Calibration& later,
              const model::RangePriors& priors) {
  Update out;
  // An anchor with too few ranges on the later drive says nothing of where it is.
  model::Calibration heard = later;
  std::erase_if(heard.anchors,
                [](const AnchorCalibration& anchor) { return anchor.verdict == AnchorVerdict::kNoData; });
  out.comparison = compare(earlier, heard);

  // Of the offset between the drives' frames each has its share; what remains of the earlier one's is common
  // to all, and what remains of the offset is the later one's own.
  const Eigen::Matrix4d both = earlier.common_frame_covariance + later.common_frame_covariance;
  const Eigen::Matrix4d share = earlier.common_frame_covariance *
                                Eigen::CompleteOrthogonalDecomposition<Eigen::Matrix4d>(both).pseudoInverse();
  const FrameOffset& offset = out.comparison.frame;
  const Eigen::Vector4d earlier_shift = share * offset.mean;
  const Eigen::Vector4d later_shift = earlier_shift - offset.mean;
  const Eigen::Matrix4d common = earlier.common_frame_covariance - share * earlier.common_frame_covariance +
                                 share * offset.covariance * share.transpose();

  std::map<model::NodeId, AnchorCalibration> anchors;
  for (AnchorCalibration anchor : earlier.anchors) {
    keep_own(anchor, earlier);
    if (has_position(anchor)) shift(anchor, earlier_shift, Eigen::Matrix4d::Zero());
    anchors.emplace(anchor.id, std::move(anchor));
  }
  for (AnchorCalibration anchor : later.anchors) {
    keep_own(anchor, later);
    const auto known = anchors.find(anchor.id);
    const bool was_known = known != anchors.end() && has_position(known->second);
    const bool is_heard = has_position(anchor) && anchor.verdict != AnchorVerdict::kNoData;
    if (is_heard) shift(anchor, later_shift, offset.covariance);
    if (!was_known) {
      if (is_heard) out.added.push_back(anchor.id);
      anchors.insert_or_assign(anchor.id, std::move(anchor));
      continue;
    }
    if (!is_heard) continue;
    const auto change = std::find_if(out.comparison.anchors.begin(), out.comparison.anchors.end(),
                                     [&](const AnchorChange& c) { return c.id == anchor.id; });
    if (anchor.verdict == AnchorVerdict::kMoved) {
      // During the drive: where it was left.
      out.moved.push_back(anchor.id);
      known->second = std::move(anchor);
    } else if (change != out.comparison.anchors.end() && change->moved) {
      out.moved.push_back(anchor.id);
      known->second = moved_anchor(anchor, *change);
    } else {
      known->second = fuse(known->second, anchor, priors);
    }
  }
  for (const AnchorCalibration& anchor : earlier.anchors) {
    if (model::find_anchor(heard, anchor.id) == nullptr) out.kept.push_back(anchor.id);
  }

  model::Calibration& calibration = out.calibration;
  calibration = later;
  calibration.frame = earlier.frame;
  calibration.anchors.clear();
  calibration.common_frame_covariance = 0.5 * (common + common.transpose());
  for (auto& [id, anchor] : anchors) {
    if (has_position(anchor)) model::add_common_frame(anchor, calibration.common_frame_covariance);
    calibration.anchors.push_back(std::move(anchor));
  }
  if (!later.range_noise) calibration.range_noise = earlier.range_noise;
  if (!(later.range_delay_sigma_s > 0.0)) {
    calibration.range_delay_s = earlier.range_delay_s;
    calibration.range_delay_sigma_s = earlier.range_delay_sigma_s;
  }
  // What the robot's body does is told by one drive as by another.
  if (later.tags.empty()) calibration.tags = earlier.tags;
  calibration.verdict = judge_site(calibration.anchors);
  return out;
}

}  // namespace groma::calibration
