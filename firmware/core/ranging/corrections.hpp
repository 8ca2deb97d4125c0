// What is known to bend a range, and is taken out of it where the configuration asks for it. The antenna
// delays are not among it: the chips apply those themselves, in each stamp.
//
// All is relative to a reference at which nothing is corrected: kReferenceTemperature_cdegc and
// kReferenceSupply_mv, at which the chips' converters were calibrated.
#pragma once

#include <cstdint>

#include "firmware/core/ranging/twr.hpp"

namespace groma::ranging {

inline constexpr std::int32_t kReferenceTemperature_cdegc = 2'300;  // 23 degrees C
inline constexpr std::int32_t kReferenceSupply_mv = 3'300;

// A range grows by this with each degree C, and each volt, of either end's chip: typical figures (user manual
// 8.3.1). The manual tells the size and neither the sign nor whether it is an end's or the pair's; that a
// range grows, by each end, is what is assumed here.
inline constexpr std::int32_t kTemperatureDrift_um = 2'150;
inline constexpr std::int32_t kSupplyDrift_um = 53'500;

// By how much one end's temperature, and its supply, lengthen a range: 1/256 tick, rounded.
[[nodiscard]] FlightTime temperature_drift(std::int32_t temperature_cdegc) noexcept;
[[nodiscard]] FlightTime supply_drift(std::int32_t supply_mv) noexcept;

// By how much a range is measured too long at a receive power (PRF 64 MHz, 500 MHz of bandwidth; APS011,
// table 2), linear between the table's points of 2 dB and constant outside of -93 to -61 dBm. A strong signal
// crosses the leading edge's threshold early: its range is too short, and the bias negative. Both ends are
// taken to receive the same power, as they do where both send with the same.
[[nodiscard]] FlightTime power_bias(std::int32_t receive_power_cdbm) noexcept;

}  // namespace groma::ranging
