// A scenario's nodes at work in its world: each runs the firmware on a modelled DW1000, configured and joined
// by one schedule, and its serial line is read and written here.
#pragma once

#include <cstddef>
#include <cstdint>
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
};

// Throws sim::SimulationError where the firmware would refuse the scenario's schedule, or where a node does
// what its hardware would not bear.
class SimulatedSite {
 public:
  SimulatedSite(const sim::Scenario& scenario, const SiteOptions& options);

  // To t_s, the world's time. Returns early never.
  void run_until(double t_s);
  [[nodiscard]] double now_s() const noexcept { return sim::to_seconds(network_.now()); }

  // Tags in the order of the scenario.
  [[nodiscard]] std::size_t tag_count() const noexcept { return tags_.size(); }
  [[nodiscard]] model::NodeId tag_id(std::size_t tag) const { return tags_.at(tag).id; }
  // Appends the bytes that have left the tag's UART by now, at the line's bit rate.
  void take(std::size_t tag, std::vector<std::uint8_t>& bytes);
  // From the host to the tag. False: more than its line's queue holds; nothing was sent.
  bool send(std::size_t tag, std::span<const std::uint8_t> bytes);

  [[nodiscard]] const sim::World& world() const noexcept { return world_; }

 private:
  struct Tag {
    model::NodeId id;
    std::size_t node;
  };

  sim::World world_;
  sim::Network network_;
  std::vector<Tag> tags_;
  std::vector<sim::TimedByte> taken_;
};

}  // namespace groma::simulation
