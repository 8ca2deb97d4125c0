#include "firmware/core/ranging/corrections.hpp"

#include <algorithm>
#include <array>
#include <cstddef>

namespace groma::ranging {
namespace {

constexpr FlightTime flight_of_um(double distance_um) noexcept {
  constexpr double k256thsPerUm = static_cast<double>(Ticks::kPerSecond) * 256.0 / kSpeedOfLight_mps * 1e-6;
  const double in_256ths = distance_um * k256thsPerUm;
  return FlightTime(static_cast<std::int64_t>(in_256ths + (in_256ths < 0.0 ? -0.5 : 0.5)));
}

// `deviation` is in units of 1/scale, `rate` per unit; the result is in 1/256 tick.
constexpr FlightTime drift(std::int64_t deviation, FlightTime rate, std::int64_t scale) noexcept {
  const std::int64_t product = deviation * rate.in_256ths();
  return FlightTime((product + (product < 0 ? -scale : scale) / 2) / scale);
}

constexpr std::int32_t kWeakest_cdbm = -9'300;
constexpr std::int32_t kStep_cdb = 200;
constexpr std::array<std::int16_t, 17> kBias_mm = {81,  76,  71,  62,  49,  42,   35,   21,  0,
                                                   -27, -51, -69, -82, -93, -100, -105, -110};

}  // namespace

FlightTime temperature_drift(std::int32_t temperature_cdegc) noexcept {
  // Per 1000 degrees, so that rounding of the rate is negligible.
  constexpr FlightTime kPer1000 = flight_of_um(1000.0 * kTemperatureDrift_um);
  return drift(std::int64_t{temperature_cdegc} - kReferenceTemperature_cdegc, kPer1000,
               std::int64_t{100} * 1000);
}

FlightTime supply_drift(std::int32_t supply_mv) noexcept {
  constexpr FlightTime kPer1000 = flight_of_um(1000.0 * kSupplyDrift_um);
  return drift(std::int64_t{supply_mv} - kReferenceSupply_mv, kPer1000, std::int64_t{1000} * 1000);
}

FlightTime power_bias(std::int32_t receive_power_cdbm) noexcept {
  constexpr std::int32_t kStrongest_cdbm =
      kWeakest_cdbm + static_cast<std::int32_t>(kBias_mm.size() - 1) * kStep_cdb;
  const std::int32_t above = std::clamp(receive_power_cdbm, kWeakest_cdbm, kStrongest_cdbm) - kWeakest_cdbm;
  const auto index = std::min(static_cast<std::size_t>(above / kStep_cdb), kBias_mm.size() - 2);
  const std::int32_t rest = above - static_cast<std::int32_t>(index) * kStep_cdb;
  const std::int64_t bias_mm_steps = kBias_mm[index] * (kStep_cdb - rest) + kBias_mm[index + 1] * rest;
  constexpr FlightTime kPerKilometre = flight_of_um(1e9);
  return drift(bias_mm_steps, kPerKilometre, std::int64_t{kStep_cdb} * 1'000'000);
}

}  // namespace groma::ranging
