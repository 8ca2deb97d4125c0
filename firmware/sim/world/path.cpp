#include "firmware/sim/world/path.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>

#include <Eigen/Core>

namespace groma::sim {

namespace {

constexpr double kKnot_s = 0.1;
constexpr double kStep_m = 0.01;  // between points of the geometric path
constexpr double kStopAtEnds_s = 1.0;
// A car's path doubles back at a corner that is this close to a half turn. It stops there to change gear.
constexpr double kDoublesBack_rad = 0.05;
constexpr double kGearChange_s = 1.0;

struct Point {
  double x_m;
  double y_m;
  double s_m = 0.0;
  double tangent_rad = 0.0;
  double curvature_1pm = 0.0;
};

double wrapped(double angle_rad) {
  return std::remainder(angle_rad, 2.0 * std::numbers::pi);
}

// The points of all legs and arcs, and the index of each waypoint's point.
struct Geometry {
  std::vector<Point> points;
  std::vector<std::size_t> waypoints;
  std::vector<std::size_t> gear_changes;  // numbers of waypoints
  double least_radius_m = std::numeric_limits<double>::infinity();
};

void append_leg(std::vector<Point>& points, const Eigen::Vector2d& to) {
  const Eigen::Vector2d from(points.back().x_m, points.back().y_m);
  const double s0 = points.back().s_m;
  const double length_m = (to - from).norm();
  const int steps = static_cast<int>(std::ceil(length_m / kStep_m));
  for (int i = 1; i <= steps; ++i) {
    const double fraction = static_cast<double>(i) / steps;
    const Eigen::Vector2d p = from + fraction * (to - from);
    points.push_back(
        {p.x(), p.y(), s0 + fraction * length_m, std::atan2(to.y() - from.y(), to.x() - from.x()), 0.0});
  }
}

// Appends an arc of turn_rad that starts with the heading tangent_rad. `at_half`: the index of its middle.
void append_arc(std::vector<Point>& points, double tangent_rad, double turn_rad, double radius_m,
                std::size_t& at_half) {
  const Point start = points.back();
  const double side = turn_rad > 0.0 ? 1.0 : -1.0;
  const double centre_x = start.x_m - side * radius_m * std::sin(tangent_rad);
  const double centre_y = start.y_m + side * radius_m * std::cos(tangent_rad);
  const double length_m = radius_m * std::abs(turn_rad);
  const int steps = std::max(2, static_cast<int>(std::ceil(length_m / kStep_m)));
  for (int i = 1; i <= steps; ++i) {
    const double fraction = static_cast<double>(i) / steps;
    const double heading = tangent_rad + fraction * turn_rad;
    points.push_back({centre_x + side * radius_m * std::sin(heading),
                      centre_y - side * radius_m * std::cos(heading), start.s_m + fraction * length_m,
                      heading, side / radius_m});
    if (i == (steps + 1) / 2) at_half = points.size() - 1;
  }
}

Geometry round_corners(const std::vector<Waypoint>& stations, double radius_m, Drive drive) {
  std::vector<Eigen::Vector2d> corners;
  corners.reserve(stations.size());
  for (const Waypoint& station : stations) corners.emplace_back(station.x_m, station.y_m);
  Geometry out;
  const Eigen::Vector2d first = corners[1] - corners[0];
  out.points.push_back({corners[0].x(), corners[0].y(), 0.0, std::atan2(first.y(), first.x()), 0.0});
  out.waypoints.push_back(0);
  for (std::size_t i = 1; i < corners.size(); ++i) {
    if (i + 1 == corners.size()) {
      append_leg(out.points, corners[i]);
      out.waypoints.push_back(out.points.size() - 1);
      break;
    }
    const Eigen::Vector2d in = corners[i] - corners[i - 1];
    const Eigen::Vector2d on = corners[i + 1] - corners[i];
    const double tangent = std::atan2(in.y(), in.x());
    const double turn = wrapped(std::atan2(on.y(), on.x()) - tangent);
    if (drive == Drive::kCar && std::abs(turn) > std::numbers::pi - kDoublesBack_rad) {
      append_leg(out.points, corners[i]);
      out.gear_changes.push_back(i);
      out.waypoints.push_back(out.points.size() - 1);
      continue;
    }
    const double cut_per_radius = std::tan(std::min(std::abs(turn), 0.99 * std::numbers::pi) / 2.0);
    const double most_m = 0.499 * std::min(in.norm(), on.norm());
    const double cut_m = std::min(radius_m * cut_per_radius, most_m);
    append_leg(out.points, corners[i] - cut_m * in.normalized());
    std::size_t at = out.points.size() - 1;
    if (cut_per_radius > 1e-6) {
      append_arc(out.points, tangent, turn, cut_m / cut_per_radius, at);
      out.least_radius_m = std::min(out.least_radius_m, cut_m / cut_per_radius);
    }
    out.waypoints.push_back(at);
  }
  return out;
}

// Headings along the path: unwrapped tangents, or smooth steps between the waypoints that have a yaw_rad.
std::vector<double> headings(const Geometry& path, const std::vector<Waypoint>& waypoints, Drive drive) {
  const std::vector<Point>& points = path.points;
  std::vector<double> theta(points.size());
  std::vector<std::size_t> named;
  for (std::size_t i = 0; i < waypoints.size(); ++i) {
    if (waypoints[i].yaw_rad) named.push_back(i);
  }
  if (drive != Drive::kOmnidirectional || named.empty()) {
    theta[0] = points[0].tangent_rad;
    auto change = path.gear_changes.begin();
    double behind_rad = 0.0;  // half a turn in reverse
    for (std::size_t i = 1; i < points.size(); ++i) {
      theta[i] = theta[i - 1] + wrapped(points[i].tangent_rad + behind_rad - theta[i - 1]);
      if (change == path.gear_changes.end() || i < path.waypoints[*change]) continue;
      behind_rad = std::numbers::pi - behind_rad;
      ++change;
    }
    return theta;
  }
  double heading = *waypoints[named.front()].yaw_rad;
  std::size_t from = 0;
  for (const std::size_t index : named) {
    const std::size_t to = path.waypoints[index];
    const double turn = wrapped(*waypoints[index].yaw_rad - heading);
    const double length_m = std::max(points[to].s_m - points[from].s_m, kStep_m);
    for (std::size_t i = from; i <= to; ++i) {
      const double u = (points[i].s_m - points[from].s_m) / length_m;
      theta[i] = heading + turn * u * u * u * (10.0 + u * (-15.0 + 6.0 * u));
    }
    heading += turn;
    from = to;
  }
  std::fill(theta.begin() + static_cast<std::ptrdiff_t>(from), theta.end(), heading);
  return theta;
}

// The stations of a loop. It starts and ends in the middle of the first leg, where both headings agree.
std::vector<Waypoint> closed(const std::vector<Waypoint>& waypoints, Drive drive) {
  Waypoint middle;
  middle.x_m = 0.5 * (waypoints[0].x_m + waypoints[1].x_m);
  middle.y_m = 0.5 * (waypoints[0].y_m + waypoints[1].y_m);
  if (drive == Drive::kOmnidirectional) middle.yaw_rad = waypoints[0].yaw_rad;
  std::vector<Waypoint> stations;
  stations.reserve(waypoints.size() + 2);
  stations.push_back(middle);
  for (std::size_t i = 1; i < waypoints.size(); ++i) stations.push_back(waypoints[i]);
  stations.push_back(waypoints[0]);
  stations.push_back(middle);
  return stations;
}

// Speeds limited by curvature and yaw rate, then by the acceleration forwards and backwards along the path.
std::vector<double> speeds(const Geometry& path, const std::vector<double>& theta,
                           const std::vector<Waypoint>& stations, const PathOptions& options) {
  const std::vector<Point>& points = path.points;
  std::vector<double> speed(points.size(), options.max_speed_mps);
  for (std::size_t i = 0; i < points.size(); ++i) {
    const double curvature = std::abs(points[i].curvature_1pm);
    if (curvature > 0.0) speed[i] = std::min(speed[i], std::sqrt(options.max_acceleration_mps2 / curvature));
    if (i == 0) continue;
    const double turn = std::abs(theta[i] - theta[i - 1]) / (points[i].s_m - points[i - 1].s_m);
    if (turn > 0.0) speed[i] = std::min(speed[i], options.max_yaw_rate_radps / turn);
  }
  for (std::size_t i = 0; i < stations.size(); ++i) {
    const bool at_end = i == 0 || i + 1 == stations.size();
    if (at_end || stations[i].stop_s > 0.0) speed[path.waypoints[i]] = 0.0;
  }
  const auto limit = [&](std::size_t to, std::size_t from) {
    const double step_m = std::abs(points[to].s_m - points[from].s_m);
    speed[to] = std::min(speed[to],
                         std::sqrt(speed[from] * speed[from] + 2.0 * options.max_acceleration_mps2 * step_m));
  };
  for (std::size_t i = 1; i < points.size(); ++i) limit(i, i - 1);
  for (std::size_t i = points.size() - 1; i-- > 0;) limit(i, i + 1);
  return speed;
}

// The robot's arrival and departure at each point; they differ where it stops.
struct Timing {
  std::vector<double> arrives_s;
  std::vector<double> leaves_s;
};

Timing timing(const Geometry& path, const std::vector<double>& speed, const std::vector<Waypoint>& stations) {
  const std::vector<Point>& points = path.points;
  Timing out{std::vector<double>(points.size()), std::vector<double>(points.size())};
  std::size_t station = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (i > 0) {
      out.arrives_s[i] =
          out.leaves_s[i - 1] + 2.0 * (points[i].s_m - points[i - 1].s_m) / (speed[i] + speed[i - 1]);
    }
    out.leaves_s[i] = out.arrives_s[i] + (i == 0 ? kStopAtEnds_s : 0.0);
    for (; station < stations.size() && path.waypoints[station] == i; ++station) {
      out.leaves_s[i] += stations[station].stop_s;
    }
  }
  return out;
}

struct Basis {
  std::array<double, 4> value;
  std::array<double, 4> first;
};

Basis basis(double t) {
  const double s = 1.0 - t;
  return {{s * s * s / 6.0, (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
           (-3.0 * t * t * t + 3.0 * t * t + 3.0 * t + 1.0) / 6.0, t * t * t / 6.0},
          {-s * s / 2.0, (3.0 * t * t - 4.0 * t) / 2.0, (-3.0 * t * t + 2.0 * t + 1.0) / 2.0, t * t / 2.0}};
}

}  // namespace

Path::Path(const std::vector<Waypoint>& waypoints, const PathOptions& options)
    : least_radius_m_(std::numeric_limits<double>::infinity()), loop_(options.loop) {
  std::vector<Waypoint> stations = loop_ ? closed(waypoints, options.drive) : waypoints;
  const Geometry geometry = round_corners(stations, options.corner_radius_m, options.drive);
  for (const std::size_t i : geometry.gear_changes)
    stations[i].stop_s = std::max(stations[i].stop_s, kGearChange_s);
  least_radius_m_ = geometry.least_radius_m;
  gear_changes_ = geometry.gear_changes.size();
  const std::vector<double> theta = headings(geometry, stations, options.drive);
  const std::vector<double> speed = speeds(geometry, theta, stations, options);
  const Timing time = timing(geometry, speed, stations);
  const std::vector<Point>& points = geometry.points;

  for (std::size_t i = 0; i < stations.size(); ++i) {
    const std::size_t at = geometry.waypoints[i];
    const double t_s = i + 1 == stations.size() ? time.arrives_s[at] : time.leaves_s[at];
    waypoint_times_s_.push_back(t_s - kKnot_s);  // at a knot the spline is near the next control point
  }

  const double end_s = time.leaves_s.back() + kStopAtEnds_s;
  const auto count = static_cast<std::size_t>(std::ceil(end_s / kKnot_s)) + 1;
  std::size_t i = 0;
  for (std::size_t knot = 0; knot < count; ++knot) {
    const double t = static_cast<double>(knot) * kKnot_s;
    while (i + 1 < points.size() && time.arrives_s[i + 1] <= t) ++i;
    double fraction = 0.0;
    if (i + 1 < points.size() && t > time.leaves_s[i]) {
      // The acceleration between two points is constant.
      const double dt = t - time.leaves_s[i];
      const double acceleration = (speed[i + 1] - speed[i]) / (time.arrives_s[i + 1] - time.leaves_s[i]);
      fraction = (speed[i] * dt + 0.5 * acceleration * dt * dt) / (points[i + 1].s_m - points[i].s_m);
    }
    const std::size_t j = std::min(i + 1, points.size() - 1);
    knots_.push_back({points[i].x_m + fraction * (points[j].x_m - points[i].x_m),
                      points[i].y_m + fraction * (points[j].y_m - points[i].y_m),
                      theta[i] + fraction * (theta[j] - theta[i])});
  }
}

double Path::duration_s() const noexcept {
  return kKnot_s * static_cast<double>(knots_.size() - 3);
}

PlanarMotion Path::at(double t_s) const noexcept {
  const double cells = static_cast<double>(knots_.size() - 3);
  double u = t_s / kKnot_s;
  if (loop_ && u > cells) u = std::fmod(u, cells);
  const bool stationary = u <= 0.0 || u >= cells;
  u = std::clamp(u, 0.0, cells);
  const auto first = std::min(static_cast<std::size_t>(u), knots_.size() - 4);
  const Basis b = basis(u - static_cast<double>(first));
  PlanarMotion out;
  for (std::size_t i = 0; i < 4; ++i) {
    const Knot& knot = knots_[first + i];
    out.x_m += b.value[i] * knot.x_m;
    out.y_m += b.value[i] * knot.y_m;
    out.theta_rad += b.value[i] * knot.theta_rad;
    if (stationary) continue;
    out.vx_mps += b.first[i] / kKnot_s * knot.x_m;
    out.vy_mps += b.first[i] / kKnot_s * knot.y_m;
    out.theta_radps += b.first[i] / kKnot_s * knot.theta_rad;
  }
  return out;
}

}  // namespace groma::sim
