// Walls, racks and the floor, and their effects on a radio pulse: attenuation, delay, reflection,
// diffraction.
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
  double loss_db = 10.0;                     // of a ray through it; opaque from kOpaqueLoss_db
  double excess_m = 0.1;                     // mean delay of a ray through it, times c
  std::optional<double> reflection_loss_db;  // nullopt: no reflection
};

inline constexpr double kOpaqueLoss_db = 60.0;

// A vertical rectangle above the segment from_m to to_m.
struct Wall {
  Eigen::Vector2d from_m = Eigen::Vector2d::Zero();
  Eigen::Vector2d to_m = Eigen::Vector2d::UnitX();
  double bottom_m = 0.0;
  double top_m = 3.0;
  std::size_t material = 0;
};

// Where the open segment a-b crosses the wall: the fraction of its length from a, in (0, 1); nullopt:
// nowhere.
[[nodiscard]] std::optional<double> crossing(const Wall& wall, const Eigen::Vector3d& a,
                                             const Eigen::Vector3d& b) noexcept;

// Diffraction loss at an edge at the distance clearance_m from the straight line, d1 and d2 from its ends
// (ITU-R P.526, single knife edge), on channel 5.
[[nodiscard]] double knife_edge_loss_db(double clearance_m, double d1_m, double d2_m) noexcept;

struct RadioClimate {
  double power_at_1m_dbm = -59.0;        // received at 1 m: transmit power, both antennas, path loss
  double path_exponent = 2.0;            // path-loss exponent
  double sensitivity_dbm = -94.0;        // a weaker frame is not received
  double first_path_floor_dbm = -102.0;  // a weaker path is not detected, nor is one that is ...
  double first_path_dynamic_db = 22.0;   // ... weaker than the strongest by more than this
  std::optional<double> floor_reflection_loss_db = 9.0;
};

// One pulse at the receiver.
struct Arrival {
  bool audible = false;
  bool is_los = false;    // LOS: the straight line crosses no wall
  double excess_m = 0.0;  // length of the first detected path minus the straight line
  double first_path_power_dbm = 0.0;
  double receive_power_dbm = 0.0;
};

class Site {
 public:
  Site() = default;
  // Precondition: each wall's material is an index into materials.
  Site(std::vector<Material> materials, std::vector<Wall> walls, const RadioClimate& climate);

  // LOS between a and b.
  [[nodiscard]] bool is_los(const Eigen::Vector3d& a, const Eigen::Vector3d& b) const noexcept;

  // Traces the direct path, diffraction at the edges of each wall that it crosses, and one reflection at each
  // other wall and at the floor (at height floor_m). The first path is the earliest one that can be detected.
  // `texture`: random numbers for the variation of a material's delay within a wall, one set per pair.
  [[nodiscard]] Arrival arrival(const Eigen::Vector3d& a, const Eigen::Vector3d& b, double floor_m,
                                const KeyedRandom& texture) const;

  [[nodiscard]] const std::vector<Wall>& walls() const noexcept { return walls_; }
  [[nodiscard]] const std::vector<Material>& materials() const noexcept { return materials_; }

 private:
  struct Through {
    double loss_db = 0.0;
    double excess_m = 0.0;
  };
  [[nodiscard]] Through through(const Eigen::Vector3d& a, const Eigen::Vector3d& b, std::size_t except_wall,
                                const KeyedRandom& texture) const;

  std::vector<Material> materials_;
  std::vector<Wall> walls_;
  RadioClimate climate_;
};

}  // namespace groma::sim
