// What STATUS says about the measurements: the path by odometry, and the ranges of each pair.
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "host/daemon/measurement_sink.hpp"
#include "host/filter/filter.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

struct PairStatus {
  model::NodeId tag_id = 0;
  model::NodeId anchor_id = 0;
  std::uint64_t ranges = 0;  // all
  std::uint64_t used = 0;    // by the filter
  std::uint64_t gated = 0;   // refused, because they contradict the pose
  double range_m = 0.0;      // smoothed
  // Of the ranges that were used or gated, smoothed: the mean square of measured minus predicted; NaN: none.
  double innovation_m2 = std::numeric_limits<double>::quiet_NaN();
  double last_s = 0.0;  // robot time
};

// Allocates nothing after construction.
class InputWatch : public MeasurementSink {
 public:
  static constexpr std::size_t kMaxPairs = 128;  // further pairs are left out
  static constexpr double kShown_s = 5.0;        // a pair without ranges for longer is not listed
  static constexpr double kSmoothing = 0.2;      // weight of the newest range
  static constexpr double kLongestHold_s = 0.5;  // of an odometry sample

  InputWatch() { pairs_.reserve(kMaxPairs); }

  void on_odometry(const model::OdometrySample& sample) override;
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_clock_set() override;
  // What the filter did with a range that on_range() had before.
  void note(const model::RangeSample& range, const filter::RangeResult& result) noexcept;

  // Since the start, without signs: distance and angle.
  [[nodiscard]] double driven_m() const noexcept { return driven_m_; }
  [[nodiscard]] double turned_rad() const noexcept { return turned_rad_; }
  // The pairs that had a range within kShown_s before the newest one, by tag and anchor.
  [[nodiscard]] std::vector<PairStatus> pairs() const;

 private:
  // Null if there are too many.
  [[nodiscard]] PairStatus* find(const model::RangeSample& range, bool adds) noexcept;

  std::optional<model::OdometrySample> last_;
  double driven_m_ = 0.0;
  double turned_rad_ = 0.0;
  double newest_s_ = -std::numeric_limits<double>::infinity();
  std::vector<PairStatus> pairs_;
};

}  // namespace groma::daemon
