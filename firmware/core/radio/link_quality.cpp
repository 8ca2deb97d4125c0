#include "firmware/core/radio/link_quality.hpp"

#include <cmath>

namespace groma::radio {

std::optional<std::int32_t> power_cdbm(float power) noexcept {
  if (power <= 0.0F) return std::nullopt;
  const float power_dbm = 10.0F * std::log10(power) + kPowerUnit_dbm;
  return static_cast<std::int32_t>(std::lround(power_dbm * 100.0F));
}

LineOfSight line_of_sight(std::optional<std::int32_t> first_path_power_cdbm,
                          std::optional<std::int32_t> receive_power_cdbm,
                          std::int32_t peak_distance_64ths) noexcept {
  constexpr std::int32_t kLikely_64ths = 211;  // 3.3 samples
  constexpr std::int32_t kUnlikely_64ths = 6 * 64;
  if (!first_path_power_cdbm || !receive_power_cdbm) return LineOfSight::kUnknown;
  const std::int32_t hidden_cdb = *receive_power_cdbm - *first_path_power_cdbm;
  if (hidden_cdb > kUnlikelyHidden_cdb || peak_distance_64ths > kUnlikely_64ths)
    return LineOfSight::kUnlikely;
  const bool likely = hidden_cdb < kLikelyHidden_cdb && peak_distance_64ths <= kLikely_64ths;
  return likely ? LineOfSight::kLikely : LineOfSight::kUncertain;
}

}  // namespace groma::radio
