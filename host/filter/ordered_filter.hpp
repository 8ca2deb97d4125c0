// The filter for out-of-order inputs: an input that is late by less than the window has the same effect, bit
// for bit, as if it had come in time. Memory and the time of each call are bounded.
//
// The inputs of the window are kept in order, with checkpoints of the filter. A late input is inserted at its
// place, and the filter is replayed from the last checkpoint before it. Inputs with equal times are ordered:
// starts, odometry, ranges by tag, anchor and value, then other sensors.
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
  // Maximum number of inputs kept; if more come within the window, the window is shorter.
  static constexpr std::size_t kMaxInputs = 4096;
  static constexpr std::size_t kMaxCheckpoints = 8;

  // As Filter's; window_s: maximum age of an input, relative to the newest one. By hand: gromad delays inputs
  // by 0.2 s (reorder_lag_s); OrderedFilter.*.
  OrderedFilter(model::Surface surface, std::span<const model::Tag> tags,
                const model::Calibration& calibration, const Config& config, double window_s = 0.5);

  // Returns false and does nothing if the start is too late or implausible.
  bool start(const Start& start) noexcept;
  // As Filter's. Inputs older than the other's newest input are refused from then on.
  void resume(const OrderedFilter& other) noexcept;
  // As Filter's. Afterwards inputs of any time are accepted.
  void stop() noexcept;
  // kOutOfOrder: too late, refused.
  OdometryOutcome process(const model::OdometrySample& sample) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  SensorResult process(const model::SensorSample& sample) noexcept;

  // At the newest input.
  [[nodiscard]] Estimate estimate() const noexcept { return filter_.estimate(); }
  // Right after an odometry sample: the estimate at that sample's time. Equals estimate() unless it came
  // late.
  [[nodiscard]] Estimate sample_estimate() const noexcept {
    return late_sample_ ? *late_sample_ : estimate();
  }
  [[nodiscard]] bool started() const noexcept { return filter_.started(); }
  // Each input counted once by its current outcome: late inputs may have changed the outcomes of others.
  [[nodiscard]] Counters counters() const noexcept;
  // Number of inputs that were inserted before others.
  [[nodiscard]] std::size_t reordered() const noexcept { return reordered_; }
  [[nodiscard]] const Filter& filter() const noexcept { return filter_; }

  // As Filter's.
  void archive(model::StateArchive& state) {
    state(filter_, inputs_, first_, first_checkpoint_, checkpoint_count_, newest_s_, late_sample_, refused_,
          reordered_);
    for (std::size_t i = 0; i < checkpoint_count_; ++i) {
      Checkpoint& at = checkpoint(i);
      state(at.filter, at.next, at.t_s);
    }
  }

 private:
  using Input = std::variant<Start, model::OdometrySample, model::RangeSample, model::SensorSample>;
  // The filter before input number `next`; inputs are numbered in their order.
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
  // Forgets all inputs and checkpoints: the filter's current state, at that time, is the only one.
  void begin(double newest_s) noexcept;
  [[nodiscard]] Checkpoint& checkpoint(std::size_t i) noexcept {
    return checkpoints_[(first_checkpoint_ + i) % kMaxCheckpoints];
  }

  Filter filter_;
  double window_s_;
  std::vector<Input> inputs_;            // in order; never exceeds the reserved capacity
  std::uint64_t first_ = 0;              // number of inputs_.front()
  std::vector<Checkpoint> checkpoints_;  // ring buffer
  std::size_t first_checkpoint_ = 0;
  std::size_t checkpoint_count_ = 0;
  double newest_s_;
  std::optional<Estimate> late_sample_;  // if the last odometry sample came late
  Counters refused_;
  std::size_t reordered_ = 0;
};

}  // namespace groma::filter
