// Whether the ranges fit the calibration: on the map of another site, or of this one before its anchors were
// moved or their ids exchanged, most of them contradict it at any pose.
//
// A range contradicts the map if its innovation is beyond what noise, biases and the anchors' covariances
// explain at a pose that is known to kPoseSigma_m. The pose's own covariance does not count: it grows while
// ranges are refused. NLOS, slipping wheels, a robot that was carried away or one moved anchor make few
// ranges contradict, or for a short time.
#pragma once

#include <limits>
#include <optional>

namespace groma::filter {

// Since when a condition has held without a break.
class Since {
 public:
  void update(bool holds, double now_s) noexcept { since_s_ = holds ? since_s_.value_or(now_s) : Time(); }
  void reset() noexcept { since_s_.reset(); }
  [[nodiscard]] bool holds() const noexcept { return since_s_.has_value(); }
  // For how long; 0 where it does not hold.
  [[nodiscard]] double lasted_s(double now_s) const noexcept { return since_s_ ? now_s - *since_s_ : 0.0; }

 private:
  using Time = std::optional<double>;
  Time since_s_;
};

class MapWatch {
 public:
  // innovation_m: measured less predicted; variance_m2: of the innovation without what the pose adds.
  void observe(double t_s, double innovation_m, double variance_m2) noexcept;
  // Another pose was found: what contradicted the one before no longer counts.
  void restart() noexcept;

  // Share of ranges that contradict, fading over kWindow_s.
  [[nodiscard]] double share() const noexcept;
  // The map has explained the ranges for a while: the pose by them is to be believed.
  [[nodiscard]] bool fits() const noexcept;
  // Many ranges contradict it.
  [[nodiscard]] bool is_doubtful() const noexcept { return is_doubtful_; }
  // They have for long; until they fit for 30 s.
  [[nodiscard]] bool is_wrong() const noexcept { return is_wrong_; }

 private:
  double t_s_ = -std::numeric_limits<double>::infinity();
  double judged_ = 0.0;  // fading sums
  double contradicting_ = 0.0;
  bool is_doubtful_ = false;
  bool is_wrong_ = false;
  Since doubtful_;                // ends when clear for a while
  double doubtful_ranges_ = 0.0;  // since then
  Since clear_;
  Since fits_;
  double fitting_ranges_ = 0.0;  // since then
};

}  // namespace groma::filter
