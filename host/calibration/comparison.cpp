#include "host/calibration/comparison.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <optional>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/LU>

namespace groma::calibration {
namespace {

using Frame = Eigen::Matrix<double, 3, 4>;

// 95 % of the chi-square distribution with three degrees of freedom.
constexpr double kClear = 7.815;
// Keeps what is told as exact invertible.
constexpr double kLeastVariance_m2 = 1e-12;

// An anchor of both, linear in the frames' offset.
struct Shared {
  const model::AnchorCalibration* a = nullptr;
  const model::AnchorCalibration* b = nullptr;
  Frame frame;
  Eigen::Vector3d difference_m;
  Eigen::Matrix3d covariance_m2;
  Eigen::Matrix4d information;  // of the offset
  Eigen::Vector4d right_side;
  bool outlier = false;
};

// What an anchor's position has for itself, beside the frame.
Eigen::Matrix3d own_position_covariance(const model::AnchorCalibration& anchor,
                                        const model::Calibration& calibration) {
  return model::own_covariance(anchor, calibration.common_frame_covariance).topLeftCorner<3, 3>();
}

Shared make_shared(const model::Calibration& of_a, const model::AnchorCalibration& a,
                   const model::Calibration& of_b, const model::AnchorCalibration& b) {
  Shared out;
  out.a = &a;
  out.b = &b;
  out.frame = model::place_by_frame(a.position_m);
  out.difference_m = b.position_m - a.position_m;
  out.covariance_m2 = own_position_covariance(a, of_a) + own_position_covariance(b, of_b);
  out.covariance_m2.diagonal().array() += kLeastVariance_m2;
  const auto is_height_weak = [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == model::AnchorVerdict::kWeakZ || anchor.verdict == model::AnchorVerdict::kWeak;
  };
  if (is_height_weak(a) || is_height_weak(b)) {
    out.covariance_m2(2, 2) += kWeakHeight_m * kWeakHeight_m;
  }
  const Eigen::LDLT<Eigen::Matrix3d> factors(out.covariance_m2);
  out.information = out.frame.transpose() * factors.solve(out.frame);
  out.right_side = out.frame.transpose() * factors.solve(out.difference_m);
  return out;
}

// By all that are no outliers but `left_out`. The prior may be singular: a frame that is known exactly.
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

// One after the other, the one that stands out most is set apart, until none does.
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
      pairs.push_back({.tag_id = a.tag_id,
                       .anchor_id = anchor.a->id,
                       .beta_m = b->beta_m - a.beta_m,
                       .beta_sigma_m = std::hypot(a.beta_sigma_m, b->beta_sigma_m),
                       .gamma = b->gamma - a.gamma,
                       .gamma_sigma = std::hypot(a.gamma_sigma, b->gamma_sigma)});
    }
  }
  const double limit =
      0.5 * Comparison::kChance / static_cast<double>(std::max<std::size_t>(1, pairs.size()));
  const auto stands_out = [limit](double difference, double sigma) {
    return sigma > 0.0 && chi2_tail_1(difference * difference / (sigma * sigma)) < limit;
  };
  for (PairChange& pair : pairs) {
    pair.differs = stands_out(pair.beta_m, pair.beta_sigma_m) || stands_out(pair.gamma, pair.gamma_sigma);
  }
  return pairs;
}

}  // namespace

Comparison compare(const model::Calibration& a, const model::Calibration& b) {
  Comparison out;
  std::vector<Shared> shared;
  const auto find_placed = [](const model::Calibration& calibration, model::NodeId id) {
    const model::AnchorCalibration* found = model::find_anchor(calibration, id);
    return found != nullptr && model::has_position(*found) ? found : nullptr;
  };
  for (const model::AnchorCalibration& anchor : a.anchors) {
    if (!model::has_position(anchor)) continue;
    if (const auto* other = find_placed(b, anchor.id)) {
      shared.push_back(make_shared(a, anchor, b, *other));
    } else {
      out.only_a.push_back(anchor.id);
    }
  }
  for (const model::AnchorCalibration& anchor : b.anchors) {
    if (model::has_position(anchor) && find_placed(a, anchor.id) == nullptr) out.only_b.push_back(anchor.id);
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
  // The nearest point has (1/variance + k) v = along/variance, with k such that its length is the radius.
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

}  // namespace groma::calibration
