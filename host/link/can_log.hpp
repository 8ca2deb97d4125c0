// Reads the CAN logs that candump writes (can-utils: `candump -l` and `candump -L`), one frame a line:
//
//   (1436509052.249713) can0 16000003#0102030405060708
//   (1436509052.250013) can0 16000003##1000102030405060708090A0B
//
// Time in seconds; interface; id of 8 digits (29 bits) or 3 digits (11 bits). ## marks CAN FD: a digit of
// flags (1: bit rate switch) and the payload follow.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/link/byte_link.hpp"
#include "proto/can_segment.hpp"

namespace groma::link {

struct LoggedCanFrame {
  double t_s = 0.0;
  std::string interface;
  wire::CanFrame frame;
};

struct CanLogLine {
  bool intact = false;
  // None if the line is not intact, or holds a frame that this protocol never uses: an 11-bit id, a remote or
  // an error frame.
  std::optional<LoggedCanFrame> frame;
};

[[nodiscard]] CanLogLine parse_candump_line(std::string_view line);

struct CanLog {
  std::vector<LoggedCanFrame> frames;
  LinkError error;  // names the file and the invalid line
};

[[nodiscard]] CanLog read_candump_log(const std::filesystem::path& path);

}  // namespace groma::link
