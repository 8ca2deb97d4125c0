#include "host/daemon/odometry_merger.hpp"

#include "host/filter/odometry_gate.hpp"

namespace groma::daemon {

std::span<const model::OdometrySample> OdometryMerger::take(const model::OdometrySample& sample) noexcept {
  const bool fast = has_last_ && sample.t_s - last_.t_s < kFast_s && filter::follows(last_, sample);
  std::size_t count = 0;
  if (holds_) {
    add_held_until(sample.t_s);
    if (!fast || sample.t_s - from_s_ >= kLeast_s) {
      out_[count++] = mean();
      holds_ = false;
    }
  }
  has_last_ = true;
  last_ = sample;
  if (!fast) {
    out_[count++] = sample;
  } else if (!holds_) {
    holds_ = true;
    from_s_ = sample.t_s;
    sum_s_ = x_m_ = y_m_ = turn_rad_ = 0.0;
  }
  return std::span(out_).first(count);
}

std::span<const model::OdometrySample> OdometryMerger::flush_until(double robot_now_s) noexcept {
  if (!holds_ || robot_now_s - last_.t_s < kSilence_s) return {};
  return flush();
}

std::span<const model::OdometrySample> OdometryMerger::flush() noexcept {
  if (!holds_) return {};
  holds_ = false;
  std::size_t count = 0;
  if (sum_s_ > 0.0) out_[count++] = mean();
  // The last sample still holds.
  out_[count++] = last_;
  return std::span(out_).first(count);
}

void OdometryMerger::add_held_until(double t_s) noexcept {
  const double held_s = t_s - last_.t_s;
  if (last_.t_s > from_s_) ++merged_;
  sum_s_ += held_s;
  x_m_ += last_.vx_mps * held_s;
  y_m_ += last_.vy_mps * held_s;
  turn_rad_ += last_.omega_radps * held_s;
}

model::OdometrySample OdometryMerger::mean() const noexcept {
  return {from_s_, x_m_ / sum_s_, y_m_ / sum_s_, turn_rad_ / sum_s_};
}

}  // namespace groma::daemon
