// A simulated site that runs in real time, or faster, for other programs to connect to. In a folder it
// provides a serial port for each tag (tag-1 and so on; also for anchors, if nodes are unconfigured) and a
// socket with the robot's odometry and pose priors (robot.sock).
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

// A Unix socket that sends the same lines to every client from when it connects.
class LineServer {
 public:
  // Throws io::DeviceError, io::PermissionError or, if the path is too long, io::PathError. An existing
  // socket that no program serves is replaced.
  explicit LineServer(std::filesystem::path path);
  ~LineServer();
  LineServer(const LineServer&) = delete;
  LineServer& operator=(const LineServer&) = delete;

  // Accepts waiting clients and sends the lines to all clients. A client that does not read is disconnected.
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
    double speed = 1.0;  // simulated seconds per second
    std::filesystem::path folder;
  };

  // Creates the folder and its files; the destructor removes them. Throws what SimulatedSite, PtyPort and
  // LineServer throw, and io::PathError or io::PermissionError if the folder cannot be created.
  SiteServer(const sim::Scenario& scenario, const Options& options);
  ~SiteServer();
  SiteServer(const SiteServer&) = delete;
  SiteServer& operator=(const SiteServer&) = delete;

  // Runs until `stop` is set, or for simulated_s seconds if that is above 0. If the machine is too slow, the
  // site falls behind by behind_s().
  void run(const volatile std::sig_atomic_t& stop, double simulated_s = 0.0);

  // Paths of the serial ports.
  [[nodiscard]] const std::vector<std::filesystem::path>& ports() const noexcept { return links_; }
  [[nodiscard]] double now_s() const noexcept { return site_.now_s(); }
  // Total delay against the requested speed, in wall-clock seconds.
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
