// What a radio reports about the reception of a frame.
#pragma once

#include <cstdint>
#include <optional>

namespace groma::radio {

// Powers are linear, so that a radio takes no logarithm between two frames; power_cdbm() takes it later.
inline constexpr float kPowerUnit_dbm = -121.74F;

struct LinkQuality {
  float receive_power = 0.0F;     // total, in units of kPowerUnit_dbm; 0: not known
  float first_path_power = 0.0F;  // as above
  // The transmitter's clock against the receiver's, from the carrier, in parts per 10^9; positive: the
  // transmitter is fast. Nothing if the radio does not measure it.
  std::optional<std::int32_t> clock_offset_ppb{};
  std::uint16_t peak_distance_64ths = 0;  // from the first path to the strongest, in samples of 1.0016 ns
  std::uint16_t noise = 0;                // of the channel's impulse response, in the radio's units
};

// In 1/100 dBm; nothing for 0.
[[nodiscard]] std::optional<std::int32_t> power_cdbm(float power) noexcept;

// LOS is likely if the first path's power is less than this below the total power, and unlikely if it is
// further below (DW1000 user manual 4.7.3); 1/100 dB.
inline constexpr std::int32_t kLikelyHidden_cdb = 600;
inline constexpr std::int32_t kUnlikelyHidden_cdb = 1'000;

// Whether the first path is likely the LOS path, by two tests: the first path's share of the power, as above;
// and its distance to the strongest path: up to 3.3 samples is LOS, more than 6 is NLOS (APS006 part 3).
// Likely if both tests say so, unlikely if one does; unknown without both powers. Only a hint: a homogeneous
// wall attenuates all paths equally.
enum class LineOfSight : std::uint8_t { kUnknown, kLikely, kUncertain, kUnlikely };
[[nodiscard]] LineOfSight line_of_sight(std::optional<std::int32_t> first_path_power_cdbm,
                                        std::optional<std::int32_t> receive_power_cdbm,
                                        std::int32_t peak_distance_64ths) noexcept;

}  // namespace groma::radio
