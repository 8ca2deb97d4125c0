// Detects a wrong map: whether the ranges contradict the calibration. With the map of another site, or of
// this one before anchors were moved or their ids exchanged, most ranges contradict it at any pose.
//
// A range contradicts the map if its innovation exceeds what noise, biases and the anchors' covariances
// explain at a pose known to kPoseSigma_m. The pose's own covariance does not count, because it grows while
// ranges are refused. NLOS, slipping wheels, a robot that was carried away and a single moved anchor make
// only few ranges contradict, or only for a short time.
#pragma once

#include <limits>
#include <optional>

namespace groma::filter {

// Since when a condition has held without interruption.
class Since {
 public:
  void update(bool holds, double now_s) noexcept { since_s_ = holds ? since_s_.value_or(now_s) : Time(); }
  void reset() noexcept { since_s_.reset(); }
  [[nodiscard]] bool holds() const noexcept { return since_s_.has_value(); }
  // Duration; 0 if the condition does not hold.
  [[nodiscard]] double lasted_s(double now_s) const noexcept { return since_s_ ? now_s - *since_s_ : 0.0; }

 private:
  using Time = std::optional<double>;
  Time since_s_;
};

class MapWatch {
 public:
  // innovation_m: measured minus predicted; variance_m2: S without the contribution of the pose
  // (RangeResult::map_variance_m2).
  void observe(double t_s, double innovation_m, double variance_m2) noexcept;
  // Another pose was found: contradictions at the previous pose no longer count.
  void restart() noexcept;

  // Share of ranges that contradict the map, with exponential forgetting over kWindow_s.
  [[nodiscard]] double share() const noexcept;
  // The map has explained the ranges for kClearFor_s: the pose they give is reliable.
  [[nodiscard]] bool fits() const noexcept;
  // Many ranges contradict the map.
  [[nodiscard]] bool is_suspect() const noexcept { return is_suspect_; }
  // Many ranges have contradicted it for long. Cleared when the ranges fit for kFitsFor_s.
  [[nodiscard]] bool is_wrong() const noexcept { return is_wrong_; }

 private:
  double t_s_ = -std::numeric_limits<double>::infinity();
  double judged_ = 0.0;  // sums with exponential forgetting
  double contradicting_ = 0.0;
  bool is_suspect_ = false;
  bool is_wrong_ = false;
  Since suspect_;                // ends after clear_ has lasted kClearFor_s
  double suspect_ranges_ = 0.0;  // ranges since then
  Since clear_;
  Since fits_;
  double fitting_ranges_ = 0.0;  // ranges since then
};

}  // namespace groma::filter
