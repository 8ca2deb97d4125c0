// What the powers of ranges tell of the state that a pair is in, learnt on the site itself.
#pragma once

#include <array>
#include <span>

#include "host/calibration/association.hpp"
#include "host/model/power_class.hpp"

namespace groma::calibration {

// Of ranges in each class, expected: those in sight, and those that are not.
struct PowerCounts {
  std::array<double, model::kPowerClasses> in_sight{};
  std::array<double, model::kPowerClasses> blocked{};

  void add(model::PowerClass of, double in_sight_share) noexcept;
  // Of so many times those.
  void add(const PowerCounts& other, double times) noexcept;
};

class PowerHints {
 public:
  // As believed before any residual: `ranges` counts a site's ranges in each class. In sight the first path
  // is about as strong, for its length, as the strongest are; blocked it is anything. `interval_s`: between
  // ranges of a pair; those that are close are fewer to learn from.
  PowerHints(std::span<const double, model::kPowerClasses> ranges, double interval_s) noexcept;

  // Likelihood of a range's class for a blocked pair over that for one in sight, from 1/10 to 10; 1 of
  // kNoPowerClass.
  [[nodiscard]] double ratio(model::PowerClass of) const noexcept { return ratios_[of]; }
  // Counts upon what is believed, in the place of all that was learnt before.
  void learn(const PowerCounts& counts) noexcept;

 private:
  double share_ = 1.0;  // of a range in those that are one to learn from
  PowerCounts believed_;
  std::array<double, model::kPowerClasses + 1> ratios_{};
};

}  // namespace groma::calibration
