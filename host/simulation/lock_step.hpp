// A simulated site and the daemon's input path, coupled by real pseudo-terminals and driven by the site's
// clock. The simulation continues only after every byte that a tag sent has been read, so that a seed gives
// the same result on any machine.
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
  // Polling interval of a host with other work to do: bytes reach the session with up to this delay.
  static constexpr double kStep_s = 0.002;

  // Throws io::DeviceError or sim::SimulationError.
  LockStep(const sim::Scenario& scenario, const SiteOptions& options);

  // Throws io::DeviceError if the operating system loses bytes, and sim::SimulationError.
  void run_until(double t_s);

  [[nodiscard]] SimulatedSite& site() noexcept { return site_; }
  [[nodiscard]] daemon::Session& session() noexcept { return session_; }

 private:
  struct Tag {
    PtyPort port;
    std::unique_ptr<link::ByteLink> link;
    std::size_t node = 0;  // index in the session
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
