// A sender that is not a node. It sends any bytes at any instant: other systems' frames, attacks, garbage.
#pragma once

#include <cstdint>
#include <span>

#include "firmware/sim/medium.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

class Transmitter {
 public:
  // Attaches itself to the medium, which must outlive it. The propagation model knows it by `id`.
  Transmitter(std::uint16_t id, Medium& medium) : medium_(medium), station_(medium.attach_sender(id)) {}

  // Sends a frame of 0 to 125 bytes plus frame check whose preamble starts at `at`, with a nominal clock. The
  // frame is announced at once: do not call it while the network runs, and choose `at` later than any node's
  // local time (1 ms ahead is enough). Throws SimulationError for more than 125 bytes.
  void send(SimTime at, std::span<const std::uint8_t> bytes, const AirFormat& format = {});

  [[nodiscard]] std::uint32_t frames_sent() const noexcept { return frames_sent_; }

 private:
  Medium& medium_;
  std::size_t station_;
  std::uint32_t frames_sent_ = 0;
};

}  // namespace groma::sim
