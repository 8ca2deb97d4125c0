// State of a CAN interface, as the kernel reports it by rtnetlink(7).
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace groma::doctor {

struct CanState {
  bool is_up = false;
  // Of the controller: "error-active", "error-warning", "error-passive", "bus-off", "stopped" or "sleeping";
  // empty: it has none, as a virtual one.
  std::string controller;
  std::uint32_t bit_per_s = 0;   // 0: not known
  std::uint32_t restart_ms = 0;  // after bus-off; 0: never
};

// From one message RTM_NEWLINK; nothing if it is none.
[[nodiscard]] std::optional<CanState> parse_can_state(std::span<const std::uint8_t> message);
// Nothing if there is no such interface, or the kernel does not answer.
[[nodiscard]] std::optional<CanState> read_can_state(const std::string& interface);

}  // namespace groma::doctor
