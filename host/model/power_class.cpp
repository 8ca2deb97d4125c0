#include "host/model/power_class.hpp"

#include <algorithm>
#include <cmath>

namespace groma::model {

PowerClass power_class(const RangeSample& range) noexcept {
  // By hand: with -41.3 dBm/MHz over 500 MHz, 1 m of free space at 6.5 GHz leaves -63 dBm. The classes reach
  // from 36 dB below that to 12 dB above.
  constexpr double kWeakest_dbm = -99.0;
  // Received power over first-path power: LOS is likely below 6 dB, NLOS above 10 dB (user manual 4.7.3, as
  // in the firmware).
  constexpr double kLikelyHidden_cdb = 600.0;
  constexpr double kUnlikelyHidden_cdb = 1000.0;
  const auto first_path_dbm = static_cast<double>(range.first_path_power_dbm);
  const double hidden_cdb = 100.0 * (static_cast<double>(range.receive_power_dbm) - first_path_dbm);
  std::size_t hidden = 0;
  if (std::isfinite(hidden_cdb)) {
    hidden = hidden_cdb < kLikelyHidden_cdb ? 0 : hidden_cdb <= kUnlikelyHidden_cdb ? 1 : 2;
  } else if (range.line_of_sight != LineOfSight::kNotKnown) {
    hidden = static_cast<std::size_t>(range.line_of_sight) - 1;
  } else {
    return kNoPowerClass;
  }
  const double strength_dbm = first_path_dbm + 20.0 * std::log10(range.range_m);
  std::size_t strength = kStrengthClasses - 1;
  if (std::isfinite(strength_dbm)) {
    constexpr double kLast = static_cast<double>(kStrengthClasses - 2);
    strength =
        static_cast<std::size_t>(std::clamp((strength_dbm - kWeakest_dbm) / kStrengthStep_db, 0.0, kLast));
  }
  return static_cast<PowerClass>(hidden * kStrengthClasses + strength);
}

}  // namespace groma::model
