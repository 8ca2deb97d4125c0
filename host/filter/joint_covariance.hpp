// Covariance of core and parameters together: P = [core, cross^T; cross, parameters].
#pragma once

#include <array>
#include <cstddef>

#include <Eigen/Core>

#include "host/filter/parameters.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

// What a measurement may change among the parameters.
enum class Learning {
  kNothing,    // consider states: their covariance stays as it came, blocks of each anchor, tag and frame
  kPositions,  // anchor positions are estimated, the others considered
  kAll,
};

// P H^T of one scalar measurement, and its variance H P H^T (without the measurement's own noise).
struct Projected {
  CoreVector core;
  ParameterVector parameters;
  double variance = 0.0;
};

class JointCovariance {
 public:
  using Cross = Eigen::Matrix<double, Eigen::Dynamic, kCoreSize, Eigen::ColMajor, kMaxParameters, kCoreSize>;

  JointCovariance(const Parameters& parameters, const model::Calibration& calibration,
                  double lever_arm_sigma_m, Learning learning);

  // The core begins anew with these variances, unrelated to the parameters.
  void reset_core(const CoreVector& variances) noexcept;
  // One core state begins anew with this variance, unrelated to all others.
  void renew(CoreIndex index, double variance) noexcept;
  // White noise upon a core state.
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  // P <- F P F^T with F the identity but for the pose's rows.
  void propagate(const Eigen::Matrix<double, 3, kCoreSize>& pose_rows) noexcept;

  // Slow errors of ranges forget: what relates them to all else falls by that factor, their variance stays.
  void fade_slow_errors(double factor) noexcept;

  // For the model that knows core alone.
  [[nodiscard]] double project_core(const CoreRow& d_core, CoreVector& out) const noexcept;
  // H Pp H^T of the parameters alone.
  [[nodiscard]] double parameter_variance(const RangeMeasurement& measurement) const noexcept;
  void project(const RangeMeasurement& measurement, Projected& out) const noexcept;

  // P <- P - P H^T H P / variance, but for what is considered: its own covariance stays. That is the
  // consider (Schmidt) update, equal to its Joseph form for the gain P H^T / variance.
  void correct_core(const CoreVector& ph, double variance) noexcept;
  void correct(const Projected& projected, double variance) noexcept;
  // The same mask upon a change of the parameters' values.
  void mask(ParameterVector& change) const noexcept;

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  [[nodiscard]] const Cross& cross() const noexcept { return cross_; }
  [[nodiscard]] const ParameterMatrix& parameters() const noexcept { return parameters_; }

 private:
  // Rows of a parameter's own block, first and one past the last.
  struct Extent {
    int begin = 0;
    int end = 0;
  };

  Learning learning_;
  int first_slow_error_ = 0;
  CoreMatrix core_ = CoreMatrix::Zero();
  Cross cross_;
  ParameterMatrix parameters_;
  std::array<Extent, kMaxParameters> blocks_{};
  ParameterVector learns_;  // 1 estimated, 0 considered
  Cross scratch_;
};

}  // namespace groma::filter
