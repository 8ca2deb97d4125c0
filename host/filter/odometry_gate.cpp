#include "host/filter/odometry_gate.hpp"

#include <cmath>

#include "host/model/ablation.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

bool follows(const OdometryGateConfig& config, const model::OdometrySample& before,
             const model::OdometrySample& sample) noexcept {
  return std::hypot(sample.vx_mps - before.vx_mps, sample.vy_mps - before.vy_mps) <= config.jump_mps &&
         std::abs(sample.omega_radps - before.omega_radps) <= config.jump_radps;
}

bool OdometryGate::accepts(const model::OdometrySample& sample) noexcept {
  if (!model::is_plausible(sample)) {
    dropped_count_ = 0;
    return false;
  }
  if (!follows(config_, accepted_, sample) && !model::is_ablated(model::Mechanism::kOdometryGate)) {
    if (dropped_count_ == 0 || !follows(config_, dropped_, sample)) {
      dropped_count_ = 0;
      dropped_since_s_ = sample.t_s;
    }
    dropped_ = sample;
    ++dropped_count_;
    const bool is_believed =
        dropped_count_ > config_.agreeing_samples && sample.t_s - dropped_since_s_ >= config_.agreeing_s;
    if (!is_believed) return false;
  }
  accepted_ = sample;
  dropped_count_ = 0;
  return true;
}

}  // namespace groma::filter
