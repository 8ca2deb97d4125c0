#include "host/calibration/comparison.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <iterator>
#include <limits>
#include <map>
#include <numbers>
#include <optional>
#include <set>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <Eigen/QR>

#include "host/calibration/verdict.hpp"

namespace groma::calibration {
namespace {

using model::AnchorCalibration;
using model::AnchorVerdict;
using model::has_position;
using Frame = Eigen::Matrix<double, 3, 4>;

// 95 % of the chi-square distribution with three degrees of freedom.
constexpr double kClear = 7.815;
// Numerics: keeps covariances of exact values invertible (1 um; 1e-6 of a term).
constexpr double kLeastVariance_m2 = 1e-12;

// An anchor in both, linearized in the frames' offset.
struct Shared {
  const AnchorCalibration* a = nullptr;
  const AnchorCalibration* b = nullptr;
  Frame frame;
  Eigen::Vector3d difference_m;
  Eigen::Matrix3d covariance_m2;
  Eigen::Matrix4d information;  // of the offset
  Eigen::Vector4d right_side;
  bool outlier = false;
};

bool is_height_weak(const AnchorCalibration& anchor) {
  return anchor.verdict == AnchorVerdict::kWeakZ || anchor.verdict == AnchorVerdict::kWeak;
}

Shared make_shared(const model::Calibration& of_a, const AnchorCalibration& a, const model::Calibration& of_b,
                   const AnchorCalibration& b) {
  Shared out;
  out.a = &a;
  out.b = &b;
  out.frame = model::position_by_frame(a.position_m);
  out.difference_m = b.position_m - a.position_m;
  out.covariance_m2 = model::own_covariance(a, of_a.common_frame_covariance).topLeftCorner<3, 3>() +
                      model::own_covariance(b, of_b.common_frame_covariance).topLeftCorner<3, 3>();
  out.covariance_m2.diagonal().array() += kLeastVariance_m2;
  if (is_height_weak(a) || is_height_weak(b)) out.covariance_m2(2, 2) += kWeakHeight_m * kWeakHeight_m;
  const Eigen::LDLT<Eigen::Matrix3d> factors(out.covariance_m2);
  out.information = out.frame.transpose() * factors.solve(out.frame);
  out.right_side = out.frame.transpose() * factors.solve(out.difference_m);
  return out;
}

// Estimated from all anchors except outliers and `left_out`. The prior may be singular: a frame that is known
// exactly.
FrameOffset frame_offset(const std::vector<Shared>& anchors, const Eigen::Matrix4d& prior,
                         const Shared* left_out) {
  Eigen::Matrix4d information = Eigen::Matrix4d::Zero();
  Eigen::Vector4d right_side = Eigen::Vector4d::Zero();
  for (const Shared& anchor : anchors) {
    if (anchor.outlier || &anchor == left_out) continue;
    information += anchor.information;
    right_side += anchor.right_side;
  }
  FrameOffset out;
  out.covariance = (Eigen::Matrix4d::Identity() + prior * information).partialPivLu().solve(prior);
  out.covariance = 0.5 * (out.covariance + out.covariance.transpose()).eval();
  out.mean = out.covariance * right_side;
  return out;
}

AnchorChange change_of(const Shared& anchor, const FrameOffset& others) {
  AnchorChange out;
  out.id = anchor.a->id;
  out.displacement_m = anchor.difference_m - anchor.frame * others.mean;
  out.covariance_m2 = anchor.covariance_m2 + anchor.frame * others.covariance * anchor.frame.transpose();
  out.chi2 = out.displacement_m.dot(out.covariance_m2.ldlt().solve(out.displacement_m));
  out.chance = chi2_tail_3(out.chi2);
  return out;
}

// Repeatedly marks the anchor with the largest significant change as an outlier, until there is none.
std::vector<AnchorChange> find_changes(std::vector<Shared>& anchors, const Eigen::Matrix4d& prior) {
  const double limit = Comparison::kChance / static_cast<double>(std::max<std::size_t>(1, anchors.size()));
  std::vector<AnchorChange> changes;
  for (bool found = true; found;) {
    found = false;
    changes.clear();
    for (const Shared& anchor : anchors) {
      changes.push_back(change_of(anchor, frame_offset(anchors, prior, &anchor)));
    }
    std::optional<std::size_t> worst;
    for (std::size_t i = 0; i < anchors.size(); ++i) {
      if (anchors[i].outlier || !(changes[i].chance < limit)) continue;
      if (!worst || changes[i].chi2 > changes[*worst].chi2) worst = i;
    }
    if (worst) {
      anchors[*worst].outlier = true;
      found = true;
    }
  }
  for (std::size_t i = 0; i < anchors.size(); ++i) {
    AnchorChange& change = changes[i];
    change.differs = change.chance < limit;
    change.moved = change.differs &&
                   chi2_beyond(change.displacement_m, change.covariance_m2, Comparison::kMoved_m) > kClear;
  }
  return changes;
}

std::vector<PairChange> compare_pairs(const std::vector<Shared>& anchors) {
  std::vector<PairChange> pairs;
  for (const Shared& anchor : anchors) {
    for (const model::PairBias& a : anchor.a->pairs) {
      const auto b = std::find_if(anchor.b->pairs.begin(), anchor.b->pairs.end(),
                                  [&](const model::PairBias& pair) { return pair.tag_id == a.tag_id; });
      if (b == anchor.b->pairs.end()) continue;
      PairChange& change = pairs.emplace_back();
      change.tag_id = a.tag_id;
      change.anchor_id = anchor.a->id;
      for (const model::PairTerm& term : model::kPairTerms) {
        change.*term.value = *b.*term.value - a.*term.value;
        change.*term.sigma = std::hypot(a.*term.sigma, *b.*term.sigma);
      }
    }
  }
  const double limit = Comparison::kChance /
                       static_cast<double>(model::kPairTerms.size() * std::max<std::size_t>(1, pairs.size()));
  for (PairChange& pair : pairs) {
    pair.differs = std::any_of(model::kPairTerms.begin(), model::kPairTerms.end(), [&](const auto& term) {
      const double sigma = pair.*term.sigma;
      return sigma > 0.0 && chi2_tail_1(model::square(pair.*term.value) / model::square(sigma)) < limit;
    });
  }
  return pairs;
}

// Rank of a verdict: less is more trusted.
std::ptrdiff_t rank(AnchorVerdict verdict) {
  constexpr std::array kOrder{AnchorVerdict::kOk,       AnchorVerdict::kWeakZ, AnchorVerdict::kWeak,
                              AnchorVerdict::kNeverLos, AnchorVerdict::kMoved, AnchorVerdict::kNoData};
  return std::find(kOrder.begin(), kOrder.end(), verdict) - kOrder.begin();
}

// Shifts and turns the anchor by a small offset of the frame, and adds the offset's uncertainty.
void shift(AnchorCalibration& anchor, const Eigen::Vector4d& offset, const Eigen::Matrix4d& covariance) {
  const Frame frame = model::position_by_frame(anchor.position_m);
  anchor.position_m += frame * offset;
  anchor.covariance.topLeftCorner<3, 3>() += frame * covariance * frame.transpose();
}

// Removes the common frame's part from the anchor's covariance but keeps kKeptShare of the whole. Otherwise
// an anchor whose uncertainty along some axis is all the frame's counts as exact there and outweighs every
// other drive: two simulated drives that owed an axis to the frame were fused 0.4 m away. By hand, small.
void remove_common_frame(AnchorCalibration& anchor, const model::Calibration& of) {
  constexpr double kKeptShare = 0.01;
  if (!has_position(anchor)) return;
  anchor.covariance = (1.0 - kKeptShare) * model::own_covariance(anchor, of.common_frame_covariance) +
                      kKeptShare * anchor.covariance;
}

// The tags that either anchor has a pair with, ascending.
std::vector<model::NodeId> tags_of(const AnchorCalibration& a, const AnchorCalibration& b) {
  std::set<model::NodeId> tags;
  for (const AnchorCalibration* anchor : {&a, &b}) {
    for (const model::PairBias& pair : anchor->pairs) tags.insert(pair.tag_id);
  }
  return {tags.begin(), tags.end()};
}

// Information of the later drive's ranges, without the priors of the biases, which both calibrations contain.
// If the anchor's covariance was widened so far that nothing would be left, the information stays as it is.
Eigen::MatrixXd without_priors(const Eigen::MatrixXd& information, std::size_t pairs,
                               const model::RangePriors& priors) {
  Eigen::MatrixXd out = information;
  out.diagonal().tail(information.rows() - 3) -=
      model::per_tag(model::sigmas_of(priors).cwiseAbs2().cwiseInverse(), static_cast<Eigen::Index>(pairs));
  return Eigen::LLT<Eigen::MatrixXd>(out).info() == Eigen::Success ? out : information;
}

// 99 % of the chi-square distribution with one degree of freedom.
constexpr double kHeightsDisagree = 6.63;

// A height that is not trusted yields to one that is, and to any that it disagrees with.
void settle_heights(AnchorCalibration& earlier, AnchorCalibration& later) {
  const double difference_m = later.position_m.z() - earlier.position_m.z();
  const double variance_m2 = earlier.covariance(2, 2) + later.covariance(2, 2);
  const bool disagree = difference_m * difference_m > kHeightsDisagree * variance_m2;
  if (!disagree && earlier.verdict != AnchorVerdict::kOk && later.verdict != AnchorVerdict::kOk) return;
  for (AnchorCalibration* anchor : {&earlier, &later}) {
    if (is_height_weak(*anchor)) anchor->covariance(2, 2) += kWeakHeight_m * kWeakHeight_m;
  }
}

// Deviation of the ranges' spheres from their tangent planes over `way_m`, m: a solution's covariance is no
// better than this for another solution so far away. The range is by hand: a short one, for which the
// deviation is large. See kWeakHeight_m for its effect.
double bend_over(double way_m) noexcept {
  constexpr double kRange_m = 2.5;
  return way_m * way_m / (2.0 * kRange_m);
}

// Both are in one frame, and independent except for the priors of the biases.
AnchorCalibration fuse(AnchorCalibration earlier, AnchorCalibration later, const model::RangePriors& priors) {
  settle_heights(earlier, later);
  const double bend_m = bend_over((later.position_m - earlier.position_m).norm());
  AnchorCalibration& weaker =
      earlier.covariance.topLeftCorner<3, 3>().trace() > later.covariance.topLeftCorner<3, 3>().trace()
          ? earlier
          : later;
  weaker.covariance.diagonal().head<3>().array() += bend_m * bend_m;
  const std::vector<model::NodeId> tags = tags_of(earlier, later);
  const Eigen::Index size = model::anchor_size(std::ssize(tags));
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(size, size);
  Eigen::VectorXd right_side = Eigen::VectorXd::Zero(size);
  for (AnchorCalibration* anchor : {&earlier, &later}) {
    anchor->covariance.diagonal().array() += kLeastVariance_m2;
    const Eigen::Index unknowns = anchor->covariance.rows();
    Eigen::MatrixXd own = anchor->covariance.ldlt().solve(Eigen::MatrixXd::Identity(unknowns, unknowns));
    Eigen::VectorXd own_side = own * values_of(*anchor);
    if (anchor == &later) {
      const Eigen::MatrixXd reduced = without_priors(own, anchor->pairs.size(), priors);
      const Eigen::MatrixXd taken = own - reduced;
      own_side -= taken * model::anchor_at(anchor->position_m, anchor->pairs.size(), priors);
      own = reduced;
    }
    const Eigen::MatrixXd to = model::selection(tags, *anchor);
    right_side += to * own_side;
    information += to * own * to.transpose();
  }
  AnchorCalibration out = later;
  out.pairs.clear();
  for (const model::NodeId tag : tags) out.pairs.push_back({.tag_id = tag});
  const Eigen::LDLT<Eigen::MatrixXd> factors(information);
  const Eigen::MatrixXd covariance = factors.solve(Eigen::MatrixXd::Identity(size, size));
  set_values(out, factors.solve(right_side), 0.5 * (covariance + covariance.transpose()));
  if (rank(earlier.verdict) < rank(later.verdict)) {
    out.verdict = earlier.verdict;
    out.advice = earlier.advice;
  }
  return out;
}

AnchorCalibration moved_anchor(const AnchorCalibration& later, const AnchorChange& change) {
  AnchorCalibration out = later;
  const bool solved = has_position(later) && model::is_usable(later.verdict);
  out.verdict = AnchorVerdict::kMoved;
  char text[160];
  std::snprintf(text, sizeof text, "moved by %.2f m since it was calibrated; %s",
                change.displacement_m.norm(),
                solved ? "its new position is known" : "drive past it to calibrate its new position");
  out.advice = text;
  if (!solved) {
    out.position_m.setConstant(std::numeric_limits<double>::quiet_NaN());
    out.covariance.resize(0, 0);
    out.pairs.clear();
  }
  return out;
}

}  // namespace

Comparison compare(const model::Calibration& a, const model::Calibration& b) {
  Comparison out;
  std::vector<Shared> shared;
  const auto find_placed = [](const model::Calibration& calibration, model::NodeId id) {
    const AnchorCalibration* found = model::find_anchor(calibration, id);
    return found != nullptr && has_position(*found) ? found : nullptr;
  };
  for (const AnchorCalibration& anchor : a.anchors) {
    if (!has_position(anchor)) continue;
    if (const auto* other = find_placed(b, anchor.id)) {
      shared.push_back(make_shared(a, anchor, b, *other));
    } else {
      out.only_a.push_back(anchor.id);
    }
  }
  for (const AnchorCalibration& anchor : b.anchors) {
    if (has_position(anchor) && find_placed(a, anchor.id) == nullptr) out.only_b.push_back(anchor.id);
  }
  const Eigen::Matrix4d prior = a.common_frame_covariance + b.common_frame_covariance;
  out.anchors = find_changes(shared, prior);
  out.frame = frame_offset(shared, prior, nullptr);
  out.pairs = compare_pairs(shared);
  return out;
}

double chi2_tail_1(double chi2) noexcept {
  return std::erfc(std::sqrt(0.5 * std::max(0.0, chi2)));
}

double chi2_tail_3(double chi2) noexcept {
  const double x = std::max(0.0, chi2);
  return std::erfc(std::sqrt(0.5 * x)) + std::sqrt(2.0 * x / std::numbers::pi) * std::exp(-0.5 * x);
}

double chi2_beyond(const Eigen::Vector3d& displacement_m, const Eigen::Matrix3d& covariance_m2,
                   double radius_m) {
  if (displacement_m.norm() <= radius_m) return 0.0;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(covariance_m2);
  const Eigen::Vector3d variance = axes.eigenvalues().cwiseMax(kLeastVariance_m2);
  const Eigen::Vector3d along = axes.eigenvectors().transpose() * displacement_m;
  // The nearest point v satisfies (1/variance + k) v = along/variance, with k such that its length is the
  // radius.
  const auto nearest = [&](double k) -> Eigen::Vector3d {
    return along.cwiseQuotient((k * variance).array().matrix() + Eigen::Vector3d::Ones());
  };
  double low = 0.0;
  double high = 1.0 / variance.minCoeff();
  while (nearest(high).norm() > radius_m) high *= 2.0;
  for (int i = 0; i < 200 && high - low > 1e-12 * high; ++i) {
    const double middle = 0.5 * (low + high);
    (nearest(middle).norm() > radius_m ? low : high) = middle;
  }
  return (along - nearest(high)).cwiseAbs2().cwiseQuotient(variance).sum();
}

Update update(const model::Calibration& earlier, const model::Calibration& later,
              const model::RangePriors& priors) {
  Update out;
  // An anchor with too few ranges on the later drive gives no information on its position.
  model::Calibration heard = later;
  std::erase_if(heard.anchors,
                [](const AnchorCalibration& anchor) { return anchor.verdict == AnchorVerdict::kNoData; });
  out.comparison = compare(earlier, heard);

  // The offset between the drives' frames is divided between both by their covariances; what remains of the
  // earlier frame's uncertainty is common to all anchors, what remains of the offset is the later drive's
  // own.
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
    remove_common_frame(anchor, earlier);
    if (has_position(anchor)) shift(anchor, earlier_shift, Eigen::Matrix4d::Zero());
    anchors.emplace(anchor.id, std::move(anchor));
  }
  for (AnchorCalibration anchor : later.anchors) {
    remove_common_frame(anchor, later);
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
      // Moved during the later drive: take its last position.
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
  // Lever arms and antenna patterns of either drive are valid for the robot.
  if (later.tags.empty()) calibration.tags = earlier.tags;
  calibration.verdict = judge_site(calibration.anchors);
  return out;
}

}  // namespace groma::calibration
