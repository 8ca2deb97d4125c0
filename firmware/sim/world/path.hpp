// The robot's path on the floor plan as a function of time: twice continuously differentiable.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

namespace groma::sim {

struct Waypoint {
  double x_m = 0.0;
  double y_m = 0.0;
  std::optional<double> yaw_rad;  // omnidirectional robots: the heading here; nullopt: interpolated
  double stop_s = 0.0;            // duration of a stop; 0: none
};

// A car turns around by reversing: where its path doubles back, it stops and drives on in the other gear.
enum class Drive { kDifferential, kOmnidirectional, kCar };

struct PathOptions {
  Drive drive = Drive::kDifferential;  // differential and car: the heading follows the path
  double max_speed_mps = 1.0;
  double max_acceleration_mps2 = 0.5;  // along the path, and centripetal
  double max_yaw_rate_radps = 0.6;
  double corner_radius_m = 1.0;  // an arc replaces at most half of the shorter leg
  bool loop = false;             // the path returns to its start and repeats
};

// Position and heading on the floor plan, with their time derivatives.
struct PlanarMotion {
  double x_m = 0.0;
  double y_m = 0.0;
  double theta_rad = 0.0;  // unwrapped
  double vx_mps = 0.0;     // map frame
  double vy_mps = 0.0;
  double theta_radps = 0.0;
};

// Straight legs with rounded corners, driven as fast as the limits allow, then smoothed in time by a uniform
// cubic B-spline with knots every 0.1 s. The spline rounds corners slightly more and keeps speed and
// acceleration within their limits.
class Path {
 public:
  // The caller ensures at least two waypoints, a distance between consecutive ones, and positive limits. If
  // no waypoint has a yaw_rad, the heading of an omnidirectional robot follows the path too.
  Path(const std::vector<Waypoint>& waypoints, const PathOptions& options);

  [[nodiscard]] double duration_s() const noexcept;
  // When the robot passes each waypoint, or leaves it after a stop; for the last one: when it arrives.
  [[nodiscard]] const std::vector<double>& waypoint_times_s() const noexcept { return waypoint_times_s_; }
  // Of the corners; infinite if there are none.
  [[nodiscard]] double least_radius_m() const noexcept { return least_radius_m_; }
  // How often a car doubles back.
  [[nodiscard]] std::size_t gear_changes() const noexcept { return gear_changes_; }
  // Before the start and after the end of the path the robot is stationary; a looping path repeats.
  [[nodiscard]] PlanarMotion at(double t_s) const noexcept;

 private:
  struct Knot {
    double x_m;
    double y_m;
    double theta_rad;
  };
  std::vector<Knot> knots_;
  std::vector<double> waypoint_times_s_;
  double least_radius_m_;
  std::size_t gear_changes_ = 0;
  bool loop_ = false;
};

}  // namespace groma::sim
