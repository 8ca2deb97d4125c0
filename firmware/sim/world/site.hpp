// Walls, racks and the floor, and what they do to a radio pulse: block it, delay it, reflect it, bend it.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {

struct Material {
  std::string name;
  double loss_db = 10.0;  // of a ray through it; kOpaqueLoss_db and more lets nothing through
  double excess_m = 0.1;  // by which a ray through it comes late, on the average
  std::optional<double> reflection_loss_db;  // none: it reflects nothing worth hearing
};

inline constexpr double kOpaqueLoss_db = 60.0;

// A vertical rectangle over the segment from-to.
struct Wall {
  Eigen::Vector2d from_m = Eigen::Vector2d::Zero();
  Eigen::Vector2d to_m = Eigen::Vector2d::UnitX();
  double bottom_m = 0.0;
  double top_m = 3.0;
  std::size_t material = 0;
};

// Where the open segment a-b passes through a wall: the fraction of its way from a, in (0, 1).
[[nodiscard]] std::optional<double> crossing(const Wall& wall, const Eigen::Vector3d& a,
                                             const Eigen::Vector3d& b) noexcept;

// Loss of a ray bent over an edge that stands out by clearance_m from the straight way, d1 and d2 from its
// ends (ITU-R P.526, single knife edge), at channel 5.
[[nodiscard]] double knife_edge_loss_db(double clearance_m, double d1_m, double d2_m) noexcept;

struct RadioClimate {
  double power_at_1m_dbm = -59.0;        // transmit power, both antennas and the first metre
  double path_exponent = 2.0;            // of the power over distance
  double sensitivity_dbm = -94.0;        // a weaker frame is not heard
  double first_path_floor_dbm = -102.0;  // a weaker first path is not seen, nor one that is ...
  double first_path_dynamic_db = 22.0;   // ... so much weaker than the strongest
  std::optional<double> floor_reflection_loss_db = 9.0;
};

// How one pulse arrives.
struct Arrival {
  bool audible = false;
  bool in_sight = false;  // nothing stands in the straight way
  double excess_m = 0.0;  // the way of the first path that is seen, minus the straight way
  double first_path_power_dbm = 0.0;
  double receive_power_dbm = 0.0;
};

class Site {
 public:
  Site() = default;
  // Each wall's material is an index into materials: the caller sees to it.
  Site(std::vector<Material> materials, std::vector<Wall> walls, const RadioClimate& climate);

  [[nodiscard]] bool in_sight(const Eigen::Vector3d& a, const Eigen::Vector3d& b) const noexcept;

  // Traces the straight way, one bend at each wall that it crosses, and one reflection at each wall and the
  // floor (at height floor_m); the first path is the earliest that can be seen. `texture` keys what no map
  // tells: how much the inside of a wall delays at the place where this pair's ray goes through.
  [[nodiscard]] Arrival arrival(const Eigen::Vector3d& a, const Eigen::Vector3d& b, double floor_m,
                                const KeyedRandom& texture) const;

  [[nodiscard]] const std::vector<Wall>& walls() const noexcept { return walls_; }
  [[nodiscard]] const std::vector<Material>& materials() const noexcept { return materials_; }

 private:
  struct Through {
    double loss_db = 0.0;
    double excess_m = 0.0;
  };
  [[nodiscard]] Through through(const Eigen::Vector3d& a, const Eigen::Vector3d& b, std::size_t but_wall,
                                const KeyedRandom& texture) const;

  std::vector<Material> materials_;
  std::vector<Wall> walls_;
  RadioClimate climate_;
};

}  // namespace groma::sim
