#include "host/filter/replay.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "host/filter/pose_measurement.hpp"

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

}  // namespace

bool is_chosen(const std::vector<model::NodeId>& ids, model::NodeId id) {
  return ids.empty() || std::find(ids.begin(), ids.end(), id) != ids.end();
}

ReplayResult replay(const Run& run, const ReplayOptions& options) {
  std::vector<model::Tag> tags;
  for (const model::Tag& tag : run.tags) {
    if (is_chosen(options.tags, tag.id)) tags.push_back(tag);
  }
  const auto filter = std::make_unique<Filter>(*run.surface, tags, *run.calibration, options.config);

  const double from_s = options.start.t_s;
  const double to_s = options.to_s.value_or(std::numeric_limits<double>::infinity());
  const auto earlier = [](const auto& sample, double t_s) { return sample.t_s < t_s; };
  auto row = std::lower_bound(run.odometry.begin(), run.odometry.end(), from_s, earlier);
  auto range = std::lower_bound(run.ranges.begin(), run.ranges.end(), from_s, earlier);
  // The row that holds at the start.
  if (row != run.odometry.begin() && (row == run.odometry.end() || row->t_s > from_s)) {
    filter->process(*std::prev(row));
  }
  filter->start(options.start);

  ReplayResult result;
  std::vector<double> propagate_ns;
  std::vector<double> update_ns;
  double nis_sum = 0.0;
  const auto timed = [&](std::vector<double>& durations, const auto& sample) {
    const std::int64_t begin = options.now_ns ? options.now_ns() : 0;
    const auto outcome = filter->process(sample);
    if (options.now_ns) durations.push_back(static_cast<double>(options.now_ns() - begin));
    return outcome;
  };

  const auto take_ranges_up_to = [&](double t_s) {
    for (; range != run.ranges.end() && range->t_s <= t_s; ++range) {
      if (!is_chosen(options.tags, range->tag_id) || !is_chosen(options.anchors, range->anchor_id)) continue;
      ++result.ranges_seen;
      const RangeResult update = timed(update_ns, *range);
      if (update.outcome == RangeOutcome::kUsed) nis_sum += update.nis;
    }
  };

  for (; row != run.odometry.end() && row->t_s <= to_s; ++row) {
    take_ranges_up_to(std::nextafter(row->t_s, -std::numeric_limits<double>::infinity()));
    timed(propagate_ns, *row);
    take_ranges_up_to(row->t_s);
    const Estimate estimate = filter->estimate();
    result.rows.push_back({.t_s = row->t_s,
                           .x_m = estimate.pose.x_m,
                           .y_m = estimate.pose.y_m,
                           .yaw_rad = estimate.pose.theta_rad,
                           .covariance = estimate.covariance});
  }

  result.counters = filter->counters();
  if (result.counters.ranges_used > 0) nis_sum /= static_cast<double>(result.counters.ranges_used);
  result.nis_mean = nis_sum;
  result.propagate_ns = percentiles(propagate_ns);
  result.update_ns = percentiles(update_ns);
  return result;
}

std::optional<Start> start_from_prior(std::span<const model::PoseSample> priors, double from_s,
                                      const model::Surface& surface) {
  const auto prior = std::find_if(priors.begin(), priors.end(),
                                  [from_s](const model::PoseSample& pose) { return pose.t_s >= from_s; });
  if (prior == priors.end()) return std::nullopt;
  return Start{.t_s = prior->t_s, .pose = {prior->x_m, prior->y_m, heading_on(surface, *prior)}};
}

}  // namespace groma::filter
