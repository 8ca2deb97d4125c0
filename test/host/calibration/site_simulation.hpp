// A simulated drive past the twelve anchors of the source paper's Table I, with ranges to three tags, and the
// Cramer-Rao bound of its calibration.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <numbers>
#include <optional>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include "host/calibration/calibrate.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"
#include "test/support/random.hpp"

namespace groma::test {

// Routes through the hall, each over about the same area.
enum class Route {
  kWaves,      // two slow waves that fill the hall
  kEight,      // in 120 s
  kRectangle,  // three laps with sharp corners
  kEllipse,    // three laps
};
inline constexpr std::array kRoutes{Route::kWaves, Route::kEight, Route::kRectangle, Route::kEllipse};

struct SiteSettings {
  Route route = Route::kWaves;
  double duration_s = 240.0;
  std::size_t ranges_per_pair = 200;
  double sigma_m = 0.1;
  double outlier_share = 0.0;  // too long: uniform 0.5 to 3.5 m or, if excess_mean_m > 0, exponential
  double excess_mean_m = 0.0;
  double beta_sigma_m = 0.3;
  double gamma_sigma = 0.005;
  double pose_sigma_m = 0.0;  // of the priors' error in x and in y, correlated over pose_correlation_s
  double pose_yaw_sigma_rad = 0.0;
  double pose_correlation_s = 20.0;
  // If set, the error is that of an oscillator with natural frequency 1/pose_correlation_s, driven by white
  // noise.
  std::optional<double> pose_damping_ratio = {};
  double range_delay_s = 0.0;      // of the ranges' timestamps
  double lever_arm_sigma_m = 0.0;  // per axis, of each tag's lever arm
  double pattern_sigma_m = 0.0;    // per coefficient of each tag's antenna pattern
  double place_error_m = 0.0;      // of a range error that depends on anchor and place
};

// The drawn parameters and the simulated samples.
struct SimulatedSite {
  SiteSettings settings;
  std::vector<model::Anchor> anchors;
  std::vector<model::Tag> tags;
  std::vector<model::PoseSample> truth;
  std::vector<model::PoseSample> poses;  // with their errors
  std::vector<model::RangeSample> ranges;
  std::vector<std::vector<double>> beta_m;  // [anchor][tag]
  std::vector<std::vector<double>> gamma;
  std::vector<Eigen::Vector3d> lever_arm_error_m;  // [tag], base_link
  std::vector<model::PatternTerms> pattern_m;      // [tag]
  model::Surface floor;

  [[nodiscard]] calibration::Drive drive() const {
    calibration::Drive out;
    out.ranges = ranges;
    out.poses = poses;
    out.tags = tags;
    out.surface = &floor;
    out.priors.sigma_m = settings.sigma_m;
    out.priors.beta_m = {0.0, settings.beta_sigma_m};
    out.priors.gamma = {1.0, settings.gamma_sigma};
    return out;
  }
};

std::vector<model::Anchor> table_one_anchors();

inline std::vector<model::Tag> three_tags() {
  return {{1, {0.75, 0.45, 1.90}}, {2, {-0.70, -0.42, 1.25}}, {3, {0.60, -0.45, 0.35}}};
}

// Range error of one anchor, smooth in the antenna's place: waves of 2 to 6 m.
class PlaceError {
 public:
  PlaceError(double sigma_m, Random& random) : amplitude_m_(sigma_m * std::sqrt(2.0 / kWaves)) {
    for (Wave& wave : waves_) {
      const double angle_rad = random.uniform(0.0, 2.0 * std::numbers::pi);
      const double per_m = 2.0 * std::numbers::pi / random.uniform(2.0, 6.0);
      wave.vector_radpm = per_m * Eigen::Vector2d(std::cos(angle_rad), std::sin(angle_rad));
      wave.phase_rad = random.uniform(0.0, 2.0 * std::numbers::pi);
    }
  }
  [[nodiscard]] double at(const Eigen::Vector2d& place_m) const {
    double sum = 0.0;
    for (const Wave& wave : waves_) sum += std::sin(wave.vector_radpm.dot(place_m) + wave.phase_rad);
    return amplitude_m_ * sum;
  }

 private:
  static constexpr std::size_t kWaves = 8;
  struct Wave {
    Eigen::Vector2d vector_radpm;
    double phase_rad = 0.0;
  };
  double amplitude_m_;
  std::array<Wave, kWaves> waves_;
};

Eigen::Vector2d place_on(Route route, double t_s);

// The true pose: on the route, heading along the chord over 0.6 s about the instant.
model::PoseSample true_pose(double t_s, Route route);

inline Eigen::Vector3d antenna_of(const model::PoseSample& pose, const model::Tag& tag) {
  return Eigen::Vector3d(pose.x_m, pose.y_m, pose.z_m) +
         Eigen::AngleAxisd(pose.yaw_rad, Eigen::Vector3d::UnitZ()) * tag.lever_arm_m;
}

SimulatedSite simulate_site(const SiteSettings& settings, std::uint64_t seed);

// Simulates the site's ranges again for a robot on another path, with exact poses.
template <typename PoseAt>
SimulatedSite with_path(SimulatedSite site, PoseAt pose_at) {
  Random random(99);
  for (model::PoseSample& pose : site.poses) pose = pose_at(pose.t_s);
  site.truth = site.poses;
  for (model::RangeSample& range : site.ranges) {
    const std::size_t a = range.anchor_id - site.anchors.front().id;
    const std::size_t j = range.tag_id - site.tags.front().id;
    const double distance_m =
        (antenna_of(pose_at(range.t_s), site.tags[j]) - site.anchors[a].position_m).norm();
    range.range_m =
        site.gamma[a][j] * distance_m + site.beta_m[a][j] + site.settings.sigma_m * random.gaussian();
  }
  return site;
}
inline model::PoseSample standing_pose(double t_s) {
  return {.t_s = t_s, .x_m = 8.0, .y_m = 7.0, .yaw_rad = 0.3};
}
inline model::PoseSample straight_pose(double t_s) {
  return {.t_s = t_s, .x_m = 3.0 + 0.06 * t_s, .y_m = 7.5, .yaw_rad = 0.0};
}

// Cramer-Rao bound of one anchor's (position, beta of each tag, gamma of each tag) from all its ranges
// without outliers, with the priors of the biases and perfect poses: the inverse of the information, from the
// range model itself, eq. (12).
Eigen::MatrixXd cramer_rao_bound(const SimulatedSite& site, std::size_t a);

}  // namespace groma::test
