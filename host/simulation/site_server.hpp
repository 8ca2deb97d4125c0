// A simulated site that runs in real time, or faster, for others to connect to: in a folder, a serial port
// for each tag (tag-1 and so on; and anchors, if they come unconfigured) and a socket with the robot's
// odometry and pose priors (robot.sock).
#pragma once

#include <csignal>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "firmware/sim/world/scenario.hpp"
#include "host/io/descriptor.hpp"
#include "host/simulation/pty_port.hpp"
#include "host/simulation/robot_feed.hpp"
#include "host/simulation/simulated_site.hpp"

namespace groma::simulation {

// A Unix socket that gives every client the same lines, from when it connects on.
class LineServer {
 public:
  // Throws io::DeviceError or io::PermissionError. A socket that is there already and that nobody serves is
  // replaced.
  explicit LineServer(std::filesystem::path path);
  ~LineServer();
  LineServer(const LineServer&) = delete;
  LineServer& operator=(const LineServer&) = delete;

  // Takes in who waits, and gives the lines to all. A client that does not read is cut off.
  void give(const std::string& lines);

  [[nodiscard]] std::size_t clients() const noexcept { return clients_.size(); }

 private:
  std::filesystem::path path_;
  io::Descriptor listening_;
  std::vector<io::Descriptor> clients_;
};

class SiteServer {
 public:
  struct Options {
    SiteOptions site{};
    double speed = 1.0;  // simulated seconds a second
    std::filesystem::path folder;
  };

  // Makes the folder and its files; the destructor removes what it made. Throws what SimulatedSite and
  // PtyPort throw, io::PathError and io::PermissionError where the folder cannot be had.
  SiteServer(const sim::Scenario& scenario, const Options& options);
  ~SiteServer();
  SiteServer(const SiteServer&) = delete;
  SiteServer& operator=(const SiteServer&) = delete;

  // Until `stop` is set, or for simulated_s if that is above 0. Where the machine is too slow it falls behind
  // and says so by behind_s().
  void run(const volatile std::sig_atomic_t& stop, double simulated_s = 0.0);

  // The serial ports that it serves.
  [[nodiscard]] const std::vector<std::filesystem::path>& ports() const noexcept { return links_; }
  [[nodiscard]] double now_s() const noexcept { return site_.now_s(); }
  // How much later than asked for it went, all together.
  [[nodiscard]] double behind_s() const noexcept { return behind_s_; }

 private:
  void step(double t_s);

  SimulatedSite site_;
  RobotFeed feed_;
  double speed_;
  std::filesystem::path folder_;
  bool made_folder_ = false;
  std::vector<PtyPort> ports_;
  std::vector<std::filesystem::path> links_;
  LineServer robot_;
  double behind_s_ = 0.0;
  std::vector<std::uint8_t> bytes_;
  std::string lines_;
};

}  // namespace groma::simulation
