#pragma once

#include <cstdint>
#include <optional>

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
  std::int32_t carrier_integral = 0;
};

// RXPACC includes up to 5 symbols of the SFD if it equals its unsaturated counterpart (user manual 7.2.18,
// for the SFD of 8 symbols).
[[nodiscard]] std::uint16_t corrected_preamble_count(std::uint16_t count, std::uint16_t unsaturated) noexcept;

// Power of the first path and total receive power in 1/100 dBm (user manual 4.7.1 and 4.7.2, PRF 64 MHz).
// Nothing if a register of the formula is 0.
[[nodiscard]] std::optional<std::int32_t> first_path_power_cdbm(const ReceiveQuality& quality) noexcept;
[[nodiscard]] std::optional<std::int32_t> receive_power_cdbm(const ReceiveQuality& quality) noexcept;

// Distance from the first path to the strongest one, in 1/64 samples, never negative.
[[nodiscard]] std::int32_t peak_distance_64ths(const ReceiveQuality& quality) noexcept;

// LOS is likely if the first path's power is less than this below the total power, and unlikely if it is
// further below (user manual 4.7.3); 1/100 dB.
inline constexpr std::int32_t kLikelyHidden_cdb = 600;
inline constexpr std::int32_t kUnlikelyHidden_cdb = 1'000;

// Whether the first path is likely the LOS path, by two tests: the first path's share of the power, as above;
// and its distance to the strongest path: up to 3.3 samples is LOS, more than 6 is NLOS (APS006 part 3).
// Likely if both tests say so, unlikely if one does. Only a hint: a homogeneous wall attenuates all paths
// equally.
enum class LineOfSight : std::uint8_t { kUnknown, kLikely, kUncertain, kUnlikely };
[[nodiscard]] LineOfSight line_of_sight(std::optional<std::int32_t> first_path_power_cdbm,
                                        std::optional<std::int32_t> receive_power_cdbm,
                                        std::int32_t peak_distance_64ths) noexcept;

// The transmitter's clock against the receiver's, in parts per 10^9; positive: the transmitter is fast
// (channel 5, 6.8 Mbit/s). The integral has the opposite sign.
[[nodiscard]] std::int32_t clock_offset_ppb(std::int32_t carrier_integral) noexcept;

}  // namespace groma::dw1000
