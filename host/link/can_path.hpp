// The paths of links over CAN, used in place of a device path:
//
//   can:can0/3             node 3 on the interface can0, classic CAN
//   canfd:can0/3           the same with CAN FD; classic frames are received too
//   can-log:drive.log/3    the frames from node 3 in a log that `candump -l` wrote
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

#include "proto/can_segment.hpp"

namespace groma::link {

struct CanPath {
  wire::CanFormat format = wire::CanFormat::kClassic;
  std::string interface;
  std::uint16_t node = 0;
};

// Whether the path starts with can: or canfd:, valid or not.
[[nodiscard]] bool is_can_path(std::string_view path) noexcept;
// Nothing if the interface's name or the node's id is missing or invalid.
[[nodiscard]] std::optional<CanPath> parse_can_path(std::string_view path);
inline constexpr std::string_view kCanPathAdvice =
    "write it as can:INTERFACE/NODE or canfd:INTERFACE/NODE, such as can:can0/3, the node's id from 0 to "
    "65535";

struct CanLogPath {
  std::string file;
  std::uint16_t node = 0;
};

[[nodiscard]] bool is_can_log_path(std::string_view path) noexcept;
[[nodiscard]] std::optional<CanLogPath> parse_can_log_path(std::string_view path);

// The bit rate in bit/s of a serial line (10 bits a byte) that carries as many bytes a second as full
// frames of this format at 1 Mbit/s and, with CAN FD, 2 Mbit/s for the data. A classic frame of 8 bytes
// takes 131 bits plus stuffing; an FD frame of 64 bytes takes about 48 bits at the first rate and 570 at
// the second.
[[nodiscard]] constexpr unsigned equivalent_baud(wire::CanFormat format) noexcept {
  return format == wire::CanFormat::kFd ? 1'900'000 : 580'000;
}

}  // namespace groma::link
