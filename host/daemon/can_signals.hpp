// Odometry and IMU in the frames of the robot's own CAN bus, as a DBC file describes them.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include "host/io/dbc.hpp"
#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"

namespace groma::daemon {

// The quantities, in the order of CanSignals::used.
inline constexpr std::size_t kCanQuantities = 4;
inline constexpr std::array<std::string_view, kCanQuantities> kCanQuantityNames{
    "vx_mps", "vy_mps", "omega_radps", "imu_omega_radps"};
inline constexpr std::size_t kCanImu = 3;  // the other three are odometry

struct CanSignal {
  std::string name;      // MESSAGE.SIGNAL
  std::uint32_t id = 0;  // of the message: can_id of Linux
  io::DbcSignal signal;
  std::optional<io::DbcSignal> multiplexor;  // of the message; the signal is in some of its frames only
  double scale = 1.0;                        // SI units in one unit of the DBC file
};

struct CanSignals {
  std::string interface;
  std::array<std::optional<CanSignal>, kCanQuantities> used;  // vx and omega are always there
};

// Reads the map
//   {can: can0, dbc: robot.dbc, signals: {vx_mps: Drive.Speed, omega_radps: {signal: Drive.YawRate, scale:
//   0.0175}}}
// with the DBC file relative to `folder`. vy_mps and imu_omega_radps are optional. Throws io::ConfigError if
// the DBC file does not contain a signal, or its unit is not the SI unit and `scale` does not convert it;
// io::DataError or io::PermissionError if the DBC file cannot be read.
[[nodiscard]] CanSignals parse_can_signals(const io::YamlValue& yaml, const std::filesystem::path& folder,
                                           io::InputFiles& files);

}  // namespace groma::daemon
