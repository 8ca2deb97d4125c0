// Merges odometry faster than 200 Hz: each merged sample covers at least 5 ms.
//
// A sample holds until the next. So a merged sample has the time of its first sample and the time-weighted
// mean of the velocities up to the sample that ends it. The displacement is exact. The merged sample goes
// out when its interval has ended. Slower samples pass unchanged, at once; so does a jump that no robot can
// make, so that the filter's gate sees it.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "host/model/types.hpp"

namespace groma::daemon {

class OdometryMerger {
 public:
  static constexpr double kLeast_s = 0.005;  // minimum interval of a merged sample
  static constexpr double kFast_s =
      0.0045;  // samples closer than this are merged; 200 Hz with some jitter is not
  static constexpr double kSilence_s = 0.010;  // after this time without a sample the held ones go out

  // Takes the next sample, later than the one before. Returns the samples that go out, in the order of time;
  // valid until the next call.
  [[nodiscard]] std::span<const model::OdometrySample> take(const model::OdometrySample& sample) noexcept;
  // Returns the held samples if no sample came for kSilence_s of robot time, otherwise nothing.
  [[nodiscard]] std::span<const model::OdometrySample> flush_until(double robot_now_s) noexcept;
  [[nodiscard]] std::span<const model::OdometrySample> flush() noexcept;
  void reset() noexcept { *this = OdometryMerger(); }

  // Input samples less output samples.
  [[nodiscard]] std::uint64_t merged() const noexcept { return merged_; }

 private:
  void add_held_until(double t_s) noexcept;
  [[nodiscard]] model::OdometrySample mean() const noexcept;

  std::array<model::OdometrySample, 2> out_{};
  bool has_last_ = false;
  bool holds_ = false;
  model::OdometrySample last_{};  // holds from its time on
  double from_s_ = 0.0;           // time of the first held sample
  double sum_s_ = 0.0;            // time over which velocities are integrated
  double x_m_ = 0.0;
  double y_m_ = 0.0;
  double turn_rad_ = 0.0;
  std::uint64_t merged_ = 0;
};

}  // namespace groma::daemon
