#include "firmware/sim/transmitter.hpp"

#include <algorithm>
#include <memory>

#include "firmware/sim/dw1000_air_time.hpp"
#include "firmware/sim/frame_check.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

void Transmitter::send(SimTime at, std::span<const std::uint8_t> bytes, const AirFormat& format) {
  auto frame = std::make_shared<AirFrame>();
  if (bytes.size() + 2 > frame->data.size()) throw SimulationError("a frame has at most 125 bytes");
  frame->source = station_;
  frame->number = ++frames_sent_;
  frame->format = format;
  frame->length = static_cast<std::uint16_t>(bytes.size() + 2);
  std::copy(bytes.begin(), bytes.end(), frame->data.begin());
  const std::uint16_t check = frame_check(bytes);
  frame->data[bytes.size()] = static_cast<std::uint8_t>(check & 0xFF);
  frame->data[bytes.size() + 1] = static_cast<std::uint8_t>(check >> 8);
  frame->preamble_start = at;
  frame->rmarker = at + preamble_ticks(format.preamble_symbols) * kUnitsPerTick;
  frame->data_start = frame->rmarker + kHeaderTicks * kUnitsPerTick;
  frame->end = frame->data_start + data_ticks(frame->length) * kUnitsPerTick;
  medium_.announce(frame);
}

}  // namespace groma::sim
