// The filter for inputs in any order: what comes late by less than the window has the effect that it would
// have had in time, to the last bit. Memory and the time of each call are bounded.
//
// Inputs of the window are kept, and the filter as it was at some instants of it. A late one is put in its
// place, and the filter goes on from the instant before it. Inputs of one time are taken in an order of their
// own: starts, odometry, ranges by tag, anchor and value, then those of other sensors.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <variant>
#include <vector>

#include "host/filter/config.hpp"
#include "host/filter/filter.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

class OrderedFilter {
 public:
  // Inputs that are kept; where more come within the window, it is shorter.
  static constexpr std::size_t kMaxInputs = 4096;
  static constexpr std::size_t kMaxCheckpoints = 8;

  // As Filter's; window_s: by how much an input may be older than the newest one.
  OrderedFilter(model::Surface surface, std::span<const model::Tag> tags,
                const model::Calibration& calibration, const Config& config, double window_s = 0.5);

  // False, and nothing done, where it comes too late.
  bool start(const Start& start) noexcept;
  // As Filter's; what is older than the other's newest input is refused from then on.
  void resume(const OrderedFilter& other) noexcept;
  // As Filter's; inputs of any time are taken after it.
  void stop() noexcept;
  // kOutOfOrder: too late, and refused.
  OdometryOutcome process(const model::OdometrySample& row) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  SensorResult process(const model::SensorSample& sample) noexcept;

  // As of the newest input.
  [[nodiscard]] Estimate estimate() const noexcept { return filter_.estimate(); }
  // Right after a row of odometry was taken: as of that row, which is estimate() unless it came late.
  [[nodiscard]] Estimate row_estimate() const noexcept { return late_row_ ? *late_row_ : estimate(); }
  [[nodiscard]] bool started() const noexcept { return filter_.started(); }
  // Each input once, as it counts by now: what came late may have changed what became of others.
  [[nodiscard]] Counters counters() const noexcept;
  // Inputs that were put before others.
  [[nodiscard]] std::size_t reordered() const noexcept { return reordered_; }
  [[nodiscard]] const Filter& filter() const noexcept { return filter_; }

 private:
  using Input = std::variant<Start, model::OdometrySample, model::RangeSample, model::SensorSample>;
  // The filter before the input of that number; inputs are numbered in their order.
  struct Checkpoint {
    Filter::Snapshot filter;
    std::uint64_t next = 0;
    double t_s = 0.0;
  };
  struct Outcome {
    bool taken = false;
    OdometryOutcome odometry = OdometryOutcome::kOutOfOrder;
    RangeResult range{.outcome = RangeOutcome::kOutOfOrder};
    SensorResult sensor{.outcome = SensorOutcome::kOutOfOrder};
  };

  Outcome insert(const Input& input) noexcept;
  Outcome apply(const Input& input) noexcept;
  void check_in_when_due(std::uint64_t next, double t_s) noexcept;
  void check_in(std::uint64_t next, double t_s) noexcept;
  void drop_checkpoint() noexcept;  // the oldest
  void forget() noexcept;
  // All inputs, too: the filter as it is now is of that time, and what there is.
  void begin(double newest_s) noexcept;
  [[nodiscard]] Checkpoint& checkpoint(std::size_t i) noexcept {
    return checkpoints_[(first_checkpoint_ + i) % kMaxCheckpoints];
  }

  Filter filter_;
  double window_s_;
  std::vector<Input> inputs_;            // in order; never grows beyond what is reserved
  std::uint64_t first_ = 0;              // number of inputs_.front()
  std::vector<Checkpoint> checkpoints_;  // a ring
  std::size_t first_checkpoint_ = 0;
  std::size_t checkpoint_count_ = 0;
  double newest_s_;
  std::optional<Estimate> late_row_;  // where the last row came late
  Counters refused_;
  std::size_t reordered_ = 0;
};

}  // namespace groma::filter
