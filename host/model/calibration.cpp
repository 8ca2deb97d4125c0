#include "host/model/calibration.hpp"

#include <algorithm>

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
