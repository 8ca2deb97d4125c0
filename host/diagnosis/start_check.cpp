#include "host/diagnosis/start_check.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>
#include <vector>

#include <Eigen/LU>

#include "host/diagnosis/student.hpp"
#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/units.hpp"
#include "host/model/pose.hpp"

namespace groma::diagnosis {
namespace {

// Information of each block.
std::vector<Eigen::Matrix3d> information_of(const WindowScene& scene, const RangeFit& fit) {
  std::vector<Eigen::Vector3d> antennas_m;
  scene.locate({}, antennas_m);
  RangeDerivatives by{.block = Eigen::VectorXd::Zero(3)};
  std::vector<Eigen::Matrix3d> out(scene.block_count(), Eigen::Matrix3d::Zero());
  for (std::size_t i = 0; i < antennas_m.size(); ++i) {
    const RangeRow& row = scene.rows()[i];
    const double residual_m = row.range_m - scene.predict_m(row, antennas_m[i], fit.blocks[row.block], by);
    if (!std::isfinite(residual_m)) continue;
    out[row.block] += student_weight(residual_m, fit.scale_m) / model::square(fit.scale_m) * by.block *
                      by.block.transpose();
  }
  return out;
}

// The window that shows the start's heading best, and its sigma.
struct Shows {
  std::size_t window = 0;
  double sigma_rad = std::numeric_limits<double>::infinity();
};
Shows best_window(const WindowScene& scene, const RangeFit& fit, double start_s) {
  constexpr double kDrift_radps = 0.001;  // of the odometry's heading, by hand
  Shows best;
  const std::vector<Eigen::Matrix3d> information = information_of(scene, fit);
  for (std::size_t i = 0; i < information.size(); ++i) {
    const double variance_rad2 = information[i].inverse()(2, 2);
    if (!(variance_rad2 > 0.0)) continue;  // NaN if the window is singular
    const double sigma_rad = std::hypot(std::sqrt(variance_rad2), kHeadingSystematic_rad,
                                        kDrift_radps * (scene.windows()[i] - start_s));
    if (sigma_rad < best.sigma_rad) best = {i, sigma_rad};
  }
  return best;
}

// The heading is given as yaw_rad, and too large by error_rad.
Finding wrong_heading(double yaw_rad, double error_rad, double sigma_rad) {
  constexpr double kNear_rad = 0.25;  // by hand
  constexpr double kTurn_rad = 7.0;   // a turn and a bit
  // The size of the error shows its cause: the true heading is the given one less the error.
  const double off_degrees_rad = std::abs(model::wrap_angle(yaw_rad / kDegrees.factor - yaw_rad + error_rad));
  if (std::abs(yaw_rad) > kTurn_rad && off_degrees_rad < kNear_rad) {
    return {.cause = "angle-unit",
            .evidence = "the ranges fit the start if its heading is in degrees",
            .remedy = "give the column yaw_rad of the poses in radians",
            .value = {kDegrees.factor}};
  }
  const double off_sign_rad = std::abs(model::wrap_angle(2.0 * yaw_rad - error_rad));
  const double off_axis_rad = std::abs(std::remainder(error_rad, 0.5 * std::numbers::pi));
  if (off_sign_rad < kNear_rad && off_sign_rad < off_axis_rad) {
    return {.cause = "heading-sign",
            .evidence = "the ranges fit the start if its heading changes its sign",
            .remedy = "count the yaw of the poses counter-clockwise, from above"};
  }
  return {
      .cause = "heading-offset",
      .evidence = fmt::format("the heading of the start is {:.1f} degrees off the one that the ranges show",
                              error_rad * kDegrees.factor),
      .remedy =
          "give the yaw of base_link's x axis (forward) at the start, or leave the search for the start "
          "to --relocate",
      .value = {error_rad},
      .sigma = {sigma_rad}};
}

Finding wrong_place(const Eigen::Vector2d& given_m, const Eigen::Vector2d& true_m, double near_m) {
  for (const Unit& unit : kLengthUnits) {
    if ((given_m / unit.factor - true_m).norm() > near_m) continue;
    return {.cause = "length-unit",
            .evidence = fmt::format("the ranges fit the start if its position is in {}", unit.name),
            .remedy = "give the positions of the poses in metres",
            .value = {unit.factor}};
  }
  return {
      .cause = "map-mismatch",
      .evidence = fmt::format("the start is {:.1f} m from where the ranges put it on the calibration's map",
                              (given_m - true_m).norm()),
      .remedy = "give the start in the calibration's frame, or leave the search for the start to --relocate"};
}

}  // namespace

std::optional<Finding> find_wrong_start(const GivenStart& start, const WindowScene& scene,
                                        const RangeFit& best) {
  // By hand: five sigmas of a start, from which a filter does not find back; and a place from which it does
  // not.
  constexpr double kLeast_rad = 0.25;
  constexpr double kLeast_m = 3.0;
  // By hand, in log likelihood: poses that differ by less explain the window's ranges alike.
  constexpr double kLeastGain = 30.0;
  const auto [window, sigma_rad] = best_window(scene, best, start.t_s);
  if (!std::isfinite(sigma_rad)) return std::nullopt;
  const double window_s = scene.windows()[window];
  const Eigen::Vector3d given(start.pose.x_m, start.pose.y_m, start.pose.theta_rad);
  const Eigen::Vector3d truth = scene.carried(best.blocks[window], window_s, start.t_s);
  const double way_m = (truth - best.blocks[window]).head<2>().norm();
  const double least_rad = std::max(kLeast_rad, kSignificance * sigma_rad);
  const double least_m = kLeast_m + kSignificance * sigma_rad * way_m;
  const auto differ = [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    return (a - b).head<2>().norm() > least_m || std::abs(model::wrap_angle(a.z() - b.z())) > least_rad;
  };
  if (!truth.allFinite() || !differ(given, truth)) return std::nullopt;
  std::vector<Eigen::VectorXd> blocks = best.blocks;
  blocks[window] = scene.carried(given, start.t_s, window_s);
  const RangeFit near = fit_ranges_near(scene, {}, std::move(blocks));
  if (differ(near.blocks[window], best.blocks[window]) &&
      (near.cost - best.cost) * static_cast<double>(best.rows) < kLeastGain) {
    return std::nullopt;
  }
  if ((given - truth).head<2>().norm() > least_m)
    return wrong_place(given.head<2>(), truth.head<2>(), least_m);
  return wrong_heading(given.z(), model::wrap_angle(given.z() - truth.z()), sigma_rad);
}

}  // namespace groma::diagnosis
