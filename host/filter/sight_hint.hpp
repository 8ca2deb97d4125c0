// What the powers of a range tell of its pair's sight: learnt on the site itself, by what innovations say.
//
// A range falls into one class. How often either state gives the class is counted. The counts begin with what
// the chip's maker tells of the first and with nothing of the second: a hint that is wrong here, or tells
// nothing, soon has a likelihood ratio of 1.
#pragma once

#include <array>

#include "host/filter/config.hpp"
#include "host/model/power_class.hpp"

namespace groma::filter {

class SightHint {
 public:
  explicit SightHint(const GateConfig& config) noexcept;

  // Of a blocked pair over one in sight, from 1/hint_most to hint_most; 1 of kNoPowerClass.
  [[nodiscard]] double likelihood_ratio(model::PowerClass of) const noexcept;
  // Of all ranges that were learnt from.
  [[nodiscard]] double blocked_share() const noexcept;
  // Takes note of a range of that class at t_s, held for blocked and for in sight by those shares.
  void learn(model::PowerClass of, double t_s, double blocked, double in_sight) noexcept;

 private:
  struct Counts {
    std::array<double, model::kPowerClasses> of{};
    double all = 0.0;
  };
  // Of a class in a state.
  [[nodiscard]] double share(const Counts& counts, const std::array<double, model::kHiddenClasses>& believed,
                             model::PowerClass of) const noexcept;

  double most_ = 1.0;
  double memory_s_ = 0.0;
  double prior_count_ = 0.0;
  double prior_blocked_share_ = 0.0;
  // Counts fade: in place of all that were, what one more is worth grows with time.
  Counts blocked_;
  Counts in_sight_;
  double unit_ = 1.0;
  double t_s_ = 0.0;
};

}  // namespace groma::filter
