#include "firmware/sim/world/site.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "firmware/sim/world/smooth_noise.hpp"

namespace groma::sim {

namespace {

constexpr double kWavelength_m = 299'792'458.0 / 6489.6e6;  // channel 5
constexpr std::size_t kNoWall = static_cast<std::size_t>(-1);
constexpr double kAroundEdge_m = 0.02;    // a diffracted ray passes an edge at this distance
constexpr double kTextureLength_m = 0.8;  // length scale of the variation of delay within a wall
constexpr double kTextureSigma = 0.3;     // relative standard deviation of that delay
// A path this much longer than the first one still disturbs its leading edge (1 ns).
constexpr double kLeadingEdge_m = 0.3;
constexpr double kLeadingEdgeGain = 0.5;

double cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return a.x() * b.y() - a.y() * b.x();
}

double to_db(double power) {
  return 10.0 * std::log10(power);
}
double from_db(double db) {
  return std::pow(10.0, db / 10.0);
}

// One propagation path. excess_m: its length minus the straight line.
struct Ray {
  double excess_m;
  double power_dbm;
};

// The mirror image of p in the wall's plane.
Eigen::Vector3d mirrored(const Wall& wall, const Eigen::Vector3d& p) {
  const Eigen::Vector2d along = (wall.to_m - wall.from_m).normalized();
  const Eigen::Vector2d normal(-along.y(), along.x());
  const double distance = normal.dot(p.head<2>() - wall.from_m);
  Eigen::Vector3d image = p;
  image.head<2>() -= 2.0 * distance * normal;
  return image;
}

// Where the shortest path from a to b by the vertical line through `edge` touches that line.
Eigen::Vector3d around(const Eigen::Vector2d& edge, const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  const double before = (edge - a.head<2>()).norm();
  const double after = (b.head<2>() - edge).norm();
  const double fraction = before + after > 0.0 ? before / (before + after) : 0.5;
  return {edge.x(), edge.y(), a.z() + fraction * (b.z() - a.z())};
}

}  // namespace

std::optional<double> crossing(const Wall& wall, const Eigen::Vector3d& a,
                               const Eigen::Vector3d& b) noexcept {
  const Eigen::Vector2d along = wall.to_m - wall.from_m;
  const Eigen::Vector2d ray = b.head<2>() - a.head<2>();
  const double determinant = cross(ray, along);
  if (determinant == 0.0) return std::nullopt;
  const Eigen::Vector2d to_wall = wall.from_m - a.head<2>();
  const double fraction = cross(to_wall, along) / determinant;
  const double along_wall = cross(to_wall, ray) / determinant;
  if (!(fraction > 0.0 && fraction < 1.0 && along_wall >= 0.0 && along_wall <= 1.0)) return std::nullopt;
  const double z = a.z() + fraction * (b.z() - a.z());
  if (z < wall.bottom_m || z > wall.top_m) return std::nullopt;
  return fraction;
}

double knife_edge_loss_db(double clearance_m, double d1_m, double d2_m) noexcept {
  const double v = clearance_m * std::sqrt(2.0 * (d1_m + d2_m) / (kWavelength_m * d1_m * d2_m));
  if (v < -0.78) return 0.0;
  return 6.9 + 20.0 * std::log10(std::sqrt((v - 0.1) * (v - 0.1) + 1.0) + v - 0.1);
}

Site::Site(std::vector<Material> materials, std::vector<Wall> walls, const RadioClimate& climate)
    : materials_(std::move(materials)), walls_(std::move(walls)), climate_(climate) {}

bool Site::is_los(const Eigen::Vector3d& a, const Eigen::Vector3d& b) const noexcept {
  return std::none_of(walls_.begin(), walls_.end(),
                      [&](const Wall& wall) { return crossing(wall, a, b).has_value(); });
}

Site::Through Site::through(const Eigen::Vector3d& a, const Eigen::Vector3d& b, std::size_t except_wall,
                            const KeyedRandom& texture) const {
  Through sum;
  for (std::size_t i = 0; i < walls_.size(); ++i) {
    if (i == except_wall) continue;
    const std::optional<double> fraction = crossing(walls_[i], a, b);
    if (!fraction) continue;
    const Material& material = materials_[walls_[i].material];
    sum.loss_db += material.loss_db;
    if (sum.loss_db >= kOpaqueLoss_db) return sum;
    if (material.excess_m > 0.0) {
      const Eigen::Vector3d point = a + *fraction * (b - a);
      const double place_m = (point.head<2>() - walls_[i].from_m).norm();
      const double relative = 1.0 + kTextureSigma * smooth_noise(texture.of(i), place_m / kTextureLength_m,
                                                                 point.z() / kTextureLength_m);
      sum.excess_m += material.excess_m * std::max(relative, 0.1);
    }
  }
  return sum;
}

Arrival Site::arrival(const Eigen::Vector3d& a, const Eigen::Vector3d& b, double floor_m,
                      const KeyedRandom& texture) const {
  const double straight_m = std::max((b - a).norm(), 0.01);
  const auto power_after = [&](double length_m, double loss_db) {
    return climate_.power_at_1m_dbm - climate_.path_exponent * to_db(std::max(length_m, 0.1)) - loss_db;
  };

  // Collects all paths except those too weak to be detected. The detection threshold depends on the strongest
  // one.
  std::vector<Ray> rays;
  const auto keep = [&](double length_m, double loss_db, double excess_m) {
    if (loss_db >= kOpaqueLoss_db) return;
    const double power = power_after(length_m, loss_db);
    if (power < climate_.first_path_floor_dbm - 10.0) return;
    rays.push_back({length_m - straight_m + excess_m, power});
  };
  const auto keep_via = [&](const Eigen::Vector3d& by, double loss_db, std::size_t wall) {
    const double length_m = (by - a).norm() + (b - by).norm();
    if (power_after(length_m, loss_db) < climate_.first_path_floor_dbm - 10.0) return;
    const Through first = through(a, by, wall, texture);
    if (first.loss_db >= kOpaqueLoss_db) return;
    const Through second = through(by, b, wall, texture);
    keep(length_m, loss_db + first.loss_db + second.loss_db, first.excess_m + second.excess_m);
  };

  const Through direct = through(a, b, kNoWall, texture);
  Arrival arrival;
  arrival.is_los = direct.loss_db == 0.0 && direct.excess_m == 0.0;
  keep(straight_m, direct.loss_db, direct.excess_m);

  for (std::size_t i = 0; i < walls_.size(); ++i) {
    const Wall& wall = walls_[i];
    if (const std::optional<double> fraction = crossing(wall, a, b)) {
      const Eigen::Vector3d at = a + *fraction * (b - a);
      const double d1 = *fraction * straight_m;
      const double d2 = straight_m - d1;
      const Eigen::Vector2d along = (wall.to_m - wall.from_m).normalized();
      const auto bend = [&](const Eigen::Vector3d& by) {
        keep_via(by, knife_edge_loss_db((by - at).norm(), d1, d2), i);
      };
      bend(around(wall.from_m - kAroundEdge_m * along, a, b));
      bend(around(wall.to_m + kAroundEdge_m * along, a, b));
      bend({at.x(), at.y(), wall.top_m + kAroundEdge_m});
    } else if (const auto& reflection_loss_db = materials_[wall.material].reflection_loss_db) {
      const Eigen::Vector3d image = mirrored(wall, b);
      if (const std::optional<double> reflected = crossing(wall, a, image)) {
        keep_via(a + *reflected * (image - a), *reflection_loss_db, i);
      }
    }
  }
  if (climate_.floor_reflection_loss_db && a.z() > floor_m && b.z() > floor_m) {
    const double fraction = (a.z() - floor_m) / (a.z() + b.z() - 2.0 * floor_m);
    Eigen::Vector3d by = a + fraction * (b - a);
    by.z() = floor_m;
    keep_via(by, *climate_.floor_reflection_loss_db, kNoWall);
  }

  double strongest_dbm = -1e9;
  double total = 0.0;
  for (const Ray& ray : rays) {
    strongest_dbm = std::max(strongest_dbm, ray.power_dbm);
    total += from_db(ray.power_dbm);
  }
  const double threshold_dbm =
      std::max(climate_.first_path_floor_dbm, strongest_dbm - climate_.first_path_dynamic_db);
  const Ray* first = nullptr;
  for (const Ray& ray : rays) {
    if (ray.power_dbm >= threshold_dbm && (first == nullptr || ray.excess_m < first->excess_m)) first = &ray;
  }
  if (first == nullptr) return arrival;

  // Paths within the leading edge shift the timestamp, depending on their phase.
  double shift_m = 0.0;
  for (const Ray& ray : rays) {
    const double late_m = ray.excess_m - first->excess_m;
    if (&ray == first || late_m <= 0.0 || late_m > 3.0 * kLeadingEdge_m) continue;
    const double amplitude = std::min(std::sqrt(from_db(ray.power_dbm - first->power_dbm)), 1.0);
    const double overlap = std::exp(-(late_m / kLeadingEdge_m) * (late_m / kLeadingEdge_m));
    shift_m += kLeadingEdgeGain * amplitude * late_m * overlap *
               std::cos(2.0 * std::numbers::pi * late_m / kWavelength_m);
  }
  arrival.receive_power_dbm = to_db(total);
  arrival.first_path_power_dbm = first->power_dbm;
  arrival.excess_m = first->excess_m + shift_m;
  arrival.audible = arrival.receive_power_dbm >= climate_.sensitivity_dbm;
  return arrival;
}

}  // namespace groma::sim
