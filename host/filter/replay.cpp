#include "host/filter/replay.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "host/filter/sensors.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

Percentiles percentiles(std::vector<double>& values) {
  if (values.empty()) return {};
  const auto at = [&](double share) {
    const auto rank = static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
    std::nth_element(values.begin(), values.begin() + rank, values.end());
    return values[static_cast<std::size_t>(rank)];
  };
  return {at(0.50), at(0.99)};
}

constexpr double kNoneLeft_s = std::numeric_limits<double>::infinity();

// The samples of all sensors by time; for equal times in the order of the sensors.
std::vector<model::SensorSample> merged(const model::SensorTables* tables) {
  std::vector<model::SensorSample> out;
  if (tables == nullptr) return out;
  std::apply([&](const auto&... table) { (out.insert(out.end(), table.begin(), table.end()), ...); },
             *tables);
  std::stable_sort(out.begin(), out.end(),
                   [](const auto& a, const auto& b) { return model::time_of(a) < model::time_of(b); });
  return out;
}

// Records the state for the odometry sample at t_s.
void record(const Tracker& tracker, const model::Surface& surface, double t_s, ReplayResult& result) {
  const Estimate estimate = tracker.estimate();
  result.rows.push_back({.t_s = t_s,
                         .x_m = estimate.pose.x_m,
                         .y_m = estimate.pose.y_m,
                         .yaw_rad = estimate.pose.theta_rad,
                         .covariance = estimate.covariance});
  result.states.push_back({tracker.state(), tracker.reason()});
  result.spatial.push_back(model::on_surface(surface, estimate.pose, estimate.covariance_with_ground()));
}

}  // namespace

ReplayResult replay(const Run& run, const ReplayOptions& options) {
  TrackerConfig config;
  config.relocates = options.relocates || !options.knows_start;
  // A run's times are in order: a jump is a gap in the recording, not a clock step.
  config.clock_step_s = std::numeric_limits<double>::infinity();
  const auto tracker =
      std::make_unique<Tracker>(*run.surface, run.tags, *run.calibration, options.config, config);

  const double from_s = options.start.t_s;
  const double to_s = options.to_s.value_or(std::numeric_limits<double>::infinity());
  const auto from = [from_s](const auto& samples) {
    return std::lower_bound(samples.begin(), samples.end(), from_s,
                            [](const auto& sample, double t_s) { return sample.t_s < t_s; });
  };
  auto odometry = from(run.odometry);
  auto range = from(run.ranges);
  const std::vector<model::SensorSample> sensor_samples = merged(run.sensors);
  auto sensor = std::lower_bound(sensor_samples.begin(), sensor_samples.end(), from_s,
                                 [](const auto& sample, double t_s) { return model::time_of(sample) < t_s; });
  // The odometry sample held at the start.
  if (odometry != run.odometry.begin() && (odometry == run.odometry.end() || odometry->t_s > from_s)) {
    tracker->process(*std::prev(odometry));
  }
  if (options.knows_start) tracker->start(options.start);

  ReplayResult result;
  const auto most_rows = static_cast<std::size_t>(run.odometry.end() - odometry);
  result.rows.reserve(most_rows);
  result.states.reserve(most_rows);
  result.spatial.reserve(most_rows);
  std::vector<double> propagate_ns;
  std::vector<double> update_ns;
  const auto timed = [&](std::vector<double>& durations, const auto& sample) {
    const std::int64_t begin = options.now_ns ? options.now_ns() : 0;
    auto outcome = tracker->process(sample);
    if (options.now_ns) durations.push_back(static_cast<double>(options.now_ns() - begin));
    return outcome;
  };

  const auto take_range = [&](const model::RangeSample& sample) {
    ++result.ranges_seen;
    const RangeResult update = timed(update_ns, sample);
    if (options.on_range) options.on_range(*tracker, sample, update);
    if (tracker->reason() == Reason::kMapMismatch && !result.map_mismatch)
      result.map_mismatch = {.t_s = sample.t_s, .share = tracker->map_watch().share()};
  };
  const auto take_up_to = [&](double t_s) {
    while (true) {
      // The earliest one; for equal times ranges first, as in OrderedFilter's order.
      const double range_s = range != run.ranges.end() ? range->t_s : kNoneLeft_s;
      const double sensor_s = sensor != sensor_samples.end() ? model::time_of(*sensor) : kNoneLeft_s;
      if (!(std::min(range_s, sensor_s) <= t_s)) return;
      if (range_s <= sensor_s) {
        take_range(*range++);
      } else {
        tracker->process(*sensor++);
      }
    }
  };

  for (; odometry != run.odometry.end() && odometry->t_s <= to_s; ++odometry) {
    take_up_to(std::nextafter(odometry->t_s, -std::numeric_limits<double>::infinity()));
    timed(propagate_ns, *odometry);
    take_up_to(odometry->t_s);
    if (options.on_odometry) options.on_odometry(*tracker, *odometry);
    if (tracker->started()) record(*tracker, *run.surface, odometry->t_s, result);
  }

  result.relocations = tracker->relocations();
  result.counters = tracker->filter().counters();
  result.propagate_ns = percentiles(propagate_ns);
  result.update_ns = percentiles(update_ns);
  return result;
}

std::optional<Start> start_from_prior(std::span<const model::PoseSample> priors, double from_s,
                                      const model::Surface& surface) {
  const auto prior = std::find_if(priors.begin(), priors.end(), [from_s](const model::PoseSample& pose) {
    return pose.t_s >= from_s && model::is_plausible(pose);
  });
  if (prior == priors.end()) return std::nullopt;
  return Start{.t_s = prior->t_s, .pose = place_on(surface, *prior)};
}

}  // namespace groma::filter
