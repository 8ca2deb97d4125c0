#include "host/filter/sensor_gate.hpp"

#include <algorithm>
#include <cmath>

namespace groma::filter {

double SensorGate::weigh(Sensor sensor, double t_s, double mean_square) noexcept {
  if (!std::isfinite(mean_square)) return 0.0;
  double& seen_s = seen_s_[static_cast<std::size_t>(sensor)];
  double& heard_s = heard_s_[static_cast<std::size_t>(sensor)];
  if (t_s - seen_s > config_.patience_s) heard_s = t_s;
  seen_s = t_s;
  if (mean_square > config_.wild * config_.wild) {
    if (t_s - heard_s < config_.patience_s) return 0.0;
  } else {
    heard_s = t_s;
  }
  return std::min(config_.knee * config_.knee / mean_square, 1.0);
}

void SensorGate::reset() noexcept {
  seen_s_.fill(kNotYet_s);
  heard_s_.fill(kNotYet_s);
}

}  // namespace groma::filter
