// A scenario's nodes at work in its world: each runs the firmware on a modelled DW1000, configured and joined
// by one schedule, and its serial line is read and written here.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/emulator/emulated_node.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/network.hpp"
#include "firmware/sim/world/scenario.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/model/types.hpp"

namespace groma::simulation {

struct SiteOptions {
  std::uint64_t seed = 1;  // crystals, counters and power-on times are drawn from it
  // What each node runs, instruction by instruction; none: the firmware compiled in.
  std::shared_ptr<const sim::FirmwareImage> image{};
  sim::EmulatorOptions emulator{};
  // Nodes as they come out of the box: flashed, not configured; then anchors have ports, too.
  bool unconfigured = false;
  // In the place of both kinds of node, what runs one of this specification; empty: see above.
  std::function<std::unique_ptr<sim::NodeHost>(const sim::NodeSpec& spec, sim::Medium& medium)> make_node{};
};

// Throws sim::SimulationError where the firmware would refuse the scenario's schedule, or where a node does
// what its hardware would not bear.
class SimulatedSite {
 public:
  SimulatedSite(const sim::Scenario& scenario, const SiteOptions& options);

  // To t_s, the world's time. Returns early never.
  void run_until(double t_s);
  [[nodiscard]] double now_s() const noexcept { return sim::to_seconds(network_.now()); }

  // Serial ports in the order of the scenario, tags first: "tag-1" and so on.
  [[nodiscard]] std::size_t port_count() const noexcept { return ports_.size(); }
  [[nodiscard]] const std::string& port_name(std::size_t port) const { return ports_.at(port).name; }
  // Appends the bytes that have left the node's UART by now, at the line's bit rate.
  void take(std::size_t port, std::vector<std::uint8_t>& bytes);
  // From the host to the node. False: more than its line's queue holds; nothing was sent.
  bool send(std::size_t port, std::span<const std::uint8_t> bytes);

  [[nodiscard]] const sim::World& world() const noexcept { return world_; }

 private:
  struct Port {
    std::string name;
    std::size_t node;
  };

  sim::World world_;
  sim::Network network_;
  std::vector<Port> ports_;
  std::vector<sim::TimedByte> taken_;
};

}  // namespace groma::simulation
