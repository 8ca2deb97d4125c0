// What a CAN socket counts.
#pragma once

#include <cstdint>

namespace groma::link {

// Since the link was opened. Every link on an interface gets the controller's error frames.
struct CanCounters {
  std::uint64_t frames = 0;               // that the link reads
  std::uint64_t frames_overrun = 0;       // lost because they came faster than they were read
  std::uint64_t error_frames = 0;         // from the controller, of any kind, including those counted below
  std::uint64_t controller_overruns = 0;  // the controller's buffer was full: frames of any node are lost
  std::uint64_t error_passive = 0;        // times the controller became error-passive
  std::uint64_t bus_off = 0;
  std::uint64_t restarts = 0;  // after bus-off

  CanCounters& operator+=(const CanCounters& other) noexcept {
    frames += other.frames;
    frames_overrun += other.frames_overrun;
    error_frames += other.error_frames;
    controller_overruns += other.controller_overruns;
    error_passive += other.error_passive;
    bus_off += other.bus_off;
    restarts += other.restarts;
    return *this;
  }
};

}  // namespace groma::link
