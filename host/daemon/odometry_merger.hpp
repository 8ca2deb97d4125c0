// Odometry that comes faster than 200 Hz, merged: each sample that goes out stands for at least 5 ms.
//
// A sample holds until the next. So a merged one carries the time of its first sample and the mean of the
// velocities over the time that they held, up to the sample that ends it: the displacement is exact, and the
// merged sample goes out when that time is over. Samples that come slower go through as they are, at once; so
// does a jump that no robot can do, for the filter's gate to see.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "host/model/types.hpp"

namespace groma::daemon {

class OdometryMerger {
 public:
  static constexpr double kLeast_s = 0.005;  // that a merged sample stands for
  static constexpr double kFast_s =
      0.0045;  // samples closer than this are merged: 200 Hz with some jitter is not
  static constexpr double kSilence_s = 0.010;  // without another sample: what is held goes out

  // Of the next sample, later than the one before. What goes out, in order of time; valid until the next
  // call.
  [[nodiscard]] std::span<const model::OdometrySample> take(const model::OdometrySample& sample) noexcept;
  // What is held, where the robot's time shows that no other sample follows soon.
  [[nodiscard]] std::span<const model::OdometrySample> flush_until(double robot_now_s) noexcept;
  [[nodiscard]] std::span<const model::OdometrySample> flush() noexcept;
  void reset() noexcept { *this = OdometryMerger(); }

  // Samples that went into one with others.
  [[nodiscard]] std::uint64_t merged() const noexcept { return merged_; }

 private:
  void add_held_until(double t_s) noexcept;
  [[nodiscard]] model::OdometrySample mean() const noexcept;

  std::array<model::OdometrySample, 2> out_{};
  bool has_last_ = false;
  bool holds_ = false;
  model::OdometrySample last_{};  // it holds from its time on
  double from_s_ = 0.0;           // of the first sample held
  double sum_s_ = 0.0;            // for which velocities are summed up
  double x_m_ = 0.0;
  double y_m_ = 0.0;
  double turn_rad_ = 0.0;
  std::uint64_t merged_ = 0;
};

}  // namespace groma::daemon
