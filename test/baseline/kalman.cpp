#include "test/baseline/kalman.hpp"

#include <algorithm>

namespace groma::baseline {

namespace {

bool is_gated(double innovation_m, double variance_m2, double gate) {
  return gate > 0.0 && model::square(innovation_m) > model::square(gate) * variance_m2;
}

template <class Matrix>
Matrix symmetric(const Matrix& matrix) {
  return 0.5 * (matrix + matrix.transpose());
}

}  // namespace

PaperFilter::PaperFilter(const Drive& drive, const Parameters& parameters, RangeModel model)
    : PoseFilter(drive, parameters),
      model_(model),
      variance_m2_(square(parameters.range_factor * drive.range_sigma_m)),
      gate_(parameters.gate) {}

bool PaperFilter::measure(const Range& range) {
  const Prediction predicted = predict(model_, surface_, pose_, *range.pair, range.pair->anchor_m);
  const Vector with_range = covariance_ * predicted.by_pose.transpose();
  const double variance_m2 =
      predicted.by_pose.dot(with_range) + variance_m2_ + predicted.calibration_variance_m2;
  const double innovation_m = range.range_m - predicted.range_m;
  if (is_gated(innovation_m, variance_m2, gate_)) return false;
  const Vector gain = with_range / variance_m2;
  correct(gain * innovation_m);
  covariance_ -= gain * with_range.transpose();
  covariance_ = symmetric(covariance_);
  return true;
}

AnchorStatesFilter::AnchorStatesFilter(const Drive& drive, const Parameters& parameters)
    : PoseFilter(drive, parameters),
      anchors_(drive.site->anchors().size()),
      variance_m2_(square(parameters.range_factor * drive.range_sigma_m)),
      gate_(parameters.gate) {
  for (std::size_t i = 0; i < anchors_.size(); ++i) {
    const SiteAnchor& anchor = drive.site->anchors()[i];
    const Eigen::Matrix<double, 3, 4> by_frame = model::position_by_frame(anchor.values.head<3>());
    anchors_[i].position_m = anchor.values.head<3>();
    anchors_[i].covariance = anchor.own_covariance.topLeftCorner<3, 3>() +
                             by_frame * drive.site->frame_covariance() * by_frame.transpose();
    anchors_[i].with_core.setZero();
  }
}

void AnchorStatesFilter::move(double dt_s) {
  const Matrix by_state = transition(dt_s);
  for (Anchor& anchor : anchors_) anchor.with_core = by_state * anchor.with_core;
}

bool AnchorStatesFilter::measure(const Range& range) {
  Anchor& anchor = anchors_[range.pair->anchor];
  const Prediction predicted = predict(RangeModel::kBiased, surface_, pose_, *range.pair, anchor.position_m);
  // Covariances of the range with the core and with the anchor.
  const Eigen::Vector3d with_core =
      covariance_ * predicted.by_pose.transpose() + anchor.with_core * predicted.by_anchor.transpose();
  const Eigen::Vector3d with_anchor = anchor.with_core.transpose() * predicted.by_pose.transpose() +
                                      anchor.covariance * predicted.by_anchor.transpose();
  const double variance_m2 = predicted.by_pose.dot(with_core) + predicted.by_anchor.dot(with_anchor) +
                             variance_m2_ + predicted.other_variance_m2;
  const double innovation_m = range.range_m - predicted.range_m;
  if (is_gated(innovation_m, variance_m2, gate_)) return false;
  const Eigen::Vector3d gain = with_core / variance_m2;
  const Eigen::Vector3d anchor_gain = with_anchor / variance_m2;
  correct(gain * innovation_m);
  anchor.position_m += anchor_gain * innovation_m;
  // The others' covariances with the core as if they were consider states that do not correlate with this
  // one.
  for (Anchor& other : anchors_) {
    if (&other != &anchor) other.with_core -= gain * (predicted.by_pose * other.with_core);
  }
  anchor.with_core -= gain * with_anchor.transpose();
  anchor.covariance = symmetric<Eigen::Matrix3d>(anchor.covariance - anchor_gain * with_anchor.transpose());
  covariance_ = symmetric<Matrix>(covariance_ - gain * with_core.transpose());
  return true;
}

std::vector<Eigen::Vector3d> AnchorStatesFilter::anchors_m() const {
  std::vector<Eigen::Vector3d> out;
  for (const Anchor& anchor : anchors_) out.push_back(anchor.position_m);
  return out;
}

IteratedFilter::IteratedFilter(const Drive& drive, const Parameters& parameters)
    : PoseFilter(drive, parameters),
      variance_m2_(square(parameters.range_factor * drive.range_sigma_m)),
      gate_(parameters.gate),
      kernel_(parameters.kernel) {}

bool IteratedFilter::measure(const Range& range) {
  const Vector before = state();
  const model::PlanarPose begin = pose_;
  Vector correction = Vector::Zero();
  Vector gain;
  Vector with_range;
  for (int i = 0; i < kIterations; ++i) {
    const model::PlanarPose at{before(0) + correction(0), before(1) + correction(1),
                               before(2) + correction(2), begin.chart};
    const Prediction predicted =
        predict(RangeModel::kBiased, surface_, at, *range.pair, range.pair->anchor_m);
    with_range = covariance_.template leftCols<3>() * predicted.by_pose.transpose();
    const double noise_m2 = variance_m2_ + predicted.calibration_variance_m2;
    double variance_m2 = predicted.by_pose.dot(with_range.head<3>()) + noise_m2;
    const double residual_m = range.range_m - predicted.range_m;
    if (i == 0 && is_gated(residual_m, variance_m2, gate_)) return false;
    // Huber's weight on the noise of the range.
    const double size = std::abs(residual_m) / std::sqrt(noise_m2);
    if (kernel_ > 0.0 && size > kernel_) variance_m2 += noise_m2 * (size / kernel_ - 1.0);
    gain = with_range / variance_m2;
    const Vector next = gain * (residual_m + predicted.by_pose.dot(correction.template head<3>()));
    const double change = (next - correction).template head<3>().norm();
    correction = next;
    if (change < 1e-6) break;
  }
  set_state(before + correction);
  covariance_ = symmetric<Matrix>(covariance_ - gain * with_range.transpose());
  return true;
}

}  // namespace groma::baseline
