// The daemon's configuration file: YAML, schema 1, strict.
//
//   schema: 1
//   nodes:                            # a serial port, pseudo-terminal or node on a CAN bus for each tag
//     - {path: /dev/serial/by-id/usb-tag-1, baud: 1000000}
//     - {path: can:can0/2}            # or canfd:can0/2; see host/link/can_path.hpp
//   robot_socket: robot.sock          # JSON lines: robot_input.hpp
//   tags:                             # where each tag's antenna sits, in base_link
//     - {id: 1, lever_arm_m: [0.3, 0.2, 0.6]}
//   odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.05, sigma_omega_radps: 0.01}
//   range: {sigma_m: 0.1, beta_m: [0.3, 0.5], gamma: [1.0, 0.005]}   # the latter two as priors of a pair
//   surface: {type: plane, z_m: 0.0, normal: [0, 0, 1]}              # or {type: bspline, file: surface.csv}
//   calibration: {file: calibration.yaml}       # or {drive_s: 120, output: calibration.yaml}: learn it
//   first;
//                                               # or {learn: true, file: ..., output: ...}: as it drives
//   model: schmidt                              # optional, as are all that follow
//   pose_stream: {address: 127.0.0.1, port: 4721}
//   log: drive.glog                             # what comes in is appended there
//   reorder_lag_s: 0.2
//   imu: {sigma_omega_radps: 0.005, bias_sigma_radps: 0.01}  # these without it
//   gnss: {lever_arm_m: [0.4, -0.3, 1.5]}                    # base_link itself without it
//   speed: 1                          # of the site's clocks against this computer's: that of `groma sim`
//
// Paths are relative to the file's folder, but for those of CAN links.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/filter/config.hpp"
#include "host/io/dataset.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

struct NodeLink {
  std::filesystem::path path;
  unsigned baud = 1'000'000;  // of a CAN link, the serial line's that is as fast
};

struct CalibrationSource {
  std::optional<std::filesystem::path> file;    // none: from a drive
  double drive_s = 0.0;                         // 0: no drive of its own
  bool learn = false;                           // while driving
  std::optional<std::filesystem::path> output;  // where what was learnt is kept; may be `file`
};

struct Config {
  std::vector<NodeLink> nodes;
  std::filesystem::path robot_socket;
  std::vector<model::Tag> tags;
  model::OdometryNoise odometry;
  model::RangePriors range;
  model::SensorDescription sensors;
  model::Surface surface;
  CalibrationSource calibration;
  filter::Model model = filter::Config{}.model;
  std::string address = "127.0.0.1";
  std::uint16_t port = 4721;
  std::optional<std::filesystem::path> log;  // none: nothing is recorded
  double reorder_lag_s = 0.2;
  double speed = 1.0;

  // What a log of this site and robot tells beside its measurements.
  [[nodiscard]] std::vector<io::DescriptionFile> description() const;
  // The filter's, with the robot's and the ranges' sigmas.
  [[nodiscard]] filter::Config filter_config() const;
};

// Throws io::ConfigError with the place and the remedy, io::DataError or io::PermissionError (a file that it
// names, or itself, cannot be read).
[[nodiscard]] Config read_config(const std::filesystem::path& path);

}  // namespace groma::daemon
