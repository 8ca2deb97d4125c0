#pragma once

#include <cstdint>

#include "firmware/core/radio/link_quality.hpp"

namespace groma::dw1000 {

// The chip's raw register values about the reception of a frame.
struct ReceiveQuality {
  std::uint16_t amplitude1 = 0;  // of the first path, at its index plus 1, 2 and 3 samples
  std::uint16_t amplitude2 = 0;
  std::uint16_t amplitude3 = 0;
  std::uint16_t channel_power = 0;
  std::uint16_t noise = 0;
  std::uint16_t first_path_index_64ths = 0;  // of the channel's impulse response, samples of 1.0016 ns
  std::uint16_t peak_index = 0;              // of its strongest path, whole samples
  std::uint16_t preamble_count = 0;          // symbols accumulated, without those of the SFD
  std::int32_t carrier_integral = 0;         // 21 bits
};

// RXPACC includes up to 5 symbols of the SFD if it equals its unsaturated counterpart (user manual 7.2.18,
// for the SFD of 8 symbols).
[[nodiscard]] std::uint16_t corrected_preamble_count(std::uint16_t count, std::uint16_t unsaturated) noexcept;

// Powers by user manual 4.7.1 and 4.7.2, PRF 64 MHz; 0 if a register of the formula is 0.
[[nodiscard]] radio::LinkQuality link_quality(const ReceiveQuality& quality) noexcept;

// The transmitter's clock against the receiver's, in parts per 10^9; positive: the transmitter is fast
// (channel 5, 6.8 Mbit/s). The integral has the opposite sign.
[[nodiscard]] std::int32_t clock_offset_ppb(std::int32_t carrier_integral) noexcept;

}  // namespace groma::dw1000
