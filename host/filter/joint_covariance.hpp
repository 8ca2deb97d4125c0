// Covariance of core and parameters together: P = [core, cross^T; cross, parameters].
//
// Two things are kept as factors until they are needed. Motion changes the cross-covariance by a product with
// a 9 x 9 matrix from the right, and these are gathered until the next range. A slow error is kept as a
// multiple of what all of them have faded by, so that time changes one number; so are those of the ground.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include <Eigen/Core>

#include "host/filter/covariance_kernels.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/site.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

using GroundRows = Eigen::Matrix<double, kGroundSize, kCoreSize>;

// The covariance of the core, and what the ground is to it, apart from the site's parameters: all that a look
// ahead by odometry needs, which corrects nothing. As JointCovariance's functions of the same names. Slow
// errors of ranges are not in it: they fade for nothing.
class CoreCovariance {
 public:
  // Of the core, of the ground with the core, and of the ground's height (m) and slopes, independent.
  CoreCovariance(const CoreMatrix& core, const GroundRows& ground_cross,
                 const Eigen::Vector3d& ground_variances)
      : core_(core), ground_cross_(ground_cross), ground_variances_(ground_variances) {}

  void renew_row(const Eigen::Vector3d& variances) noexcept;
  void renew(CoreIndex index, double variance) noexcept;
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  void propagate(const PoseRows& pose_rows) noexcept;
  void renew_ground(const Eigen::Vector3d& variances) noexcept;
  void fade_ground(double factor) noexcept { ground_cross_ *= factor; }
  void fade_slow_errors(double /*factor*/) noexcept {}

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  [[nodiscard]] const Eigen::Vector3d& ground_variances() const noexcept { return ground_variances_; }
  [[nodiscard]] const GroundRows& ground_cross() const noexcept { return ground_cross_; }

 private:
  CoreMatrix core_;
  GroundRows ground_cross_;
  Eigen::Vector3d ground_variances_;
};

// What a measurement may change among the parameters.
enum class Learning {
  kNothing,    // consider states: their covariance stays as it came, blocks of each anchor, tag and frame
  kPositions,  // anchor positions are estimated, the others considered
  kAll,
};

// The pair of a measurement: the active anchor's slot, the tag, and the anchor as the site told it.
struct PairPlace {
  int slot = 0;
  int tag = 0;
  const SiteAnchor* anchor = nullptr;
};

// P H^T of one scalar measurement, and its variance H P H^T (without the measurement's own noise).
struct Projected {
  CoreVector core;
  double variance = 0.0;
  // Ppp H^T, of the parameters' own covariance alone.
  alignas(64) std::array<double, static_cast<std::size_t>(kCrossStride)> own;
};

// What an anchor that leaves the active set takes with it.
struct AnchorMemory {
  bool was_active = false;
  std::uint64_t left = 0;  // number of the exchange at which it left
  double t_s = 0.0;        // and the time
  // Where nothing is learnt: what relates it to the core.
  Eigen::Matrix<double, Eigen::Dynamic, kCoreSize, Eigen::ColMajor, kMaxAnchorSize, kCoreSize> cross;
  // Where it is learnt: its values and those of what all anchors share, how it depends on these, and its
  // covariance given them.
  AnchorVector values;
  CommonVector common;
  AnchorByCommon by_common;
  AnchorMatrix covariance;
};

class JointCovariance {
 public:
  JointCovariance(const Site& site, const Parameters& parameters, Learning learning);

  // The core begins anew with this covariance, unrelated to the parameters.
  void reset_core(const CoreMatrix& covariance) noexcept;
  // Another odometry row: its errors' variances, unrelated to all else.
  void renew_row(const Eigen::Vector3d& variances) noexcept;
  // One core state begins anew, unrelated to all else.
  void renew(CoreIndex index, double variance) noexcept;
  // White noise upon a core state.
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  // P <- F P F^T, of the core and its cross-covariance.
  void propagate(const PoseRows& pose_rows) noexcept;

  // What the ground differs by from the surface is new, with these variances (of height, dS/dx, dS/dy):
  // related to nothing.
  void renew_ground(const Eigen::Vector3d& variances) noexcept;
  // It forgets: what relates it to all else falls by that factor, its variance stays.
  void fade_ground(double factor) noexcept;
  [[nodiscard]] const Eigen::Vector3d& ground_variances() const noexcept { return ground_variances_; }
  // Its covariance with the core.
  [[nodiscard]] GroundRows ground_cross() const noexcept;

  // Slow errors of ranges forget: what relates them to all else falls by that factor, their variance stays.
  void fade_slow_errors(double factor) noexcept;
  // Slow errors are, and were, larger by that factor.
  void scale_slow_errors(double factor) noexcept;

  // For the models that keep no cross-covariance: H P H^T of the core alone, with its P H^T, and of the
  // parameters alone.
  [[nodiscard]] double project_core(const CoreRow& d_core, CoreVector& out) const noexcept;
  [[nodiscard]] double parameter_variance(const RangeMeasurement& measurement,
                                          const PairPlace& pair) const noexcept;
  void correct_core(const CoreVector& ph, double variance) noexcept;

  void project(const RangeMeasurement& measurement, const PairPlace& pair, Projected& out) noexcept;
  // Of what depends on the core alone.
  void project(const CoreRow& d_core, Projected& out) noexcept;
  // P <- P - P H^T H P / variance, but for what is considered: its own covariance stays. That is the
  // consider (Schmidt) update, equal to its Joseph form for the gain P H^T / variance. The values of what is
  // learnt change by that gain times the innovation.
  void correct(const CoreRow& d_core, Projected& projected, double variance, double innovation,
               ParameterVector& values) noexcept;

  // An anchor leaves its slot, and another one comes into it; `faded` is what time has left of its slow
  // error since it left; parameters: with the anchor's values in the slot.
  void leave(const Parameters& parameters, int slot, AnchorMemory& memory) noexcept;
  void enter(const SiteAnchor& anchor, int slot, const AnchorMemory& memory, double faded,
             Parameters& parameters) noexcept;
  // Where nothing is learnt: by what matrix (from the right) the covariance of absent anchors with the core
  // has changed since the absence began; begin_absence() begins anew.
  [[nodiscard]] CoreMatrix absence() noexcept;
  void begin_absence() noexcept;

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  // For tests and diagnosis, in full.
  [[nodiscard]] Eigen::MatrixXd cross() const;
  [[nodiscard]] Eigen::MatrixXd parameters(const Site& site, const Parameters& parameters) const;

 private:
  [[nodiscard]] double& lower(int row, int column) noexcept { return lower_data()[row + column * stride_]; }
  [[nodiscard]] double lower(int row, int column) const noexcept {
    return lower_data()[row + column * stride_];
  }
  [[nodiscard]] double* lower_data() noexcept { return lower_.data()->data(); }
  [[nodiscard]] const double* lower_data() const noexcept { return lower_.data()->data(); }
  // Rows of the cross-covariance.
  [[nodiscard]] int rows() const noexcept { return size_ + absent_rows_; }
  [[nodiscard]] double& at(int i, int j) noexcept;  // of either triangle
  // The block of the parameters' covariance that begins there.
  template <class Block>
  void read(int row, int column, Block& out) const noexcept;
  // What the calibration gives, but for slow errors and ground.
  void set_prior(const Site& site, const Parameters& parameters, Eigen::Ref<Eigen::MatrixXd> all) const;
  void learn(int slot, bool learnt) noexcept;
  void settle_motion() noexcept;
  void scale_cross(int parameter, double factor) noexcept;
  void settle_slow_errors() noexcept;
  void settle_ground() noexcept;
  [[nodiscard]] bool has_ground() const noexcept { return !ground_variances_.isZero(0.0); }
  // d of the stored parameters: slow errors are stored as multiples of slow_scale_, the ground's of
  // ground_scale_.
  [[nodiscard]] Eigen::Matrix<double, 1, kPairParameters> stored(
      const RangeMeasurement& measurement) const noexcept;
  void own_of_considered(const RangeMeasurement& measurement, const PairPlace& pair,
                         double* own) const noexcept;
  void own_of_learnt(const RangeMeasurement& measurement, const PairPlace& pair, double* own) const noexcept;

  Learning learning_;
  Layout layout_;
  int size_ = 0;
  int stride_ = 0;
  int absent_rows_ = 0;  // of the cross-covariance, behind the parameters': see absence()
  double lever_arm_variance_m2_ = 0.0;
  double slow_variance_m2_ = 0.0;
  Eigen::Matrix4d frame_covariance_;

  CoreMatrix core_ = CoreMatrix::Zero();
  alignas(64) std::array<double, static_cast<std::size_t>(kCoreSize) * kCrossStride> cross_{};
  // Motion since cross_ was settled: rows of the pose, and whether the row's errors are still the same.
  PoseRows motion_ = PoseRows::Identity();
  bool moved_ = false;
  bool same_row_ = true;
  double slow_scale_ = 1.0;
  Eigen::Vector3d ground_variances_ = Eigen::Vector3d::Zero();
  double ground_scale_ = 1.0;
  // Of what is learnt: the lower triangle, column by column. Empty where nothing is.
  struct alignas(64) Line : std::array<double, kKernelStep> {};
  std::vector<Line> lower_;
  alignas(64) std::array<double, static_cast<std::size_t>(kCrossStride)> learns_{};  // 1 learnt, 0 considered
  bool considered_ = false;  // anything but slow errors
};

}  // namespace groma::filter
