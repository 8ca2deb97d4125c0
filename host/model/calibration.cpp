#include "host/model/calibration.hpp"

#include <algorithm>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

namespace groma::model {

bool has_position(const AnchorCalibration& anchor) noexcept {
  const auto size = static_cast<Eigen::Index>(3 + 2 * anchor.pairs.size());
  return anchor.position_m.allFinite() && anchor.covariance.rows() == size &&
         anchor.covariance.cols() == size && anchor.covariance.allFinite();
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
  const auto pairs = static_cast<Eigen::Index>(tags.size());
  for (const Anchor& anchor : anchors) {
    AnchorCalibration& out = calibration.anchors.emplace_back();
    out.id = anchor.id;
    out.position_m = anchor.position_m;
    out.verdict = AnchorVerdict::kOk;
    for (const Tag& tag : tags) {
      out.pairs.push_back(
          {tag.id, priors.beta_m.mean, priors.beta_m.sigma, priors.gamma.mean, priors.gamma.sigma});
    }
    std::sort(out.pairs.begin(), out.pairs.end(),
              [](const PairBias& a, const PairBias& b) { return a.tag_id < b.tag_id; });
    Eigen::VectorXd sigmas(3 + 2 * pairs);
    sigmas << Eigen::Vector3d::Constant(position_sigma_m),
        Eigen::VectorXd::Constant(pairs, priors.beta_m.sigma),
        Eigen::VectorXd::Constant(pairs, priors.gamma.sigma);
    out.covariance = sigmas.cwiseAbs2().asDiagonal();
  }
  std::sort(calibration.anchors.begin(), calibration.anchors.end(),
            [](const AnchorCalibration& a, const AnchorCalibration& b) { return a.id < b.id; });
  return calibration;
}

}  // namespace groma::model
