// A recorded run through the filter, as it would have gone on the robot.
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

// The run. Spans are sorted by time; everything outlives the call.
struct Run {
  std::span<const model::OdometrySample> odometry;
  std::span<const model::RangeSample> ranges;
  std::span<const model::Tag> tags;
  const model::Surface* surface = nullptr;
  const model::Calibration* calibration = nullptr;
  const model::SensorTables* sensors = nullptr;  // other sensors', where there are any
};

struct ReplayOptions {
  Config config;  // with the run's own sigmas
  Start start;    // start.t_s: rows and ranges before it are left out
  // False: of the start nothing but its time is known, and the pose is found from ranges and motion.
  bool knows_start = true;
  // Goes on from another place where the ranges tell of one, as Tracker does; so it does without a start.
  bool relocates = false;
  std::optional<double> to_s;
  // Is told of each range and what became of it, and of each row.
  std::function<void(const Tracker&, const model::RangeSample&, const RangeResult&)> on_range;
  std::function<void(const Tracker&, const model::OdometrySample&)> on_row;
  // A monotonic clock in nanoseconds, for the timing alone; empty: no timing.
  std::function<std::int64_t()> now_ns;
};

struct Percentiles {
  double p50 = 0.0;
  double p99 = 0.0;
};

struct ReplayResult {
  // One for each odometry row from the start on, or from where a pose was found: the state when everything up
  // to and at t_s is seen. yaw_rad is the heading on the surface.
  std::vector<model::PlanarEstimate> rows;
  struct RowState {
    State state = State::kUninitialized;
    Reason reason = Reason::kNone;
  };
  std::vector<RowState> states;  // of each row
  std::size_t relocations = 0;
  // When the tracker first named a map mismatch, and the share of ranges that contradicted the calibration
  // then. Of a run for which no pose was found no row says so.
  struct MapMismatch {
    double t_s = 0.0;
    double share = 0.0;
  };
  std::optional<MapMismatch> map_mismatch;
  std::vector<model::SpatialEstimate> spatial;  // of each row
  std::size_t ranges_seen = 0;                  // within the time
  Counters counters;
  double nis_mean = 0.0;  // over the ranges used
  // Wall times of one call each: of an odometry row (propagation to it), and of a range (propagation to
  // it and update). Zero without a clock.
  Percentiles propagate_ns;
  Percentiles update_ns;
};

[[nodiscard]] ReplayResult replay(const Run& run, const ReplayOptions& options);

// The first pose prior at or after from_s as a start, on the chart that is nearest to its height; none when
// there is none. One that no robot has is passed over. Where a pose
// tells roll and pitch, its heading on the surface is taken from its attitude.
[[nodiscard]] std::optional<Start> start_from_prior(std::span<const model::PoseSample> priors, double from_s,
                                                    const model::Surface& surface);

}  // namespace groma::filter
