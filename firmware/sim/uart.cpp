#include "firmware/sim/uart.hpp"

#include <algorithm>

namespace groma::sim {

UartLine::UartLine(const UartSettings& settings)
    : settings_(settings), byte_time_(10 * kUnitsPerSecond / static_cast<SimTime>(settings.bits_per_s)) {}

bool UartLine::write(SimTime now, std::span<const std::uint8_t> bytes) {
  const SimTime busy = std::max<SimTime>(free_at_ - now, 0);
  const auto waiting = static_cast<std::size_t>((busy + byte_time_ - 1) / byte_time_);
  if (waiting + bytes.size() > settings_.queue_bytes) {
    overflow_bytes_ += bytes.size();
    ++overflow_writes_;
    return false;
  }
  SimTime t = std::max(free_at_, now);
  for (const std::uint8_t byte : bytes) {
    t += byte_time_;
    queue_.push_back({t, byte});
  }
  free_at_ = t;
  accepted_bytes_ += bytes.size();
  return true;
}

void UartLine::take(SimTime until, std::vector<TimedByte>& out) {
  while (!queue_.empty() && queue_.front().t <= until) {
    out.push_back(queue_.front());
    queue_.pop_front();
  }
}

void UartLine::clear(SimTime now) {
  while (!queue_.empty() && queue_.back().t > now) queue_.pop_back();
  free_at_ = std::min(free_at_, now);
}

}  // namespace groma::sim
