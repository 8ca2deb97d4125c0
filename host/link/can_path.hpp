// How links over CAN are named, where others have the path of a device:
//
//   can:can0/3             node 3 on the interface can0, classic CAN
//   canfd:can0/3           the same with CAN FD; classic frames are taken too
//   can-log:drive.log/3    what node 3 said, out of a log that `candump -l` wrote
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

// Whether it is meant as the path of a SocketCAN link, rightly or not.
[[nodiscard]] bool is_can_path(std::string_view path) noexcept;
// Nothing where an interface's name or a node's id is missing, or is none.
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

// The bit rate of a serial line, with 10 bits to a byte, that carries as many bytes a second as full frames
// of this format do at 1 Mbit/s and, with CAN FD, 2 Mbit/s for the data. A classic frame of 8 bytes has 131
// bits and stuffing, an FD frame of 64 some 48 and 570.
[[nodiscard]] constexpr unsigned equivalent_baud(wire::CanFormat format) noexcept {
  return format == wire::CanFormat::kFd ? 1'900'000 : 580'000;
}

}  // namespace groma::link
