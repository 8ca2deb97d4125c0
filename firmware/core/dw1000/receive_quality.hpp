#pragma once

#include <cstdint>
#include <optional>

namespace groma::dw1000 {

// What the chip says of a frame's reception, as its registers have it.
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

// RXPACC counts up to 5 symbols of the SFD where it equals its unsaturated twin (user manual 7.2.18, for the
// SFD of 8 symbols).
[[nodiscard]] std::uint16_t corrected_preamble_count(std::uint16_t count, std::uint16_t unsaturated) noexcept;

// Power of the first path and of the whole frame in 1/100 dBm (user manual 4.7.1 and 4.7.2, PRF 64 MHz).
// Nothing where a register of the formula is 0.
[[nodiscard]] std::optional<std::int32_t> first_path_power_cdbm(const ReceiveQuality& quality) noexcept;
[[nodiscard]] std::optional<std::int32_t> receive_power_cdbm(const ReceiveQuality& quality) noexcept;

// From the first path to the strongest, either way.
[[nodiscard]] std::int32_t peak_distance_64ths(const ReceiveQuality& quality) noexcept;

// The straight path is likely the first one where that is less than so far below the whole power, unlikely
// where it is further below (user manual 4.7.3); 1/100 dB.
inline constexpr std::int32_t kLikelyHidden_cdb = 600;
inline constexpr std::int32_t kUnlikelyHidden_cdb = 1'000;

// Whether the first path is likely the straight one. By what part of the power it holds, as above; and by how
// far the strongest path is from it: up to 3.3 samples is line of sight, more than 6 is not (APS006 part 3).
// Likely is what both call so, unlikely what one does. A hint: a wall of one material attenuates all paths
// alike.
enum class LineOfSight : std::uint8_t { kUnknown, kLikely, kUncertain, kUnlikely };
[[nodiscard]] LineOfSight line_of_sight(std::optional<std::int32_t> first_path_power_cdbm,
                                        std::optional<std::int32_t> receive_power_cdbm,
                                        std::int32_t peak_distance_64ths) noexcept;

// The transmitter's clock against the receiver's, parts per 10^9; positive: the transmitter's is fast
// (channel 5, 6.8 Mbit/s). The integral's sign is the other way round.
[[nodiscard]] std::int32_t clock_offset_ppb(std::int32_t carrier_integral) noexcept;

}  // namespace groma::dw1000
