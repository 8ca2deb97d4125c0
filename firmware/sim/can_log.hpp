// CAN frames as text, in the format of can-utils' candump -L, which canplayer and others read:
//
//   (12.345678) can0 16000003#0011223344556677      classic
//   (12.345678) can0 16000003##1001122...           CAN FD; the digit after ## is 1 with a bit-rate switch
#pragma once

#include <ostream>
#include <span>
#include <string>

#include "firmware/sim/can_bus.hpp"

namespace groma::sim {

// One line with its newline.
[[nodiscard]] std::string candump_line(const TimedCanFrame& frame, const std::string& interface = "can0");

void write_candump(std::ostream& out, std::span<const TimedCanFrame> frames,
                   const std::string& interface = "can0");

}  // namespace groma::sim
