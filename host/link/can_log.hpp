// Logs of a CAN bus as candump writes them (can-utils: `candump -l` and `candump -L`), a line a frame:
//
//   (1436509052.249713) can0 16000003#0102030405060708
//   (1436509052.250013) can0 16000003##1000102030405060708090A0B
//
// time in seconds; interface; id, of 8 digits where it has 29 bits and of 3 where it has 11; with ## a digit
// of flags (1: the data had its own bit rate) and a payload of CAN FD.
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
  // Nothing where the line is not intact, or tells of what this protocol never uses: an id of 11 bits, a
  // remote or an error frame.
  std::optional<LoggedCanFrame> frame;
};

[[nodiscard]] CanLogLine parse_candump_line(std::string_view line);

struct CanLog {
  std::vector<LoggedCanFrame> frames;
  LinkError error;  // names the file, and the line that is none
};

[[nodiscard]] CanLog read_candump_log(const std::filesystem::path& path);

}  // namespace groma::link
