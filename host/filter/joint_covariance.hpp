// Joint covariance of core and parameters: P = [core, cross^T; cross, parameters].
//
// Two operations are deferred. Motion multiplies the cross-covariance by a 9 x 9 matrix from the right; these
// matrices are accumulated until the next range. The decay of the slow range biases is kept as one common
// factor, so that time changes one number; likewise the decay of the ground's deviation.
#pragma once

#include <array>
#include <cstddef>
#include <vector>

#include <Eigen/Core>

#include "host/filter/config.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/site.hpp"
#include "host/filter/state.hpp"
#include "host/model/state_archive.hpp"

namespace groma::filter {

inline constexpr int kKernelStep = 8;  // doubles in 64 bytes, the width of AVX-512
[[nodiscard]] constexpr int padded(int size) noexcept {
  return (size + kKernelStep - 1) / kKernelStep * kKernelStep;
}
// Column stride of the cross-covariance. Behind the parameters' rows there is room for the kCoreSize rows of
// JointCovariance::take_absence().
inline constexpr int kCrossStride = padded(kMaxParameters + kCoreSize);
using PaddedVector = Eigen::Matrix<double, kCrossStride, 1>;

using GroundRows = Eigen::Matrix<double, kGroundSize, kCoreSize>;

// Covariance of the core and its cross-covariance with the ground's deviation, without the site's parameters.
// This is all that prediction without updates needs. The functions are those of JointCovariance. It has no
// slow range biases, so their decay does nothing.
class CoreCovariance {
 public:
  // ground_variances: of height (m^2), dS/dx and dS/dy, independent.
  CoreCovariance(const CoreMatrix& core, const GroundRows& ground_cross,
                 const Eigen::Vector3d& ground_variances)
      : core_(core), ground_cross_(ground_cross), ground_variances_(ground_variances) {}

  void renew_odometry_errors(const Eigen::Vector3d& variances) noexcept;
  void renew(CoreIndex index, double variance) noexcept;
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  void propagate(const PoseRows& pose_rows) noexcept;
  void renew_ground(const Eigen::Vector3d& variances) noexcept;
  void fade_ground(double factor) noexcept { ground_cross_ *= factor; }
  void fade_range_biases(double /*factor*/) noexcept {}

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  [[nodiscard]] const Eigen::Vector3d& ground_variances() const noexcept { return ground_variances_; }
  [[nodiscard]] const GroundRows& ground_cross() const noexcept { return ground_cross_; }

 private:
  CoreMatrix core_;
  GroundRows ground_cross_;
  Eigen::Vector3d ground_variances_;
};

// The pair of a measurement: slot of the active anchor, tag, and the anchor as calibrated.
struct PairPlace {
  int slot = 0;
  int tag = 0;
  const SiteAnchor* anchor = nullptr;
};

// P H^T of one scalar measurement, and its variance H P H^T (without the measurement noise).
struct Projected {
  CoreVector core;
  double variance = 0.0;
  // P_pp J^T, the contribution of the parameters' covariance block.
  alignas(64) PaddedVector own;
};

// What is stored of an anchor that was removed from the active set.
struct AnchorMemory {
  bool was_active = false;
  std::size_t left = 0;  // number of the exchange that removed it
  double way_m = 0.0;    // driven until that exchange
  // If parameters are considered: its cross-covariance with the core.
  Eigen::Matrix<double, Eigen::Dynamic, kCoreSize, Eigen::ColMajor, kMaxAnchorSize, kCoreSize> cross;
  // If it is estimated: its values and those of the common parameters, its regression on these, and its
  // covariance given these.
  AnchorVector values;
  CommonVector common;
  AnchorByCommon by_common;
  AnchorMatrix covariance;
};

class JointCovariance {
 public:
  // model: which parameters an update estimates. If all are considered (consider states), their covariance
  // stays block diagonal by anchor, tag and frame.
  JointCovariance(const Site& site, const Parameters& parameters, Model model);

  // Re-initializes the core's covariance, uncorrelated with the parameters.
  void reset_core(const CoreMatrix& covariance) noexcept;
  // Re-initializes the errors of the odometry sample (m^2/s^2, m^2/s^2, rad^2/s^2), uncorrelated.
  void renew_odometry_errors(const Eigen::Vector3d& variances) noexcept;
  // Re-initializes one core state, uncorrelated.
  void renew(CoreIndex index, double variance) noexcept;
  // Adds process noise to one core state.
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  // P <- F P F^T for the core and its cross-covariance.
  void propagate(const PoseRows& pose_rows) noexcept;

  // Re-initializes the ground's deviation from the surface: these variances (of height, dS/dx, dS/dy),
  // uncorrelated.
  void renew_ground(const Eigen::Vector3d& variances) noexcept;
  // Gauss-Markov decay of the ground's deviation: its cross-covariances fall by the factor, its variance
  // stays.
  void fade_ground(double factor) noexcept;
  [[nodiscard]] const Eigen::Vector3d& ground_variances() const noexcept { return ground_variances_; }
  // Cross-covariance of the ground's deviation with the core.
  [[nodiscard]] GroundRows ground_cross() const noexcept;

  // Gauss-Markov decay of the slow range biases: their cross-covariances fall by the factor, their variance
  // stays.
  void fade_range_biases(double factor) noexcept;

  // For models without cross-covariance: H P_cc H^T with out = P_cc H^T; J P_c J^T of (18); and the update of
  // the core.
  [[nodiscard]] double project_core(const CoreRow& d_core, CoreVector& out) const noexcept;
  [[nodiscard]] double parameter_variance(const RangeMeasurement& measurement,
                                          const PairPlace& pair) const noexcept;
  void correct_core(const CoreVector& ph, double variance) noexcept;

  void project(const RangeMeasurement& measurement, const PairPlace& pair, Projected& out) noexcept;
  // For a measurement that depends on the core only.
  void project(const CoreRow& d_core, Projected& out) noexcept;
  // Consider (Schmidt) update: P <- P - P H^T H P / variance, except the block of the considered parameters,
  // which stays. Equal to the Joseph form with the gain P H^T / variance for estimated states and 0 for
  // considered ones. The values of estimated parameters change by the gain times the innovation.
  void correct(const CoreRow& d_core, Projected& projected, double variance, double innovation,
               ParameterVector& values) noexcept;

  // Marginalizes the anchor in a slot, and augments the state by another one there. faded: decay factor of
  // the anchor's slow range bias since it was removed. parameters: already with the new anchor's values.
  void marginalize(const Parameters& parameters, int slot, AnchorMemory& memory) noexcept;
  void augment(const SiteAnchor& anchor, int slot, const AnchorMemory& memory, double faded,
               Parameters& parameters) noexcept;
  // If parameters are considered: the matrix by which, from the right, the cross-covariances of all inactive
  // anchors with the core have changed since the last call.
  CoreMatrix take_absence() noexcept;

  void archive(model::StateArchive& state) {
    state(model_, layout_, size_, stride_, absent_rows_, lever_arm_variance_m2_, range_bias_variance_m2_,
          frame_covariance_, core_, cross_, motion_, moved_, same_sample_, range_bias_scale_,
          ground_variances_, ground_scale_, lower_, estimates_);
  }

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  // Full matrices, for tests and diagnostics.
  [[nodiscard]] Eigen::MatrixXd cross() const;
  [[nodiscard]] Eigen::MatrixXd parameters(const Site& site, const Parameters& parameters) const;

 private:
  [[nodiscard]] double& lower(int row, int column) noexcept { return lower_data()[row + column * stride_]; }
  [[nodiscard]] double lower(int row, int column) const noexcept {
    return lower_data()[row + column * stride_];
  }
  [[nodiscard]] double* lower_data() noexcept { return lower_.data()->data(); }
  [[nodiscard]] const double* lower_data() const noexcept { return lower_.data()->data(); }
  // Number of rows of the cross-covariance.
  [[nodiscard]] int rows() const noexcept { return size_ + absent_rows_; }
  // Reads the block of the parameters' covariance that begins at (row, column).
  template <class Block>
  void read(int row, int column, Block& out) const noexcept;
  // The calibration's covariance, with slow range biases, without the ground.
  void set_prior(const Site& site, const Parameters& parameters, Eigen::Ref<Eigen::MatrixXd> all) const;
  void set_estimated(int slot, bool is_estimated) noexcept;
  void settle_motion() noexcept;
  void scale_cross(int parameter, double factor) noexcept;
  void settle_range_biases() noexcept;
  void settle_ground() noexcept;
  [[nodiscard]] bool considers_all() const noexcept { return lower_.empty(); }
  [[nodiscard]] bool has_ground() const noexcept { return !ground_variances_.isZero(0.0); }
  // Jacobian w.r.t. the stored parameters: slow range biases are stored in units of range_bias_scale_, the
  // ground's deviation in units of ground_scale_.
  [[nodiscard]] Eigen::Matrix<double, 1, kPairParameters> stored(
      const RangeMeasurement& measurement) const noexcept;
  void own_of_considered(const RangeMeasurement& measurement, const PairPlace& pair,
                         PaddedVector& own) const noexcept;
  void own_of_estimated(const RangeMeasurement& measurement, const PairPlace& pair,
                        PaddedVector& own) const noexcept;

  Model model_;
  Layout layout_;
  int size_ = 0;
  int stride_ = 0;
  int absent_rows_ = 0;  // rows of the cross-covariance behind the parameters': see take_absence()
  double lever_arm_variance_m2_ = 0.0;
  double range_bias_variance_m2_ = 0.0;
  Eigen::Matrix4d frame_covariance_;

  CoreMatrix core_ = CoreMatrix::Zero();
  alignas(64) Eigen::Matrix<double, kCrossStride, kCoreSize> cross_ =
      Eigen::Matrix<double, kCrossStride, kCoreSize>::Zero();
  // Motion not yet applied to cross_: the pose's rows of F, and whether the odometry sample is still the
  // same.
  PoseRows motion_ = PoseRows::Identity();
  bool moved_ = false;
  bool same_sample_ = true;
  double range_bias_scale_ = 1.0;
  Eigen::Vector3d ground_variances_ = Eigen::Vector3d::Zero();
  double ground_scale_ = 1.0;
  // Covariance of the parameters, lower triangle by columns. Empty if all are considered.
  struct alignas(64) Line : std::array<double, kKernelStep> {};
  std::vector<Line> lower_;
  alignas(64) PaddedVector estimates_ = PaddedVector::Zero();  // 1: estimated
};

}  // namespace groma::filter
