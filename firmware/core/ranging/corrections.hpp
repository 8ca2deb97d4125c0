// Known systematic errors of a range, corrected if the configuration asks for it. Antenna delays are not
// included: the chips apply those themselves, in each timestamp.
//
// All corrections are zero at a reference, kReferenceTemperature_cdegc and kReferenceSupply_mv, at which the
// chips' converters were calibrated.
#pragma once

#include <cstdint>

#include "firmware/core/ranging/twr.hpp"

namespace groma::ranging {

inline constexpr std::int32_t kReferenceTemperature_cdegc = 2'300;  // 23 degrees C
inline constexpr std::int32_t kReferenceSupply_mv = 3'300;

// The typical growth of a range with each degree C, and each volt, of either end's chip (user manual 8.3.1).
// The manual gives the size, but not the sign, nor whether it applies to one end or to the pair. This code
// assumes that a range grows, for each end.
inline constexpr std::int32_t kTemperatureDrift_um = 2'150;
inline constexpr std::int32_t kSupplyDrift_um = 53'500;

// The growth of a range from one end's temperature, or supply: in 1/256 tick, rounded.
[[nodiscard]] FlightTime temperature_drift(std::int32_t temperature_cdegc) noexcept;
[[nodiscard]] FlightTime supply_drift(std::int32_t supply_mv) noexcept;

// The excess of a measured range at a receive power (PRF 64 MHz, bandwidth 500 MHz; APS011, table 2). Linear
// between the table's points, which are 2 dB apart, and constant outside of -93 to -61 dBm. A strong signal
// crosses the leading edge's threshold early: its range is too short and the bias is negative. Assumes that
// both ends receive the same power, as they do if they send with the same power.
[[nodiscard]] FlightTime power_bias(std::int32_t receive_power_cdbm) noexcept;

}  // namespace groma::ranging
