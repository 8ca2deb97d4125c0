#include "host/filter/joint_covariance.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include <Eigen/Cholesky>

// The loops over many parameters have variants for AVX2 and AVX-512, selected at program start. All variants
// round each operation alike, so results do not depend on the variant. Vectors and columns are aligned to 64
// bytes and padded with zeros to multiples of kKernelStep.
#if defined(__x86_64__) && defined(__linux__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define GROMA_CLONES __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define GROMA_CLONES
#endif

namespace groma::filter {

namespace {

// The common decay factor is applied to the stored values when it falls below this. Numerics: variances of
// the stored values are then 1e6 times the true ones, with ten digits left.
constexpr double kFaded = 1e-3;

// All columns begin at a multiple of 64 bytes.
double* aligned(double* at) noexcept {
  return static_cast<double*>(__builtin_assume_aligned(at, 64));
}

// C <- C F^T, with F the identity except the pose's rows, whose derivatives w.r.t. the delay are zero.
GROMA_CLONES void move_cross(double* cross, int rows, const PoseRows& pose_rows) noexcept {
  double* const c = aligned(cross);
  const PoseRows f = pose_rows;
  const int end = padded(rows);
  for (int i = 0; i < end; ++i) {
    const auto at = [=](CoreIndex k) -> double& { return c[i + k * kCrossStride]; };
    const double x = at(kX), y = at(kY), theta = at(kTheta), scale = at(kScale), bias = at(kYawBias);
    const double vx = at(kOdometryVx), vy = at(kOdometryVy), omega = at(kOdometryOmega);
    const auto position = [&](int row) {
      return f(row, kX) * x + f(row, kY) * y + f(row, kTheta) * theta + f(row, kScale) * scale +
             f(row, kYawBias) * bias + f(row, kOdometryVx) * vx + f(row, kOdometryVy) * vy +
             f(row, kOdometryOmega) * omega;
    };
    at(kX) = position(kX);
    at(kY) = position(kY);
    at(kTheta) = f(kTheta, kTheta) * theta + f(kTheta, kYawBias) * bias + f(kTheta, kOdometryOmega) * omega;
  }
}

// q <- q + C d; C <- C - q gain^T.
GROMA_CLONES void correct_cross(double* cross, int rows, const CoreVector& d_core, const CoreVector& gain_of,
                                double* q) noexcept {
  static_assert(kCoreSize == 9);
  double* const c = aligned(cross);
  double* const __restrict out = aligned(q);
  // Copies, which the stores to `c` cannot change: the loop is vectorized.
  const CoreVector d = d_core;      // NOLINT(performance-unnecessary-copy-initialization)
  const CoreVector gain = gain_of;  // NOLINT(performance-unnecessary-copy-initialization)
  const int end = padded(rows);
  for (int i = 0; i < end; ++i) {
    std::array<double, kCoreSize> v;
    for (std::size_t k = 0; k < kCoreSize; ++k) v[k] = c[i + static_cast<std::ptrdiff_t>(k) * kCrossStride];
    const double sum = ((out[i] + v[0] * d(0)) + (v[1] * d(1) + v[2] * d(2))) +
                       ((v[3] * d(3) + v[4] * d(4)) + (v[5] * d(5) + v[6] * d(6))) +
                       (v[7] * d(7) + v[8] * d(8));
    out[i] = sum;
    for (std::size_t k = 0; k < kCoreSize; ++k)
      c[i + static_cast<std::ptrdiff_t>(k) * kCrossStride] = v[k] - sum * gain[static_cast<Eigen::Index>(k)];
  }
}

// column <- column - factor v. As a function of its own, so that the compiler knows that the two do not
// overlap.
inline void subtract_scaled(double* __restrict column, const double* __restrict v, double factor, int from,
                            int end) noexcept {
  for (int i = from; i < end; ++i) column[i] -= factor * v[i];
}

// P(i, j) <- P(i, j) - g(i) g(j) for the lower triangle, stored by columns, except where both parameters are
// considered: masked = g for estimated parameters (`estimated` is not zero) and zero for the others. Each
// column from the aligned row group of the diagonal on: the entries above the diagonal are undefined.
GROMA_CLONES void subtract_square(double* lower, int stride, int size, const double* g, const double* masked,
                                  const double* estimated) noexcept {
  for (int j = 0; j < size; ++j) {
    subtract_scaled(aligned(lower) + static_cast<std::ptrdiff_t>(j) * stride,
                    estimated[j] != 0.0 ? g : masked, g[j], j - j % kKernelStep, padded(size));
  }
}

// out += P w for `count` adjacent columns of the symmetric matrix P, except the rows of their own diagonal
// block: out(i) += sum over k of w(k) P(i, first + k) for i >= first + count, and of w(k) P(first + k, i) for
// i < first.
GROMA_CLONES void add_columns(const double* lower, int stride, int size, int first, int count,
                              const double* w, double* out) noexcept {
  double* const __restrict sum = out;
  std::array<double, kMaxAnchorSize> weight{};
  std::array<int, kMaxAnchorSize> at{};
  std::size_t weights = 0;
  for (int k = 0; k < count; ++k) {
    if (w[k] == 0.0) continue;
    weight[weights] = w[k];
    at[weights++] = first + k;
  }
  for (int i = 0; i < first; ++i) {
    const double* const row = lower + static_cast<std::ptrdiff_t>(i) * stride;
    double dot = 0.0;
    for (std::size_t k = 0; k < weights; ++k) dot += weight[k] * row[at[k]];
    sum[i] += dot;
  }
  for (std::size_t k = 0; k < weights; ++k) {
    const double* const __restrict column = lower + static_cast<std::ptrdiff_t>(at[k]) * stride;
    const double factor = weight[k];
    for (int i = first + count; i < size; ++i) sum[i] += factor * column[i];
  }
}

// P <- F P F^T, F the identity except the pose's rows, whose derivatives w.r.t. the delay are zero.
void propagate_core(CoreMatrix& core, const PoseRows& f) noexcept {
  // The heading's row of F has three nonzero terms. lazyProduct avoids Eigen's kernels for large matrices.
  PoseRows fp;
  fp.topRows<2>() = f.topRows<2>().lazyProduct(core);
  fp.row(kTheta) = core.row(kTheta) + f(kTheta, kYawBias) * core.row(kYawBias) +
                   f(kTheta, kOdometryOmega) * core.row(kOdometryOmega);
  const Eigen::Matrix<double, 3, 2> by_position = fp.lazyProduct(f.topRows<2>().transpose());
  const double heading = fp(kTheta, kTheta) + f(kTheta, kYawBias) * fp(kTheta, kYawBias) +
                         f(kTheta, kOdometryOmega) * fp(kTheta, kOdometryOmega);
  core.topRows<3>() = fp;
  core.leftCols<3>() = fp.transpose();
  core.topLeftCorner<3, 2>() = by_position;
  core(kX, kY) = core(kY, kX);
  core(kX, kTheta) = core(kTheta, kX);
  core(kY, kTheta) = core(kTheta, kY);
  core(kTheta, kTheta) = heading;
}

}  // namespace

void CoreCovariance::renew_odometry_errors(const Eigen::Vector3d& variances) noexcept {
  core_.bottomRows<3>().setZero();
  core_.rightCols<3>().setZero();
  core_.diagonal().tail<3>() = variances;
  ground_cross_.rightCols<3>().setZero();
}

void CoreCovariance::renew(CoreIndex index, double variance) noexcept {
  core_.row(index).setZero();
  core_.col(index).setZero();
  core_(index, index) = variance;
  ground_cross_.col(index).setZero();
}

void CoreCovariance::propagate(const PoseRows& pose_rows) noexcept {
  propagate_core(core_, pose_rows);
  const Eigen::Matrix3d moved = ground_cross_.lazyProduct(pose_rows.transpose());
  ground_cross_.leftCols<3>() = moved;
}

void CoreCovariance::renew_ground(const Eigen::Vector3d& variances) noexcept {
  ground_cross_.setZero();
  ground_variances_ = variances;
}

JointCovariance::JointCovariance(const Site& site, const Parameters& parameters, Model model)
    : model_(model),
      layout_(parameters),
      size_(parameters.size()),
      stride_(padded(size_)),
      lever_arm_variance_m2_(site.lever_arm_variance_m2),
      range_bias_variance_m2_(site.range_bias_variance_m2),
      frame_covariance_(site.frame_covariance) {
  if (model != Model::kJoint && model != Model::kAnchorStates) {
    absent_rows_ = site.anchor_count() > layout_.anchor_count() ? kCoreSize : 0;
    take_absence();
    return;
  }
  lower_.resize(static_cast<std::size_t>(stride_ / kKernelStep) * static_cast<std::size_t>(stride_));
  set_prior(site, parameters, Eigen::Map<Eigen::MatrixXd>(lower_data(), stride_, stride_));
  if (model == Model::kJoint) estimates_.head(layout_.common_size()).setOnes();
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    set_estimated(slot, site.anchor(parameters.anchor_in(slot)).is_estimated);
  }
}

void JointCovariance::set_prior(const Site& site, const Parameters& parameters,
                                Eigen::Ref<Eigen::MatrixXd> all) const {
  all.block<kFrameSize, kFrameSize>(layout_.frame(), layout_.frame()) = frame_covariance_;
  for (int tag = 0; tag < layout_.tag_count(); ++tag) {
    all.diagonal().segment<3>(layout_.lever_arm(tag)).setConstant(lever_arm_variance_m2_);
  }
  const int size = layout_.anchor_size();
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    all.block(layout_.position(slot), layout_.position(slot), size, size) =
        site.anchor(parameters.anchor_in(slot)).covariance;
  }
}

void JointCovariance::set_estimated(int slot, bool is_estimated) noexcept {
  auto own = estimates_.segment(layout_.position(slot), layout_.anchor_size());
  own.setZero();
  if (is_estimated) own.head(model_ == Model::kJoint ? own.size() - 1 : 3).setOnes();
  // The slow range bias's variance is always range_bias_variance_m2_ and is stored there.
  lower(layout_.range_bias(slot), layout_.range_bias(slot)) = 0.0;
}

void JointCovariance::reset_core(const CoreMatrix& covariance) noexcept {
  core_ = covariance;
  cross_.setZero();
  moved_ = false;
  same_sample_ = true;
  motion_.setIdentity();
  ground_scale_ = 1.0;
}

void JointCovariance::renew_odometry_errors(const Eigen::Vector3d& variances) noexcept {
  core_.bottomRows<3>().setZero();
  core_.rightCols<3>().setZero();
  core_.diagonal().tail<3>() = variances;
  moved_ = true;
  same_sample_ = false;
}

void JointCovariance::renew(CoreIndex index, double variance) noexcept {
  settle_motion();
  core_.row(index).setZero();
  core_.col(index).setZero();
  core_(index, index) = variance;
  cross_.col(index).setZero();
}

void JointCovariance::propagate(const PoseRows& f) noexcept {
  propagate_core(core_, f);
  PoseRows motion;
  motion.topRows<2>() = f.topLeftCorner<2, 3>().lazyProduct(motion_);
  motion.row(kTheta) = motion_.row(kTheta);
  motion.middleCols<3>(3) += f.middleCols<3>(3);
  // The errors of a new odometry sample are uncorrelated.
  if (same_sample_) motion.rightCols<3>() += f.rightCols<3>();
  motion_ = motion;
  moved_ = true;
}

void JointCovariance::settle_motion() noexcept {
  if (!moved_) return;
  move_cross(cross_.data(), rows(), motion_);
  if (!same_sample_) cross_.rightCols<3>().setZero();
  motion_.setIdentity();
  moved_ = false;
  same_sample_ = true;
}

void JointCovariance::fade_range_biases(double factor) noexcept {
  range_bias_scale_ *= factor;
  if (range_bias_scale_ < kFaded) settle_range_biases();
}

void JointCovariance::renew_ground(const Eigen::Vector3d& variances) noexcept {
  ground_scale_ = 0.0;
  settle_ground();
  ground_variances_ = variances;
}

void JointCovariance::fade_ground(double factor) noexcept {
  ground_scale_ *= factor;
  if (ground_scale_ < kFaded) settle_ground();
}

void JointCovariance::scale_cross(int parameter, double factor) noexcept {
  cross_.row(parameter) *= factor;
  if (considers_all()) return;
  for (int i = 0; i < parameter; ++i) lower(parameter, i) *= factor;
  for (int i = parameter + 1; i < size_; ++i) lower(i, parameter) *= factor;
}

void JointCovariance::settle_ground() noexcept {
  for (int i = layout_.ground(); i < size_; ++i) scale_cross(i, ground_scale_);
  ground_scale_ = 1.0;
}

GroundRows JointCovariance::ground_cross() const noexcept {
  const GroundRows before = cross_.middleRows<kGroundSize>(layout_.ground()) * ground_scale_;
  GroundRows out = before;
  if (!moved_) return out;
  out.leftCols<3>() = before.lazyProduct(motion_.transpose());
  if (!same_sample_) out.rightCols<3>().setZero();
  return out;
}

void JointCovariance::settle_range_biases() noexcept {
  if (range_bias_scale_ == 1.0) return;
  for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
    scale_cross(layout_.range_bias(slot), range_bias_scale_);
  }
  range_bias_scale_ = 1.0;
}

double JointCovariance::project_core(const CoreRow& d_core, CoreVector& out) const noexcept {
  out = core_.lazyProduct(d_core.transpose());
  return d_core.dot(out);
}

void JointCovariance::own_of_considered(const RangeMeasurement& measurement, const PairPlace& pair,
                                        PaddedVector& own) const noexcept {
  const auto& d = measurement.d_parameters;
  const AnchorMatrix& block = pair.anchor->covariance;
  const int size = layout_.anchor_size() - 1;
  const auto index = model::pair_indices(pair.tag, layout_.tag_count());
  auto anchor = own.segment(layout_.position(pair.slot), size);
  anchor = block.col(0).head(size) * d(0);
  for (int k = 1; k < model::kPairSize; ++k)
    anchor += block.col(index[static_cast<std::size_t>(k)]).head(size) * d(k);
  own(layout_.range_bias(pair.slot)) = range_bias_variance_m2_ * d(kOfRangeBias) / range_bias_scale_;
  own.segment<3>(layout_.lever_arm(pair.tag)) =
      lever_arm_variance_m2_ * d.segment<3>(kOfLeverArm).transpose();
  own.segment<kFrameSize>(layout_.frame()) = frame_covariance_ * d.segment<kFrameSize>(kOfFrame).transpose();
  own.segment<kGroundSize>(layout_.ground()) =
      ground_variances_.cwiseProduct(d.tail<kGroundSize>().transpose()) / ground_scale_;
}

void JointCovariance::own_of_estimated(const RangeMeasurement& measurement, const PairPlace& pair,
                                       PaddedVector& own) const noexcept {
  const auto d = stored(measurement);
  AnchorVector of_anchor = AnchorVector::Zero(layout_.anchor_size());
  of_anchor(model::pair_indices(pair.tag, layout_.tag_count())) = d.head<model::kPairSize>().transpose();
  of_anchor(layout_.anchor_size() - 1) = d(kOfRangeBias);
  const auto add = [&](int first, int count, const double* w) {
    add_columns(lower_data(), stride_, size_, first, count, w, own.data());
    for (int i = 0; i < count; ++i) {
      for (int k = 0; k < count; ++k)
        own(first + i) += w[k] * lower(first + std::max(i, k), first + std::min(i, k));
    }
  };
  add(layout_.frame(), kFrameSize, d.data() + kOfFrame);
  add(layout_.lever_arm(pair.tag), 3, d.data() + kOfLeverArm);
  add(layout_.position(pair.slot), layout_.anchor_size(), of_anchor.data());
  own(layout_.range_bias(pair.slot)) +=
      range_bias_variance_m2_ * measurement.d_parameters(kOfRangeBias) / range_bias_scale_;
  if (!has_ground()) return;
  add(layout_.ground(), kGroundSize, d.data() + kOfGround);
  own.segment<kGroundSize>(layout_.ground()) +=
      ground_variances_.cwiseProduct(measurement.d_parameters.tail<kGroundSize>().transpose()) /
      ground_scale_;
}

double JointCovariance::parameter_variance(const RangeMeasurement& measurement,
                                           const PairPlace& pair) const noexcept {
  PaddedVector own;
  own_of_considered(measurement, pair, own);
  const PairIndices index = layout_.pair_indices(pair.slot, pair.tag);
  const auto d = stored(measurement);
  double variance = 0.0;
  for (int i = 0; i < kPairParameters; ++i) variance += d(i) * own(index[static_cast<std::size_t>(i)]);
  return variance;
}

Eigen::Matrix<double, 1, kPairParameters> JointCovariance::stored(
    const RangeMeasurement& measurement) const noexcept {
  Eigen::Matrix<double, 1, kPairParameters> d = measurement.d_parameters;
  d(kOfRangeBias) *= range_bias_scale_;
  d.tail<kGroundSize>() *= ground_scale_;
  return d;
}

void JointCovariance::project(const RangeMeasurement& measurement, const PairPlace& pair,
                              Projected& out) noexcept {
  settle_motion();
  out.own.head(padded(rows())).setZero();
  if (considers_all()) {
    own_of_considered(measurement, pair, out.own);
  } else {
    own_of_estimated(measurement, pair, out.own);
  }
  const PairIndices index = layout_.pair_indices(pair.slot, pair.tag);
  const auto d = stored(measurement);
  CoreVector by_pair = CoreVector::Zero();  // C^T J^T
  double own = 0.0;
  const int count = has_ground() ? kPairParameters : kOfGround;
  for (int i = 0; i < count; ++i) {
    const int row = index[static_cast<std::size_t>(i)];
    own += d(i) * out.own(row);
    for (int k = 0; k < kCoreSize; ++k) by_pair(k) += d(i) * cross_(row, k);
  }
  out.core = core_.lazyProduct(measurement.d_core.transpose());
  out.variance = measurement.d_core.dot(out.core) + 2.0 * measurement.d_core.dot(by_pair) + own;
  out.core += by_pair;
}

void JointCovariance::project(const CoreRow& d_core, Projected& out) noexcept {
  settle_motion();
  out.own.head(padded(rows())).setZero();
  out.variance = project_core(d_core, out.core);
}

void JointCovariance::correct_core(const CoreVector& ph, double variance) noexcept {
  // As the square of one factor, so that rounding keeps it symmetric.
  const CoreVector root = ph / std::sqrt(variance);
  core_.noalias() -= root.lazyProduct(root.transpose());
}

void JointCovariance::correct(const CoreRow& d_core, Projected& projected, double variance, double innovation,
                              ParameterVector& values) noexcept {
  correct_core(projected.core, variance);
  PaddedVector& q = projected.own;
  correct_cross(cross_.data(), rows(), d_core.transpose(), projected.core / variance, q.data());
  if (considers_all()) return;

  const double gain = innovation / variance;
  values += estimates_.head(size_).cwiseProduct(q.head(size_)) * gain;
  q.head(size_) *= 1.0 / std::sqrt(variance);
  alignas(64) PaddedVector masked;
  masked.head(stride_) = estimates_.head(stride_).cwiseProduct(q.head(stride_));
  subtract_square(lower_data(), stride_, size_, q.data(), masked.data(), estimates_.data());
}

CoreMatrix JointCovariance::take_absence() noexcept {
  settle_motion();
  auto rows = cross_.middleRows<kCoreSize>(size_);
  CoreMatrix absence = rows;
  if (absent_rows_ > 0) rows.setIdentity();
  return absence;
}

template <class Block>
void JointCovariance::read(int row, int column, Block& out) const noexcept {
  for (int j = 0; j < out.cols(); ++j) {
    for (int i = 0; i < out.rows(); ++i) {
      out(i, j) = lower(std::max(row + i, column + j), std::min(row + i, column + j));
    }
  }
}

void JointCovariance::marginalize(const Parameters& parameters, int slot, AnchorMemory& memory) noexcept {
  settle_motion();
  settle_range_biases();
  const int first = layout_.position(slot);
  const int size = layout_.anchor_size();
  const int common = layout_.common_size();
  memory.was_active = true;
  if (considers_all()) {
    memory.cross = cross_.middleRows(first, size);
    return;
  }
  // The anchor's covariance given the common parameters, and its regression on them, scaled to unit
  // variances.
  CommonMatrix shared(common, common);
  read(0, 0, shared);
  const CommonVector unit = shared.diagonal().unaryExpr(
      [](double variance) { return variance > 0.0 ? std::sqrt(1.0 / variance) : 1.0; });
  shared = unit.asDiagonal() * shared * unit.asDiagonal();
  CommonToAnchor to_shared(common, size);
  read(0, first, to_shared);
  to_shared = unit.asDiagonal() * to_shared;
  memory.covariance.resize(size, size);
  read(first, first, memory.covariance);
  // The slow range bias decays and is not stored.
  to_shared.col(size - 1).setZero();
  memory.covariance.row(size - 1).setZero();
  memory.covariance.col(size - 1).setZero();
  const CommonToAnchor by_unit = Eigen::LDLT<CommonMatrix>(shared).solve(to_shared);
  const AnchorMatrix explained = to_shared.transpose().lazyProduct(by_unit);
  memory.covariance -= 0.5 * (explained + explained.transpose());
  memory.by_common = by_unit.transpose() * unit.asDiagonal();
  memory.common = parameters.values().head(common);
  memory.values = parameters.values().segment(first, size);
}

void JointCovariance::augment(const SiteAnchor& anchor, int slot, const AnchorMemory& memory, double faded,
                              Parameters& parameters) noexcept {
  settle_motion();
  settle_range_biases();
  const int first = layout_.position(slot);
  const int size = layout_.anchor_size();
  const int common = layout_.common_size();
  auto own_cross = cross_.middleRows(first, size);
  own_cross.setZero();
  if (considers_all()) {
    if (memory.was_active) own_cross = memory.cross;
    cross_.row(first + size - 1) *= faded;
    return;
  }
  const auto write = [&](int j, const AnchorVector& column) {
    for (int i = first; i < first + size; ++i) lower(std::max(i, j), std::min(i, j)) = column(i - first);
  };
  for (int j = 0; j < size_; ++j) write(j, AnchorVector::Zero(size));
  AnchorMatrix own = memory.was_active ? memory.covariance : anchor.covariance;
  if (memory.was_active) {
    // It is correlated with the others through the common parameters only.
    const auto& by = memory.by_common;
    parameters.values().segment(first, size) += by * (parameters.values().head(common) - memory.common);
    own_cross = by.lazyProduct(cross_.topRows(common));
    CommonVector column(common);
    for (int j = 0; j < size_; ++j) {
      if (j >= first && j < first + size) continue;
      read(0, j, column);
      write(j, by.lazyProduct(column));
    }
    CommonToAnchor to_shared(common, size);
    read(0, first, to_shared);
    own += by.lazyProduct(to_shared);
  }
  for (int j = 0; j < size; ++j) {
    for (int i = j; i < size; ++i) lower(first + i, first + j) = own(i, j);
  }
  set_estimated(slot, anchor.is_estimated);
}

Eigen::MatrixXd JointCovariance::cross() const {
  JointCovariance settled = *this;
  settled.settle_motion();
  settled.settle_range_biases();
  settled.settle_ground();
  return settled.cross_.topRows(size_);
}

Eigen::MatrixXd JointCovariance::parameters(const Site& site, const Parameters& parameters) const {
  Eigen::MatrixXd all = Eigen::MatrixXd::Zero(size_, size_);
  if (considers_all()) {
    set_prior(site, parameters, all);
  } else {
    JointCovariance settled = *this;
    settled.settle_range_biases();
    settled.settle_ground();
    for (int j = 0; j < size_; ++j) {
      for (int i = j; i < size_; ++i) all(i, j) = all(j, i) = settled.lower(i, j);
    }
    for (int slot = 0; slot < layout_.anchor_count(); ++slot) {
      all(layout_.range_bias(slot), layout_.range_bias(slot)) = range_bias_variance_m2_;
    }
  }
  all.diagonal().segment<kGroundSize>(layout_.ground()) = ground_variances_;
  return all;
}

}  // namespace groma::filter
