// The robot's way over the floor plan as a function of time: twice continuously differentiable.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

namespace groma::sim {

struct Waypoint {
  double x_m = 0.0;
  double y_m = 0.0;
  std::optional<double> yaw_rad;  // omnidirectional robots: the heading here; none: between its neighbours
  double stop_s = 0.0;            // 0: drive on
};

enum class Drive { kDifferential, kOmnidirectional };

struct PathOptions {
  Drive drive = Drive::kDifferential;  // differential: the heading follows the path
  double max_speed_mps = 1.0;
  double max_acceleration_mps2 = 0.5;  // along the path and across it
  double max_yaw_rate_radps = 0.6;
  double corner_radius_m = 1.0;  // at most half of the shorter leg is rounded off
  bool loop = false;             // back to the start and again
};

// Position and heading in the floor plan, with their time derivatives.
struct PlanarMotion {
  double x_m = 0.0;
  double y_m = 0.0;
  double theta_rad = 0.0;  // not wrapped
  double vx_mps = 0.0;     // map frame
  double vy_mps = 0.0;
  double theta_radps = 0.0;
};

// Straight legs with rounded corners, driven as fast as the limits allow, then smoothed in time by a uniform
// cubic B-spline of 0.1 s: that rounds a little more, and keeps speed and acceleration within their limits.
class Path {
 public:
  // A path has at least two waypoints, apart from each other, and positive limits: the caller sees to it.
  // Without an own heading anywhere an omnidirectional robot follows the path too.
  Path(const std::vector<Waypoint>& waypoints, const PathOptions& options);

  [[nodiscard]] double duration_s() const noexcept;
  // When the robot passes, or leaves after a stop, each waypoint; the last one: when it arrives.
  [[nodiscard]] const std::vector<double>& waypoint_times_s() const noexcept { return waypoint_times_s_; }
  // Before its begin and after its end the robot stands; a looping path starts again.
  [[nodiscard]] PlanarMotion at(double t_s) const noexcept;

 private:
  struct Knot {
    double x_m;
    double y_m;
    double theta_rad;
  };
  std::vector<Knot> knots_;
  std::vector<double> waypoint_times_s_;
  bool loop_ = false;
};

}  // namespace groma::sim
