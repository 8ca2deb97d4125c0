#include "firmware/sim/can_log.hpp"

#include <array>
#include <cstdio>

namespace groma::sim {

namespace {

template <class... Values>
void append(std::string& out, const char* format, Values... values) {
  std::array<char, 64> text{};
  const int size = std::snprintf(text.data(), text.size(), format, values...);
  out.append(text.data(), static_cast<std::size_t>(size));
}

}  // namespace

std::string candump_line(const TimedCanFrame& timed, const std::string& interface) {
  const auto t_us = static_cast<long long>(timed.t / kUnitsPerMicrosecond);
  std::string line;
  append(line, "(%lld.%06lld) ", t_us / 1'000'000, t_us % 1'000'000);
  line += interface;
  append(line, " %08X#", static_cast<unsigned>(timed.frame.id));
  if (timed.frame.format == wire::CanFormat::kFd) line += timed.frame.bit_rate_switch ? "#1" : "#0";
  for (const std::uint8_t byte : timed.frame.payload()) append(line, "%02X", static_cast<unsigned>(byte));
  line += '\n';
  return line;
}

void write_candump(std::ostream& out, std::span<const TimedCanFrame> frames, const std::string& interface) {
  for (const TimedCanFrame& frame : frames) out << candump_line(frame, interface);
}

}  // namespace groma::sim
