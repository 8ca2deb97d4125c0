#include "host/filter/joint_covariance.hpp"

namespace groma::filter {

JointCovariance::JointCovariance(const Parameters& parameters, const model::Calibration& calibration,
                                 double lever_arm_sigma_m, Learning learning)
    : learning_(learning), parameters_(parameters.prior_covariance(calibration, lever_arm_sigma_m)) {
  const int size = parameters.size();
  cross_.setZero(size, kCoreSize);
  scratch_.setZero(size, kCoreSize);
  learns_.setConstant(size, learning == Learning::kAll ? 1.0 : 0.0);

  const auto block = [this](int begin, int length) {
    for (int i = begin; i < begin + length; ++i)
      blocks_[static_cast<std::size_t>(i)] = {begin, begin + length};
  };
  for (int anchor = 0; anchor < parameters.anchor_count(); ++anchor) {
    block(parameters.position(anchor), parameters.anchor_size());
    if (learning == Learning::kPositions) learns_.segment<3>(parameters.position(anchor)).setOnes();
  }
  for (int tag = 0; tag < parameters.tag_count(); ++tag) block(parameters.lever_arm(tag), 3);
  block(parameters.frame(), kFrameSize);
  // What a calibration is not sure of itself has more than one solution: a filter settles for a wrong one.
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const int slot = parameters.anchor_slot(anchor.id);
    if (slot < 0 || anchor.verdict == model::AnchorVerdict::kOk) continue;
    learns_.segment(parameters.position(slot), parameters.anchor_size()).setZero();
  }
  first_slow_error_ = parameters.slow_error(0);
  for (int anchor = 0; anchor < parameters.anchor_count(); ++anchor) {
    block(parameters.slow_error(anchor), 1);
    learns_(parameters.slow_error(anchor)) = 0.0;
  }
}

void JointCovariance::reset_core(const CoreVector& variances) noexcept {
  core_ = variances.asDiagonal();
  cross_.setZero();
}

void JointCovariance::renew(CoreIndex index, double variance) noexcept {
  core_.row(index).setZero();
  core_.col(index).setZero();
  core_(index, index) = variance;
  cross_.col(index).setZero();
}

void JointCovariance::propagate(const Eigen::Matrix<double, 3, kCoreSize>& f) noexcept {
  const Eigen::Matrix<double, 3, kCoreSize> fp = f * core_;
  const Eigen::Matrix3d pose = fp * f.transpose();
  core_.topRows<3>() = fp;
  core_.leftCols<3>() = fp.transpose();
  core_.topLeftCorner<3, 3>() = 0.5 * (pose + pose.transpose());

  auto moved = scratch_.leftCols<3>();
  moved.noalias() = cross_.lazyProduct(f.transpose());
  cross_.leftCols<3>() = moved;
}

void JointCovariance::fade_slow_errors(double factor) noexcept {
  const Eigen::Index slow = parameters_.rows() - first_slow_error_;
  cross_.bottomRows(slow) *= factor;
  if (learning_ == Learning::kNothing) return;
  parameters_.topRightCorner(first_slow_error_, slow) *= factor;
  parameters_.bottomLeftCorner(slow, first_slow_error_) *= factor;
}

double JointCovariance::project_core(const CoreRow& d_core, CoreVector& out) const noexcept {
  out.noalias() = core_ * d_core.transpose();
  return d_core.dot(out);
}

double JointCovariance::parameter_variance(const RangeMeasurement& measurement) const noexcept {
  double variance = 0.0;
  for (int i = 0; i < kPairParameters; ++i) {
    for (int j = 0; j < kPairParameters; ++j) {
      variance += measurement.d_parameters(i) * measurement.d_parameters(j) *
                  parameters_(measurement.index[static_cast<std::size_t>(i)],
                              measurement.index[static_cast<std::size_t>(j)]);
    }
  }
  return variance;
}

void JointCovariance::project(const RangeMeasurement& measurement, Projected& out) const noexcept {
  out.core.noalias() = core_ * measurement.d_core.transpose();
  out.parameters.noalias() = cross_.lazyProduct(measurement.d_core.transpose());
  for (int i = 0; i < kPairParameters; ++i) {
    const int column = measurement.index[static_cast<std::size_t>(i)];
    const double d = measurement.d_parameters(i);
    out.core.noalias() += d * cross_.row(column).transpose();
    if (learning_ == Learning::kNothing) {
      const Extent rows = blocks_[static_cast<std::size_t>(column)];
      out.parameters.segment(rows.begin, rows.end - rows.begin) +=
          d * parameters_.col(column).segment(rows.begin, rows.end - rows.begin);
    } else {
      out.parameters += d * parameters_.col(column);
    }
  }
  out.variance = measurement.d_core.dot(out.core);
  for (int i = 0; i < kPairParameters; ++i) {
    out.variance +=
        measurement.d_parameters(i) * out.parameters(measurement.index[static_cast<std::size_t>(i)]);
  }
}

void JointCovariance::correct_core(const CoreVector& ph, double variance) noexcept {
  core_.noalias() -= ph * (ph.transpose() / variance);
}

void JointCovariance::correct(const Projected& projected, double variance) noexcept {
  correct_core(projected.core, variance);
  for (int i = 0; i < kCoreSize; ++i) cross_.col(i) -= (projected.core(i) / variance) * projected.parameters;
  if (learning_ == Learning::kNothing) return;
  auto masked = scratch_.col(0);
  masked = projected.parameters.cwiseProduct(learns_);
  for (int j = 0; j < parameters_.cols(); ++j) {
    const double share = projected.parameters(j) / variance;
    // A pair of considered parameters keeps its covariance.
    if (learns_(j) != 0.0) {
      parameters_.col(j) -= share * projected.parameters;
    } else {
      parameters_.col(j) -= share * masked;
    }
  }
}

void JointCovariance::mask(ParameterVector& change) const noexcept {
  change.array() *= learns_.array();
}

}  // namespace groma::filter
