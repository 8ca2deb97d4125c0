// A small simulated site for the filter's tests: hilly ground, anchors, a robot with tags on a drive,
// odometry with the errors that the data set format specifies, and ranges. The truth is integrated in fine
// steps.
#pragma once

#include <cmath>
#include <limits>
#include <numbers>
#include <span>
#include <vector>

#include <Eigen/LU>

#include "host/filter/filter.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"
#include "host/model/surface.hpp"
#include "test/support/random.hpp"

namespace groma::filter::testing {

using test::Random;

inline constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
inline constexpr double kInfinity = std::numeric_limits<double>::infinity();

inline Config config_of(Model model) {
  Config config;
  config.model = model;
  config.odometry = {0.03, 0.03, 0.01};
  return config;
}

model::Surface hills(double height_m);

inline std::vector<model::Tag> three_tags() {
  return {{1, {0.75, 0.45, 1.9}}, {2, {-0.7, -0.4, 1.2}}, {3, {0.6, -0.45, 0.4}}};
}

// Each anchor has a full covariance block with correlated biases, which includes the common frame's error.
model::Calibration calibration_of(const std::vector<model::Anchor>& anchors, double scale = 1.0);

// Six anchors around the origin.
model::Calibration six_anchors(double scale = 1.0);

// One drive with its ground truth.
struct Drive {
  std::vector<model::OdometrySample> odometry;
  std::vector<model::RangeSample> ranges;
  std::vector<model::PlanarPose> truth;  // at each odometry sample
};

struct DriveOptions {
  double duration_s = 10.0;
  double row_s = 0.05;
  double range_s = 0.0;  // interval between ranges; 0: none
  double scale_sigma = 0.01;
  double yaw_rate_bias_sigma_radps = 0.002;
  double range_sigma_m = 0.1;
  double lever_arm_sigma_m = 0.01;
  double range_delay_sigma_s = 0.0;
  model::OdometryNoise noise{0.03, 0.03, 0.01};
};

// True vx, vy and yaw rate, constant over the interval of an odometry sample.
inline Eigen::Vector3d true_velocity(double row_t_s) {
  return {1.0 + 0.5 * std::sin(0.7 * row_t_s), 0.3 * std::sin(0.3 * row_t_s),
          0.25 + 0.4 * std::sin(0.5 * row_t_s)};
}

// theta' = omega, t' = sigma(R_WT R_z v), by the classical Runge-Kutta method.
model::PlanarPose integrate(const model::Surface& surface, const model::PlanarPose& from,
                            const Eigen::Vector3d& velocity, double dt_s, int steps);

// A curved drive around the origin from `start`. All errors are drawn from their sigmas: odometry errors, and
// the true site from the calibration's covariance.
Drive drive(const model::Surface& surface, const model::Calibration& calibration,
            const model::PlanarPose& start, const DriveOptions& options, Random& random);

// Prior covariance of the parameters from the calibration's blocks, with all anchors active.
Eigen::MatrixXd prior_covariance(const Site& site, const Parameters& parameters,
                                 const model::Calibration& calibration);

// Joint covariance of core and parameters.
Eigen::MatrixXd whole(const Filter& filter);

// The filter's estimate predicted over these inputs.
Estimate predict(const Filter& filter, std::span<const MotionInput> ahead);

// e' P^-1 e of an estimate, the squared Mahalanobis distance of its error.
double squared_error(const Estimate& estimate, const model::PlanarPose& truth);

}  // namespace groma::filter::testing
