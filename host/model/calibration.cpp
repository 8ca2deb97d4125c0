#include "host/model/calibration.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

namespace groma::model {

bool has_position(const AnchorCalibration& anchor) noexcept {
  const Eigen::Index size = anchor_size(std::ssize(anchor.pairs));
  return anchor.position_m.allFinite() && anchor.covariance.rows() == size &&
         anchor.covariance.cols() == size && anchor.covariance.allFinite();
}

Eigen::VectorXd values_of(const AnchorCalibration& anchor) {
  Eigen::VectorXd out(anchor_size(std::ssize(anchor.pairs)));
  out.head<3>() = anchor.position_m;
  Eigen::Index at = 3;
  for (const PairTerm& term : kPairTerms) {
    for (const PairBias& pair : anchor.pairs) out(at++) = pair.*term.value;
  }
  return out;
}

void set_values(AnchorCalibration& anchor, const Eigen::VectorXd& values, const Eigen::MatrixXd& covariance) {
  anchor.position_m = values.head<3>();
  anchor.covariance = covariance;
  Eigen::Index at = 3;
  for (const PairTerm& term : kPairTerms) {
    for (PairBias& pair : anchor.pairs) {
      pair.*term.value = values(at);
      pair.*term.sigma = std::sqrt(covariance(at, at));
      ++at;
    }
  }
}

Eigen::MatrixXd selection(std::span<const NodeId> tags, const AnchorCalibration& anchor) {
  const Eigen::Index count = std::ssize(tags);
  const Eigen::Index own = std::ssize(anchor.pairs);
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(anchor_size(count), anchor_size(own));
  out.topLeftCorner<3, 3>().setIdentity();
  for (Eigen::Index i = 0; i < own; ++i) {
    const NodeId id = anchor.pairs[static_cast<std::size_t>(i)].tag_id;
    const Eigen::Index tag = std::find(tags.begin(), tags.end(), id) - tags.begin();
    if (tag == count) continue;
    for (std::size_t term = 0; term < kPairTerms.size(); ++term)
      out(term_index(term, tag, count), term_index(term, i, own)) = 1.0;
  }
  return out;
}

const AnchorCalibration* find_anchor(const Calibration& calibration, NodeId id) noexcept {
  const auto found = std::find_if(calibration.anchors.begin(), calibration.anchors.end(),
                                  [id](const AnchorCalibration& anchor) { return anchor.id == id; });
  return found == calibration.anchors.end() ? nullptr : &*found;
}

Eigen::Matrix<double, 3, 4> position_by_frame(const Eigen::Vector3d& place_m) noexcept {
  Eigen::Matrix<double, 3, 4> out;
  out << 1.0, 0.0, 0.0, -place_m.y(),  //
      0.0, 1.0, 0.0, place_m.x(),      //
      0.0, 0.0, 1.0, 0.0;
  return out;
}

namespace {

// The common frame's covariance, projected onto a place.
Eigen::Matrix3d frame_at(const Eigen::Vector3d& place_m, const Eigen::Matrix4d& common_frame_covariance) {
  const Eigen::Matrix<double, 3, 4> frame = position_by_frame(place_m);
  return frame * common_frame_covariance * frame.transpose();
}

}  // namespace

Eigen::MatrixXd own_covariance(const AnchorCalibration& anchor,
                               const Eigen::Matrix4d& common_frame_covariance) {
  Eigen::MatrixXd own = anchor.covariance;
  if (common_frame_covariance.isZero(0.0)) return own;
  const Eigen::Matrix3d shared = frame_at(anchor.position_m, common_frame_covariance);
  // The frame is independent of the biases: its covariance must not exceed that of the position given them.
  const Eigen::Index biases = own.rows() - 3;
  Eigen::Matrix3d room = own.topLeftCorner<3, 3>();
  if (biases > 0) {
    const Eigen::MatrixXd with_biases = own.topRightCorner(3, biases);
    room -= with_biases * own.bottomRightCorner(biases, biases).ldlt().solve(with_biases.transpose());
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(0.5 * (room + room.transpose()));
  const Eigen::Vector3d sigmas = axes.eigenvalues().cwiseMax(0.0).cwiseSqrt();
  const Eigen::Vector3d inverse = (sigmas.array() > 0.0).select(sigmas.cwiseInverse(), 0.0);
  // Whitened by `room`: at most the unit variance is subtracted along each axis.
  const Eigen::Matrix3d to_room = inverse.asDiagonal() * axes.eigenvectors().transpose();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> shares(to_room * shared * to_room.transpose());
  const Eigen::Matrix3d from_room = axes.eigenvectors() * sigmas.asDiagonal() * shares.eigenvectors();
  const Eigen::Matrix3d taken =
      from_room * shares.eigenvalues().cwiseMax(0.0).cwiseMin(1.0).asDiagonal() * from_room.transpose();
  own.topLeftCorner<3, 3>() -= 0.5 * (taken + taken.transpose());
  return own;
}

void add_common_frame(AnchorCalibration& anchor, const Eigen::Matrix4d& common_frame_covariance) {
  const Eigen::Matrix3d shared = frame_at(anchor.position_m, common_frame_covariance);
  anchor.covariance.topLeftCorner<3, 3>() += 0.5 * (shared + shared.transpose());
}

Calibration surveyed_calibration(std::span<const Anchor> anchors, std::span<const Tag> tags,
                                 const RangePriors& priors, double position_sigma_m) {
  Calibration calibration;
  calibration.verdict = Verdict::kUsable;
  std::vector<PairBias> pairs;
  for (const Tag& tag : tags) pairs.push_back({.tag_id = tag.id});
  std::sort(pairs.begin(), pairs.end(),
            [](const PairBias& a, const PairBias& b) { return a.tag_id < b.tag_id; });
  Eigen::VectorXd variances(anchor_size(std::ssize(tags)));
  variances << Eigen::Vector3d::Constant(square(position_sigma_m)),
      per_tag(sigmas_of(priors).cwiseAbs2(), std::ssize(tags));
  for (const Anchor& anchor : anchors) {
    AnchorCalibration& out = calibration.anchors.emplace_back();
    out.id = anchor.id;
    out.verdict = AnchorVerdict::kOk;
    out.pairs = pairs;
    set_values(out, anchor_at(anchor.position_m, tags.size(), priors), variances.asDiagonal());
  }
  std::sort(calibration.anchors.begin(), calibration.anchors.end(),
            [](const AnchorCalibration& a, const AnchorCalibration& b) { return a.id < b.id; });
  return calibration;
}

}  // namespace groma::model
