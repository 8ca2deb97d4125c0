#include "proto/can_segment.hpp"

namespace groma::wire {

std::size_t cut_can_payload(std::span<const std::uint8_t> stream, CanFormat format, CanFrame& out) noexcept {
  const std::size_t longest = max_can_payload(format);
  const std::size_t taken = stream.size() < longest ? stream.size() : longest;
  out.format = format;
  out.bit_rate_switch = format == CanFormat::kFd;
  out.size = kCanLengths[can_length_code(taken)];
  for (std::size_t i = 0; i < taken; ++i) out.data[i] = stream[i];
  for (std::size_t i = taken; i < out.size; ++i) out.data[i] = 0;
  return taken;
}

}  // namespace groma::wire
