// The serial line between a node and its host: a queue of fixed size that empties at the line's bit rate.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <span>
#include <vector>

#include "firmware/sim/time.hpp"

namespace groma::sim {

struct UartSettings {
  std::uint32_t bits_per_s = 1'000'000;
  std::size_t queue_bytes = 4096;
};

struct TimedByte {
  SimTime t = 0;  // end of the stop bit
  std::uint8_t value = 0;
};

// One direction of the line, with 10 bits per byte.
class UartLine {
 public:
  explicit UartLine(const UartSettings& settings = {});

  // Queues all bytes. Returns false and queues none if they do not fit beside the waiting ones. `now` must
  // not decrease between calls.
  bool write(SimTime now, std::span<const std::uint8_t> bytes);

  // Moves the bytes whose transmission ended by `until` to the end of `out`.
  void take(SimTime until, std::vector<TimedByte>& out);
  // The time of the first byte not yet taken, or kNever.
  [[nodiscard]] SimTime next_byte() const noexcept { return queue_.empty() ? kNever : queue_.front().t; }

  // Bytes and writes refused so far.
  [[nodiscard]] std::uint64_t overflow_bytes() const noexcept { return overflow_bytes_; }
  [[nodiscard]] std::uint64_t overflow_writes() const noexcept { return overflow_writes_; }
  [[nodiscard]] std::uint64_t accepted_bytes() const noexcept { return accepted_bytes_; }

  // Stops the line: bytes whose transmission has not ended by `now` are lost.
  void clear(SimTime now);

 private:
  UartSettings settings_;
  SimTime byte_time_;
  SimTime free_at_ = 0;
  std::deque<TimedByte> queue_;
  std::uint64_t overflow_bytes_ = 0;
  std::uint64_t overflow_writes_ = 0;
  std::uint64_t accepted_bytes_ = 0;
};

}  // namespace groma::sim
