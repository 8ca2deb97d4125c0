// Replays a recorded run through the tracker, causally, as on the robot.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <vector>

#include "host/filter/config.hpp"
#include "host/filter/filter.hpp"
#include "host/filter/tracker.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// The run. Spans are sorted by time; all referenced data must outlive the call.
struct Run {
  std::span<const model::OdometrySample> odometry;
  std::span<const model::RangeSample> ranges;
  std::span<const model::Tag> tags;
  const model::Surface* surface = nullptr;
  const model::Calibration* calibration = nullptr;
  const model::SensorTables* sensors = nullptr;  // other sensors; null if there are none
};

struct ReplayOptions {
  Config config;  // with the run's own sigmas
  Start start;    // inputs before start.t_s are left out
  // False: only the start's time is used, and the pose is searched for from ranges and odometry.
  bool knows_start = true;
  // Whether the tracker may relocate (TrackerConfig::relocates); always true without a known start.
  bool relocates = false;
  std::optional<double> to_s;
  // Called after each range with its result, and after each odometry sample; may be empty.
  std::function<void(const Tracker&, const model::RangeSample&, const RangeResult&)> on_range;
  std::function<void(const Tracker&, const model::OdometrySample&)> on_odometry;
  // Monotonic clock in nanoseconds, used for the timing only; empty: no timing.
  std::function<std::int64_t()> now_ns;
};

struct Percentiles {
  double p50 = 0.0;
  double p99 = 0.0;
};

struct ReplayResult {
  // One estimate for each odometry sample from the start on, or from when a pose was found, with all inputs
  // up to and at t_s. yaw_rad is the heading on the surface.
  std::vector<model::PlanarEstimate> rows;
  struct RowState {
    State state = State::kUninitialized;
    Reason reason = Reason::kNone;
  };
  std::vector<RowState> states;  // of each row
  std::size_t relocations = 0;
  // When the tracker first reported a map mismatch, and the share of ranges that contradicted the calibration
  // then. `states` does not show it if no pose was found.
  struct MapMismatch {
    double t_s = 0.0;
    double share = 0.0;
  };
  std::optional<MapMismatch> map_mismatch;
  std::vector<model::SpatialEstimate> spatial;  // of each row
  std::size_t ranges_seen = 0;                  // from start.t_s to to_s
  Counters counters;
  // Wall times of one call: for an odometry sample (propagation to it), and for a range (propagation to it
  // and update). Zero without a clock.
  Percentiles propagate_ns;
  Percentiles update_ns;
};

[[nodiscard]] ReplayResult replay(const Run& run, const ReplayOptions& options);

// A start at the first plausible pose prior at or after from_s, on the chart nearest to its height; nullopt
// if there is none. If the pose has roll and pitch, the heading on the surface is computed from its attitude.
[[nodiscard]] std::optional<Start> start_from_prior(std::span<const model::PoseSample> priors, double from_s,
                                                    const model::Surface& surface);

}  // namespace groma::filter
