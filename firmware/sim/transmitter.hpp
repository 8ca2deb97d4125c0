// A sender that is no node: any bytes at any instant, for other systems on the channel, attacks and rubbish.
#pragma once

#include <cstdint>
#include <span>

#include "firmware/sim/medium.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

class Transmitter {
 public:
  // Takes its place on the medium, which it must not outlive, under that id for the propagation model.
  Transmitter(std::uint16_t id, Medium& medium) : medium_(medium), station_(medium.attach_sender(id)) {}

  // A frame of 0 to 125 bytes, to which the frame check is added, whose preamble starts at `at`. Its clock is
  // nominal. Announced at once: not while the network runs, and `at` is later than any node has come by the
  // work that it does (1 ms).
  void send(SimTime at, std::span<const std::uint8_t> bytes, const AirFormat& format = {});

  [[nodiscard]] std::uint32_t frames_sent() const noexcept { return frames_sent_; }

 private:
  Medium& medium_;
  std::size_t station_;
  std::uint32_t frames_sent_ = 0;
};

}  // namespace groma::sim
