// A simulated site and the daemon's input path, coupled by real pseudo-terminals on the site's clock: the
// simulation goes on only when every byte that left a tag has been read, so that a seed gives one result on
// any machine.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "firmware/sim/world/scenario.hpp"
#include "host/daemon/session.hpp"
#include "host/link/byte_link.hpp"
#include "host/simulation/pty_port.hpp"
#include "host/simulation/robot_feed.hpp"
#include "host/simulation/simulated_site.hpp"

namespace groma::simulation {

class LockStep {
 public:
  // As a host polls that has other work to do: bytes reach the session up to this much late.
  static constexpr double kStep_s = 0.002;

  // Throws io::DeviceError or sim::SimulationError.
  LockStep(const sim::Scenario& scenario, const SiteOptions& options);

  // Throws io::DeviceError where bytes get lost in the system, and sim::SimulationError.
  void run_until(double t_s);

  [[nodiscard]] SimulatedSite& site() noexcept { return site_; }
  [[nodiscard]] daemon::Session& session() noexcept { return session_; }

 private:
  struct Tag {
    PtyPort port;
    std::unique_ptr<link::ByteLink> link;
    std::size_t node = 0;  // of the session
  };
  void pass_through(Tag& tag, double now_s);

  SimulatedSite site_;
  RobotFeed robot_;
  daemon::Session session_;
  std::vector<Tag> tags_;
  std::uint64_t steps_ = 0;
  std::vector<std::uint8_t> bytes_;
  std::string lines_;
};

}  // namespace groma::simulation
