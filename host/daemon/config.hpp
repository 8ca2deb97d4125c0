// The daemon's configuration file: YAML, schema 1, strict.
//
//   schema: 1
//   nodes:                            # the link of each tag
//     - {path: /dev/ttyACM0, baud: 1000000}   # a serial port or pseudo-terminal
//     - {serial: "000760123456"}      # the port of a USB device; see host/link/usb_port.hpp
//     - {path: tcp://10.0.0.7:4001}   # a serial server; see host/link/network_link.hpp
//     - {path: can:can0/2}            # or canfd:can0/2; see host/link/can_path.hpp
//   robot_socket: robot.sock          # JSON lines: robot_input.hpp
//                                     # or tcp://HOST:PORT
//   robot:                            # in place of robot_socket, or beside it
//     listen: [robot.sock, "udp://127.0.0.1:4723"]   # gromad serves these; one may be without brackets
//     can: can0                       # with dbc and signals: can_signals.hpp
//   tags:                             # position of each tag's antenna in base_link
//     - {id: 1, lever_arm_m: [0.3, 0.2, 0.6]}
//   odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.05, sigma_omega_radps: 0.01}
//                                     # or, for a car-like vehicle: steering: {wheelbase_m: 1.6}
//   range: {sigma_m: 0.1, beta_m: [0.3, 0.5], gamma: [1.0, 0.005]}   # beta, gamma: [mean, sigma] a pair
//   surface: {type: plane, z_m: 0.0, normal: [0, 0, 1]}              # or {type: bspline, file: surface.csv}
//   calibration: {file: calibration.yaml}       # or {drive_s: 120, output: calibration.yaml}: from a drive
//                                               # or {learn: true, file: ..., output: ...}: while driving
//   model: schmidt                              # this key and all that follow are optional
//   pose_stream: {address: 127.0.0.1, port: 4721}
//   web: {address: 127.0.0.1, port: 4722}       # counters for Prometheus at /metrics; default: none
//   ros2: {domain_id: 0}                        # topics of ROS 2; see ros2_settings.hpp
//   log: drive.glog                             # measurements are appended to this file
//   ring: {folder: ring, size_mib: 256}         # the last drive is kept in this folder, in at most that size
//   last_pose: last-pose.json                   # the next run starts from the pose in this file
//   reorder_lag_s: 0.2
//   imu: {sigma_omega_radps: 0.005, bias_sigma_radps: 0.01}  # the defaults
//   gnss: {lever_arm_m: [0.4, -0.3, 1.5]}                    # default: the origin of base_link
//   speed: 1                          # rate of the site's clocks over this computer's, as of `groma sim`
//
// Paths are relative to the file's folder, except those with a scheme such as can: or tcp:.
#pragma once

#include <cstdint>
#include <exception>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "host/daemon/can_signals.hpp"
#include "host/daemon/ros2_settings.hpp"
#include "host/daemon/tcp_listener.hpp"
#include "host/daemon/web_settings.hpp"
#include "host/filter/config.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

struct NodeLink {
  std::filesystem::path path;
  unsigned baud =
      1'000'000;  // of a CAN link: of an equally fast serial line; of a serial server: of its line
};

struct CalibrationSource {
  std::optional<std::filesystem::path> file;    // none: from a drive
  double drive_s = 0.0;                         // 0: no calibration drive
  bool learn = false;                           // calibrate while driving
  std::optional<std::filesystem::path> output;  // receives the calibration; may be the same as `file`
};

// The recording of the last drive, in a folder of its own.
struct RingSettings {
  std::filesystem::path folder;
  std::uint64_t size_mib = 256;  // at most
};

struct Config {
  std::filesystem::path path;  // of the file
  std::map<std::string, std::string>
      values;                   // each top-level key's value, with a digest of the files it names
  io::InputFiles::Texts files;  // the file, and those that it names, except the calibration
  std::vector<NodeLink> nodes;
  // At least one of these three, or ros2, is given.
  std::filesystem::path robot_socket;               // the robot's software listens there; empty: none
  std::vector<std::filesystem::path> robot_listen;  // the daemon listens there; host/link/line_listener.hpp
  std::optional<CanSignals> robot_can;
  std::vector<model::Tag> tags;
  model::OdometryNoise odometry;
  std::optional<model::Steering> steering;
  model::RangePriors range;
  model::SensorDescription sensors;
  model::Surface surface;
  CalibrationSource calibration;
  filter::Model model = filter::Config{}.model;
  Endpoint pose_stream{.address = "127.0.0.1", .port = 4721};
  std::optional<WebSettings> web;                  // none: no HTTP server
  std::optional<Ros2Settings> ros2;                // none: no ROS 2
  std::optional<std::filesystem::path> log;        // none: nothing is appended
  std::optional<RingSettings> ring;                // none: the last drive is not kept
  std::optional<std::filesystem::path> last_pose;  // none: not kept
  double reorder_lag_s = 0.2;
  double speed = 1.0;

  // Of the robot; 1 where none is given, as in a simulation.
  [[nodiscard]] std::size_t robot_links() const noexcept {
    const std::size_t given =
        robot_listen.size() + (robot_socket.empty() ? 0U : 1U) + (robot_can ? 1U : 0U) + (ros2 ? 1U : 0U);
    return given > 0 ? given : 1;
  }
  // The description of site and robot that a log holds beside its measurements.
  [[nodiscard]] std::vector<io::DescriptionFile> description() const;
  // The filter's configuration, with the sigmas of odometry and ranges.
  [[nodiscard]] filter::Config filter_config() const;
};

// An error of a configuration file, or of a file that it names.
struct ConfigProblem {
  io::FilePlace place;       // in the configuration file
  std::string text;          // "FILE:LINE:COLUMN: what; what to do"
  std::exception_ptr error;  // io::ConfigError, io::DataError or io::PermissionError
};

struct ConfigReading {
  Config config;                                // as far as it has no error
  std::map<std::string, io::FilePlace> places;  // of each top-level key's value
  std::vector<ConfigProblem> problems;          // all errors, in the order of their lines
};
// given: the texts of files that need not be on the disk.
[[nodiscard]] ConfigReading parse_config(const std::filesystem::path& path,
                                         const io::InputFiles::Texts& given = {});

// Throws the first error: io::ConfigError with the place and the remedy, also if the file does not exist;
// io::DataError or io::PermissionError if it, or a file that it names, cannot be read.
[[nodiscard]] Config read_config(const std::filesystem::path& path);

// The JSON schema of the file, from the table that the parser checks it with.
[[nodiscard]] std::string config_schema();

}  // namespace groma::daemon
