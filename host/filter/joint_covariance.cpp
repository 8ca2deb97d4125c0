#include "host/filter/joint_covariance.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace groma::filter {

namespace {

// Slow errors are brought to their own scale when they have faded so far.
constexpr double kFaded = 1e-3;

using Rows = Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, kCoreSize>, Eigen::Aligned16,
                        Eigen::OuterStride<kCrossStride>>;
using ConstRows = Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, kCoreSize>, Eigen::Aligned16,
                             Eigen::OuterStride<kCrossStride>>;

// Positions of the parts within d_parameters.
constexpr int kOfPosition = 0;
constexpr int kOfBeta = 3;
constexpr int kOfGamma = 4;
constexpr int kOfLeverArm = 5;
constexpr int kOfFrame = 8;
constexpr int kOfSlowError = kPairParameters - 1;

}  // namespace

JointCovariance::JointCovariance(const Site& site, const Parameters& parameters, Learning learning)
    : learning_(learning),
      layout_(parameters),
      size_(parameters.size()),
      stride_(padded(size_)),
      lever_arm_variance_m2_(site.lever_arm_variance_m2()),
      slow_variance_m2_(site.slow_variance_m2()),
      frame_covariance_(site.frame_covariance()) {
  if (learning == Learning::kNothing) return;
  lower_.setZero(static_cast<Eigen::Index>(stride_) * stride_);
  Eigen::Map<Eigen::MatrixXd> all(lower_.data(), stride_, stride_);
  all.block<kFrameSize, kFrameSize>(layout_.frame(), layout_.frame()) = frame_covariance_;
  for (int tag = 0; tag < layout_.tag_count(); ++tag) {
    all.diagonal().segment<3>(layout_.lever_arm(tag)).setConstant(lever_arm_variance_m2_);
  }
  const int size = layout_.anchor_size();
  if (learning == Learning::kAll) std::fill_n(learns_.begin(), layout_.common_size(), 1.0);
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    const SiteAnchor& anchor = site.anchor(parameters.anchor_in(slot));
    all.block(layout_.position(slot), layout_.position(slot), size, size) = anchor.covariance;
    learn(slot, anchor.is_learnt);
  }
}

void JointCovariance::learn(int slot, bool learnt) noexcept {
  double* const own = learns_.data() + layout_.position(slot);
  std::fill_n(own, layout_.anchor_size(), 0.0);
  if (learnt) std::fill_n(own, learning_ == Learning::kAll ? layout_.anchor_size() - 1 : 3, 1.0);
  // The slow error's variance is known at all times and stands apart.
  lower(layout_.slow_error(slot), layout_.slow_error(slot)) = 0.0;
  considered_ = learning_ != Learning::kAll;
  for (int other = 0; other < layout_.anchor_count(); ++other) {
    if (learns_[static_cast<std::size_t>(layout_.position(other))] == 0.0) considered_ = true;
  }
}

void JointCovariance::reset_core(const CoreVector& variances) noexcept {
  core_ = variances.asDiagonal();
  cross_.fill(0.0);
  moved_ = false;
  same_row_ = true;
  motion_.setIdentity();
}

void JointCovariance::renew_row(const Eigen::Vector3d& variances) noexcept {
  core_.bottomRows<3>().setZero();
  core_.rightCols<3>().setZero();
  core_.diagonal().tail<3>() = variances;
  moved_ = true;
  same_row_ = false;
}

void JointCovariance::propagate(const PoseRows& f) noexcept {
  const PoseRows fp = f * core_;
  const Eigen::Matrix3d pose = fp * f.transpose();
  core_.topRows<3>() = fp;
  core_.leftCols<3>() = fp.transpose();
  core_.topLeftCorner<3, 3>() = 0.5 * (pose + pose.transpose());

  PoseRows motion = f.leftCols<3>() * motion_;
  motion.middleCols<3>(3) += f.middleCols<3>(3);
  // Errors of a new row are related to nothing yet.
  if (same_row_) motion.rightCols<3>() += f.rightCols<3>();
  motion_ = motion;
  moved_ = true;
}

void JointCovariance::settle_motion() noexcept {
  if (!moved_) return;
  move_cross(cross_.data(), size_, motion_);
  if (!same_row_) std::fill(cross_.begin() + kRowVx * kCrossStride, cross_.end(), 0.0);
  motion_.setIdentity();
  moved_ = false;
  same_row_ = true;
}

void JointCovariance::fade_slow_errors(double factor) noexcept {
  slow_scale_ *= factor;
  if (slow_scale_ < kFaded) settle_slow_errors();
}

void JointCovariance::settle_slow_errors() noexcept {
  Rows cross(cross_.data(), kCrossStride, kCoreSize, Eigen::OuterStride<kCrossStride>());
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    const int slow = layout_.slow_error(slot);
    cross.row(slow) *= slow_scale_;
    if (learning_ == Learning::kNothing) continue;
    for (int i = 0; i < slow; ++i) lower(slow, i) *= slow_scale_;
    for (int i = slow + 1; i < size_; ++i) lower(i, slow) *= slow_scale_;
  }
  slow_scale_ = 1.0;
}

double JointCovariance::project_core(const CoreRow& d_core, CoreVector& out) const noexcept {
  out.noalias() = core_ * d_core.transpose();
  return d_core.dot(out);
}

void JointCovariance::own_of_considered(const RangeMeasurement& measurement, const PairPlace& pair,
                                        double* own) const noexcept {
  const auto& d = measurement.d_parameters;
  const AnchorMatrix& block = pair.anchor->covariance;
  const int size = layout_.anchor_size() - 1;
  const int beta = 3 + pair.tag;
  const int gamma = beta + layout_.tag_count();
  double* const anchor = own + layout_.position(pair.slot);
  for (int i = 0; i < size; ++i) {
    anchor[i] = block(i, 0) * d(kOfPosition) + block(i, 1) * d(kOfPosition + 1) +
                block(i, 2) * d(kOfPosition + 2) + block(i, beta) * d(kOfBeta) +
                block(i, gamma) * d(kOfGamma);
  }
  anchor[size] = slow_variance_m2_ * d(kOfSlowError) / slow_scale_;
  double* const lever_arm = own + layout_.lever_arm(pair.tag);
  for (int i = 0; i < 3; ++i) lever_arm[i] = lever_arm_variance_m2_ * d(kOfLeverArm + i);
  const Eigen::Vector4d frame = frame_covariance_ * d.segment<kFrameSize>(kOfFrame).transpose();
  for (int i = 0; i < kFrameSize; ++i) own[layout_.frame() + i] = frame(i);
}

void JointCovariance::own_of_learnt(const RangeMeasurement& measurement, const PairPlace& pair,
                                    double* own) const noexcept {
  const auto& d = measurement.d_parameters;
  std::array<double, kMaxAnchorSize> of_anchor{};
  for (int i = 0; i < 3; ++i) of_anchor[static_cast<std::size_t>(i)] = d(kOfPosition + i);
  const auto at_beta = std::size_t{3} + static_cast<std::size_t>(pair.tag);
  of_anchor[at_beta] = d(kOfBeta);
  of_anchor[at_beta + static_cast<std::size_t>(layout_.tag_count())] = d(kOfGamma);
  of_anchor[static_cast<std::size_t>(layout_.anchor_size() - 1)] = slow_scale_ * d(kOfSlowError);
  std::array<double, 3> of_lever_arm{d(kOfLeverArm), d(kOfLeverArm + 1), d(kOfLeverArm + 2)};
  std::array<double, kFrameSize> of_frame{};
  for (int i = 0; i < kFrameSize; ++i) of_frame[static_cast<std::size_t>(i)] = d(kOfFrame + i);
  const auto add = [&](int first, int count, const double* w) {
    add_columns(lower_.data(), stride_, size_, first, count, w, own);
    for (int i = 0; i < count; ++i) {
      for (int k = 0; k < count; ++k) {
        own[first + i] += w[k] * (i < k ? lower(first + k, first + i) : lower(first + i, first + k));
      }
    }
  };
  add(layout_.frame(), kFrameSize, of_frame.data());
  add(layout_.lever_arm(pair.tag), 3, of_lever_arm.data());
  add(layout_.position(pair.slot), layout_.anchor_size(), of_anchor.data());
  own[layout_.slow_error(pair.slot)] += slow_variance_m2_ * d(kOfSlowError) / slow_scale_;
}

double JointCovariance::parameter_variance(const RangeMeasurement& measurement,
                                           const PairPlace& pair) const noexcept {
  std::array<double, kMaxParameters> own{};
  own_of_considered(measurement, pair, own.data());
  const PairIndices index = layout_.pair_indices(pair.slot, pair.tag);
  const auto d = stored(measurement);
  double variance = 0.0;
  for (int i = 0; i < kPairParameters; ++i) {
    variance += d(i) * own[static_cast<std::size_t>(index[static_cast<std::size_t>(i)])];
  }
  return variance;
}

Eigen::Matrix<double, 1, kPairParameters> JointCovariance::stored(
    const RangeMeasurement& measurement) const noexcept {
  Eigen::Matrix<double, 1, kPairParameters> d = measurement.d_parameters;
  d(kOfSlowError) *= slow_scale_;
  return d;
}

void JointCovariance::project(const RangeMeasurement& measurement, const PairPlace& pair,
                              Projected& out) noexcept {
  settle_motion();
  std::fill_n(out.own.begin(), padded(rows()), 0.0);
  if (learning_ == Learning::kNothing) {
    own_of_considered(measurement, pair, out.own.data());
  } else {
    own_of_learnt(measurement, pair, out.own.data());
  }
  const PairIndices index = layout_.pair_indices(pair.slot, pair.tag);
  const auto d = stored(measurement);
  CoreVector by_pair = CoreVector::Zero();  // C^T J^T
  double own = 0.0;
  for (int i = 0; i < kPairParameters; ++i) {
    const int row = index[static_cast<std::size_t>(i)];
    own += d(i) * out.own[static_cast<std::size_t>(row)];
    for (int k = 0; k < kCoreSize; ++k)
      by_pair(k) += d(i) * cross_[static_cast<std::size_t>(row + k * kCrossStride)];
  }
  out.core.noalias() = core_ * measurement.d_core.transpose();
  out.variance = measurement.d_core.dot(out.core) + 2.0 * measurement.d_core.dot(by_pair) + own;
  out.core += by_pair;
}

void JointCovariance::correct_core(const CoreVector& ph, double variance) noexcept {
  // Of one factor, so that rounding keeps it symmetric.
  const CoreVector root = ph / std::sqrt(variance);
  core_.noalias() -= root.lazyProduct(root.transpose());
}

void JointCovariance::correct(const RangeMeasurement& measurement, Projected& projected, double variance,
                              double innovation, ParameterVector& values) noexcept {
  correct_core(projected.core, variance);
  double* const q = projected.own.data();
  correct_cross(cross_.data(), rows(), measurement.d_core, projected.core / variance, q);
  if (learning_ == Learning::kNothing) return;

  const double gain = innovation / variance;
  const double root = 1.0 / std::sqrt(variance);
  for (int i = 0; i < size_; ++i) {
    const auto at = static_cast<std::size_t>(i);
    values(i) += learns_[at] * q[i] * gain;
    q[i] *= root;
  }
  if (!considered_) {
    subtract_square(lower_.data(), stride_, size_, q);
    // Slow errors are considered: their own covariance stays.
    for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
      for (int other = 0; other <= slot; ++other) {
        lower(layout_.slow_error(slot), layout_.slow_error(other)) = 0.0;
      }
    }
    return;
  }
  std::array<double, static_cast<std::size_t>(kCrossStride)> masked;
  for (int i = 0; i < size_; ++i) {
    const auto at = static_cast<std::size_t>(i);
    masked[at] = learns_[at] * q[i];
  }
  for (int j = 0; j < size_; ++j) {
    // A pair of considered parameters keeps its covariance.
    const bool learnt = learns_[static_cast<std::size_t>(j)] != 0.0;
    subtract_column(&lower(0, j), j, size_, q[j], learnt ? q : masked.data());
  }
}

Eigen::MatrixXd JointCovariance::cross() const {
  JointCovariance settled = *this;
  settled.settle_motion();
  settled.settle_slow_errors();
  return ConstRows(settled.cross_.data(), size_, kCoreSize, Eigen::OuterStride<kCrossStride>());
}

Eigen::MatrixXd JointCovariance::parameters(const Site& site, const Parameters& parameters) const {
  Eigen::MatrixXd all = Eigen::MatrixXd::Zero(size_, size_);
  if (learning_ == Learning::kNothing) {
    all.block<kFrameSize, kFrameSize>(layout_.frame(), layout_.frame()) = frame_covariance_;
    for (int tag = 0; tag < layout_.tag_count(); ++tag) {
      all.diagonal().segment<3>(layout_.lever_arm(tag)).setConstant(lever_arm_variance_m2_);
    }
    const int size = layout_.anchor_size();
    for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
      all.block(layout_.position(slot), layout_.position(slot), size, size) =
          site.anchor(parameters.anchor_in(slot)).covariance;
    }
    return all;
  }
  JointCovariance settled = *this;
  settled.settle_slow_errors();
  for (int j = 0; j < size_; ++j) {
    for (int i = j; i < size_; ++i) all(i, j) = all(j, i) = settled.lower(i, j);
  }
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    all(layout_.slow_error(slot), layout_.slow_error(slot)) = slow_variance_m2_;
  }
  return all;
}

}  // namespace groma::filter
