#include "firmware/sim/world/world.hpp"

#include <algorithm>
#include <limits>
#include <utility>

namespace groma::sim {

namespace {

enum WorldPurpose : std::uint64_t { kRobot = 0x576F, kBeta, kGamma, kTexture };

constexpr double kShortestFlight_m = 0.05;

constexpr double kStopBetweenDrives_s = 2.0;

// A key that does not depend on the order of the two ids.
std::uint32_t pair_key(std::uint16_t a, std::uint16_t b) {
  return (static_cast<std::uint32_t>(std::min(a, b)) << 16) | std::max(a, b);
}

}  // namespace

std::vector<Waypoint> joined(const std::vector<DriveLeg>& drives) {
  std::vector<Waypoint> all;
  for (const DriveLeg& drive : drives) {
    if (!all.empty()) all.back().stop_s = std::max(all.back().stop_s, kStopBetweenDrives_s);
    all.insert(all.end(), drive.waypoints.begin(), drive.waypoints.end());
  }
  return all;
}

World::World(const Scenario& scenario, std::uint64_t seed)
    : robot_(scenario.ground, Path(joined(scenario.drives), scenario.path), scenario.odometry,
             scenario.pose_prior, KeyedRandom(seed).of(kRobot)),
      site_(scenario.materials, scenario.walls, scenario.climate),
      bias_options_(scenario.biases),
      random_(seed),
      pose_t_s_(std::numeric_limits<double>::quiet_NaN()) {
  for (const model::Anchor& anchor : scenario.anchors) nodes_[anchor.id] = {false, anchor.position_m};
  for (const model::Tag& tag : scenario.tags) nodes_[tag.id] = {true, tag.lever_arm_m};

  const std::vector<double>& passes_s = robot_.path().waypoint_times_s();
  std::size_t last = 0;
  double begin_s = 0.0;
  for (const DriveLeg& drive : scenario.drives) {
    last += drive.waypoints.size();
    const bool final = &drive == &scenario.drives.back();
    const double end_s = final ? robot_.path().duration_s() : passes_s[last - 1];
    drives_.push_back({drive.name, begin_s, end_s});
    begin_s = end_s;
  }
}

const World::Node* World::find(std::uint16_t id) const {
  const auto found = nodes_.find(id);
  return found == nodes_.end() ? nullptr : &found->second;
}

Eigen::Vector3d World::antenna_m(const Node& node, double t_s) const {
  if (!node.on_robot) return node.place_m;
  if (t_s != pose_t_s_) {
    pose_ = robot_.pose(t_s).pose;
    pose_t_s_ = t_s;
  }
  return pose_.position_m + pose_.rotation * node.place_m;
}

std::optional<Eigen::Vector3d> World::antenna_m(std::uint16_t id, double t_s) const {
  const Node* node = find(id);
  if (node == nullptr) return std::nullopt;
  return antenna_m(*node, t_s);
}

bool World::is_los(std::uint16_t a, std::uint16_t b, double t_s) const {
  const Node* first = find(std::min(a, b));
  const Node* second = find(std::max(a, b));
  return first != nullptr && second != nullptr &&
         site_.is_los(antenna_m(*first, t_s), antenna_m(*second, t_s));
}

TrueBias World::bias(std::uint16_t a, std::uint16_t b) const {
  const Node* first = find(a);
  const Node* second = find(b);
  if (first == nullptr || second == nullptr || first->on_robot == second->on_robot) return {};
  const std::uint32_t pair = pair_key(a, b);
  TrueBias bias;
  const KeyedRandom draws = random_.of(kBeta, pair);
  for (std::uint64_t attempt = 0;; ++attempt) {
    bias.beta_m = draws.of(attempt).normal(bias_options_.beta_m.mean, bias_options_.beta_m.sigma);
    if (bias.beta_m >= bias_options_.beta_min_m && bias.beta_m <= bias_options_.beta_max_m) break;
  }
  bias.gamma = random_.of(kGamma, pair).normal(bias_options_.gamma.mean, bias_options_.gamma.sigma);
  return bias;
}

Propagation World::between(std::uint16_t transmitter, std::uint16_t receiver, double t_s) const {
  // Computed from the lower id to the higher: both directions get bit-identical results.
  const Node* first = find(std::min(transmitter, receiver));
  const Node* second = find(std::max(transmitter, receiver));
  if (first == nullptr || second == nullptr || first == second) return {};
  const std::uint32_t pair = pair_key(transmitter, receiver);
  const bool still = !first->on_robot && !second->on_robot;
  if (still) {
    const auto known = between_anchors_.find(pair);
    if (known != between_anchors_.end()) return known->second;
  }
  const Eigen::Vector3d a = antenna_m(*first, t_s);
  const Eigen::Vector3d b = antenna_m(*second, t_s);
  const Eigen::Vector3d middle = 0.5 * (a + b);
  const Arrival arrival =
      site_.arrival(a, b, robot_.ground().at(middle.x(), middle.y()).z_m, random_.of(kTexture, pair));

  Propagation out;
  out.audible = arrival.audible;
  if (arrival.audible) {
    const TrueBias bias = this->bias(transmitter, receiver);
    out.flight_m = std::max(bias.gamma * (b - a).norm() + bias.beta_m + arrival.excess_m, kShortestFlight_m);
    out.receive_power_dbm = arrival.receive_power_dbm;
    out.first_path_power_dbm = arrival.first_path_power_dbm;
  }
  if (still) between_anchors_[pair] = out;
  return out;
}

}  // namespace groma::sim
