// For events that may be frequent: the log has the 1st, 2nd, 4th, 8th ... of them.
#pragma once

#include <bit>
#include <cstdint>

namespace groma::daemon {

class LogDoubling {
 public:
  // Whether this number of events is to be logged now. It never decreases.
  [[nodiscard]] bool is_due(std::uint64_t events) noexcept {
    const bool due = std::bit_width(events) != std::bit_width(noted_);
    noted_ = events;
    return due;
  }

 private:
  std::uint64_t noted_ = 0;
};

}  // namespace groma::daemon
