// A scenario's nodes running in its world: each runs the firmware on a modelled DW1000 and is configured for
// the scenario's schedule. This class reads and writes the nodes' serial lines.
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
  std::uint64_t seed = 1;  // determines the world, crystals, counters, power-on times and the radio's noise
  // The image that each node runs on an emulated processor; none: the firmware compiled in.
  std::shared_ptr<const sim::FirmwareImage> image{};
  sim::EmulatorOptions emulator{};
  // Nodes are flashed but not configured, as new ones; then anchors have ports, too.
  bool unconfigured = false;
  // Creates the host of a node with this specification, instead of both kinds above; may be empty.
  std::function<std::unique_ptr<sim::NodeHost>(const sim::NodeSpec& spec, sim::Medium& medium)> make_node{};
};

// Throws sim::SimulationError if the firmware would reject the scenario's schedule, or if a node does
// something that its hardware does not allow.
class SimulatedSite {
 public:
  SimulatedSite(const sim::Scenario& scenario, const SiteOptions& options);

  // Runs to t_s, the world's time. Never returns early.
  void run_until(double t_s);
  [[nodiscard]] double now_s() const noexcept { return sim::to_seconds(network_.now()); }

  // Serial ports in the order of the scenario, tags first: "tag-1" and so on.
  [[nodiscard]] std::size_t port_count() const noexcept { return ports_.size(); }
  [[nodiscard]] const std::string& port_name(std::size_t port) const { return ports_.at(port).name; }
  // Appends the bytes that the node's UART has sent up to now_s(), at the line's bit rate.
  void take(std::size_t port, std::vector<std::uint8_t>& bytes);
  // Sends bytes from the host to the node. False: they exceed the line's queue, and nothing was sent.
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
