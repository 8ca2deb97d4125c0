#include "host/filter/zero_velocity_measurement.hpp"

namespace groma::filter {

CoreMeasurement<3> measure_zero_velocity(const CoreVector& core, const model::OdometrySample& row,
                                         const SensorConfig& config) noexcept {
  const double scale = 1.0 + core(kScale);
  CoreMeasurement<3> out;
  out.innovation << core(kRowVx) - scale * row.vx_mps, core(kRowVy) - scale * row.vy_mps,
      core(kYawBias) + core(kRowOmega) - row.omega_radps;
  out.d_core.setZero();
  out.d_core(0, kScale) = row.vx_mps;
  out.d_core(0, kRowVx) = -1.0;
  out.d_core(1, kScale) = row.vy_mps;
  out.d_core(1, kRowVy) = -1.0;
  out.d_core(2, kYawBias) = -1.0;
  out.d_core(2, kRowOmega) = -1.0;
  const double variance_m2ps2 = config.standing_sigma_mps * config.standing_sigma_mps;
  const double variance_rad2ps2 = config.standing_sigma_radps * config.standing_sigma_radps;
  out.noise = Eigen::Vector3d(variance_m2ps2, variance_m2ps2, variance_rad2ps2).asDiagonal();
  return out;
}

}  // namespace groma::filter
