// A running scenario: the positions of all nodes at any time, and how a frame propagates between two nodes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <vector>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/propagation.hpp"
#include "firmware/sim/world/robot.hpp"
#include "firmware/sim/world/scenario.hpp"
#include "firmware/sim/world/site.hpp"

namespace groma::sim {

// The true bias of one unordered pair of a tag and an anchor.
struct TrueBias {
  double beta_m = 0.0;
  double gamma = 1.0;
};

// The time interval of one of the scenario's drives.
struct DriveTime {
  std::string name;
  double begin_s = 0.0;
  double end_s = 0.0;
};

// Not thread-safe: calls for the same instant share the robot's pose.
class World final : public PropagationModel {
 public:
  World(const Scenario& scenario, std::uint64_t seed);

  [[nodiscard]] Propagation between(std::uint16_t transmitter, std::uint16_t receiver,
                                    double t_s) const override;
  // LOS between the two nodes; false for an unknown id.
  [[nodiscard]] bool is_los(std::uint16_t a, std::uint16_t b, double t_s) const;
  // An antenna's position in the map frame; nullopt: the scenario has no such node.
  [[nodiscard]] std::optional<Eigen::Vector3d> antenna_m(std::uint16_t id, double t_s) const;
  [[nodiscard]] TrueBias bias(std::uint16_t a, std::uint16_t b) const;

  [[nodiscard]] const Robot& robot() const noexcept { return robot_; }
  [[nodiscard]] const Site& site() const noexcept { return site_; }
  [[nodiscard]] const std::vector<DriveTime>& drives() const noexcept { return drives_; }

 private:
  struct Node {
    bool on_robot;
    Eigen::Vector3d place_m;  // lever arm of a tag (base_link), position of an anchor (map)
  };
  [[nodiscard]] const Node* find(std::uint16_t id) const;
  [[nodiscard]] Eigen::Vector3d antenna_m(const Node& node, double t_s) const;

  Robot robot_;
  Site site_;
  BiasOptions bias_options_;
  KeyedRandom random_;
  std::map<std::uint16_t, Node> nodes_;
  std::vector<DriveTime> drives_;
  mutable double pose_t_s_;
  mutable model::RigidPose pose_;
  mutable std::map<std::uint32_t, Propagation> between_anchors_;  // a cache: anchors are stationary
};

}  // namespace groma::sim
