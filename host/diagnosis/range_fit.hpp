// Robust least squares of ranges under a hypothesis. Unknowns are the hypothesis's few parameters, which all
// ranges share, and blocks of nuisance parameters, each of which concerns a part of the ranges: an anchor's
// position and biases, or the place of a piece of dead reckoning.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/diagnosis/finding.hpp"
#include "host/diagnosis/thresholds.hpp"

namespace groma::diagnosis {

struct RangeRow {
  double t_s = 0.0;
  double range_m = 0.0;
  std::uint32_t block = 0;
  std::uint32_t tag = 0;     // index
  std::uint32_t anchor = 0;  // index
  std::uint32_t slice = 0;   // of the drive; see kSlices
};

// What is wrong with the data: given less true.
struct Mistake {
  model::ClockError clock;
  double heading_rad = 0.0;
  double height_m = 0.0;     // of the surface
  double speed_scale = 1.0;  // of the odometry
  double yaw_rate_scale = 1.0;
  double yaw_rate_bias_radps = 0.0;
  std::size_t tag = 0;  // whose lever arm is wrong
  Eigen::Vector3d lever_arm_m = Eigen::Vector3d::Zero();
};

// Derivatives of one range.
struct RangeDerivatives {
  Eigen::Vector3d antenna = Eigen::Vector3d::Zero();
  Eigen::VectorXd block;
};

class Scene {
 public:
  Scene() = default;
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;
  virtual ~Scene() = default;

  // In the order of their blocks.
  [[nodiscard]] std::span<const RangeRow> rows() const noexcept { return rows_; }
  [[nodiscard]] virtual std::size_t block_count() const = 0;
  // Places of the rows' antennas if this is wrong with the data, m; NaN if they are unknown.
  virtual void locate(const Mistake& mistake, std::vector<Eigen::Vector3d>& antennas_m) const = 0;
  // Predicted range, m; `out.block` has the block's size.
  [[nodiscard]] virtual double predict_m(const RangeRow& row, const Eigen::Vector3d& antenna_m,
                                         const Eigen::VectorXd& block, RangeDerivatives& out) const = 0;
  // Gaussian prior of each block's parameters; a sigma may be infinite.
  [[nodiscard]] const Eigen::VectorXd& prior_mean() const noexcept { return prior_mean_; }
  [[nodiscard]] const Eigen::VectorXd& prior_sigma() const noexcept { return prior_sigma_; }
  // Places to start a block from, given its rows and their antennas.
  [[nodiscard]] virtual std::vector<Eigen::VectorXd> starts(
      std::span<const RangeRow> rows, std::span<const Eigen::Vector3d> antennas_m) const = 0;

 protected:
  std::vector<RangeRow> rows_;
  Eigen::VectorXd prior_mean_;
  Eigen::VectorXd prior_sigma_;
};

// A place from distances, which are linear in it and in its square: the least squares of y = j x, m^2, with
// an error of distance_m (m) in each row; iteratively reweighted against outliers.
[[nodiscard]] Eigen::Vector3d laterate(const Eigen::MatrixX3d& j, const Eigen::VectorXd& y,
                                       const Eigen::VectorXd& distance_m, int rounds);

// Parameters of a hypothesis, and what they mean.
struct Parameters {
  Eigen::VectorXd start;
  Eigen::VectorXd prior_sigma;  // of parameter minus start
  Eigen::VectorXd step;         // of the numerical derivatives
  std::function<Mistake(const Eigen::VectorXd&)> mistake = [](const Eigen::VectorXd&) { return Mistake{}; };
  bool is_neutral = true;      // the start is no mistake
  Eigen::Index nuisances = 0;  // the last ones, which are no mistake
};

struct RangeFit {
  Eigen::VectorXd at;          // the parameters
  Eigen::MatrixXd covariance;  // of them
  std::vector<Eigen::VectorXd> blocks;
  double scale_m = 0.0;
  double cost = std::numeric_limits<double>::infinity();  // -log likelihood a row
  std::size_t rows = 0;                                   // with an antenna
  std::vector<double> slice_cost;                         // -log likelihood a row, of each slice; NaN: no row
};

// The most likely parameters and blocks, from the scene's starts of each block.
[[nodiscard]] RangeFit fit_ranges(const Scene& scene, const Parameters& parameters, int max_iterations = 60);
// From given blocks, such as those of another fit.
[[nodiscard]] RangeFit fit_ranges_near(const Scene& scene, const Parameters& parameters,
                                       std::vector<Eigen::VectorXd> blocks);

}  // namespace groma::diagnosis
