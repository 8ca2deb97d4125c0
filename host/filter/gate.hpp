// What weight a range deserves, from its innovation alone; apart from the update, and unable to lock
// itself out.
#pragma once

#include "host/filter/config.hpp"

namespace groma::filter {

class Gate {
 public:
  explicit Gate(const GateConfig& config) : config_(config) {}

  // Weight in [0, 1] of an innovation of that variance; 0 turns it away, as it does what is not a number.
  [[nodiscard]] double weight(double innovation_m, double variance_m2) const noexcept;

  // Takes note of what became of a range at t_s. True when the gate begins to doubt the state.
  bool observe(double t_s, bool rejected) noexcept;
  // Too large a share of late has been turned away: not the ranges, the state is wrong. Where no ranges come
  // there is no doubt either.
  [[nodiscard]] bool doubts(double t_s) const noexcept { return doubts_ && t_s - t_s_ < config_.window_s; }
  void reset(double t_s) noexcept;

 private:
  GateConfig config_;
  double t_s_ = 0.0;
  double rejected_ = 0.0;  // fading counts over window_s
  double seen_ = 0.0;
  bool doubts_ = false;
};

}  // namespace groma::filter
