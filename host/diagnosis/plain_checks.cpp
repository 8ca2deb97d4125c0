#include "host/diagnosis/plain_checks.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <complex>
#include <cstddef>
#include <functional>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <utility>

#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/units.hpp"
#include "host/io/dataset.hpp"
#include "host/model/median.hpp"
#include "host/model/pose.hpp"

namespace groma::diagnosis {
namespace {

// By hand: fewer samples of a table say nothing about its times.
constexpr std::size_t kMinSamples = 20;

// The times of one table.
struct Times {
  std::string_view name;
  double begin_s = 0.0;
  double end_s = 0.0;
  double interval_s = 0.0;  // median of the mean over some samples

  [[nodiscard]] double span_s() const noexcept { return end_s - begin_s; }
};

template <class Sample>
void add_times(std::string_view name, const std::vector<Sample>& samples, std::vector<Times>& out) {
  if (samples.size() < kMinSamples) return;
  // By hand: ranges may come in bursts, whose times differ by microseconds.
  const std::size_t some = std::min<std::size_t>(samples.size() / 2, 100);
  std::vector<double> intervals_s;
  for (std::size_t i = some; i < samples.size(); ++i)
    intervals_s.push_back((samples[i].t_s - samples[i - some].t_s) / static_cast<double>(some));
  const double interval_s = model::median(std::move(intervals_s));
  if (interval_s > 0.0) out.push_back({name, samples.front().t_s, samples.back().t_s, interval_s});
}

template <class Sample>
void scale_times(std::vector<Sample>& samples, double factor) {
  for (Sample& sample : samples) sample.t_s /= factor;
}

void scale_times(Data& data, std::string_view name, double factor) {
  if (name == "poses") scale_times(data.poses, factor);
  if (name == "odometry") scale_times(data.odometry, factor);
  if (name == "ranges") {
    scale_times(data.ranges, factor);
    scale_times(data.dropped_ranges, factor);
  }
}

std::vector<Times> times_of(const Data& data) {
  std::vector<Times> out;
  add_times("poses", data.poses, out);
  add_times("odometry", data.odometry, out);
  add_times("ranges", data.ranges, out);
  return out;
}

// A table in milliseconds lasts a thousand times as long as the others. By hand: tables of one drive differ
// by less than a factor of 10 in duration, and units by at least 1000.
constexpr double kSpanTolerance = 9.0;
// By hand: no robot reports both its motion and its ranges more rarely than this, so that if the intervals of
// all tables are longer, they are in another unit.
constexpr double kLongestInterval_s = 0.5;

// That of all tables, if none of them is in seconds.
std::optional<Unit> common_time_unit(std::span<const Times> all) {
  double shortest_s = std::numeric_limits<double>::infinity();
  for (const Times& of : all) shortest_s = std::min(shortest_s, of.interval_s);
  if (all.empty() || shortest_s < kLongestInterval_s) return std::nullopt;
  const auto unit = std::find_if(kTimeUnits.begin(), kTimeUnits.end(),
                                 [&](const Unit& of) { return shortest_s / of.factor < kLongestInterval_s; });
  return unit != kTimeUnits.end() ? std::optional(*unit) : std::nullopt;
}

std::optional<Unit> time_unit(const Times& of, std::span<const Times> all) {
  const auto shortest = std::min_element(
      all.begin(), all.end(), [](const Times& a, const Times& b) { return a.span_s() < b.span_s(); });
  return unit_of(kTimeUnits, of.span_s() / shortest->span_s(), kSpanTolerance);
}

// A place at a time; none where it is unknown.
using PlaceAt = std::function<std::optional<Eigen::Vector2d>(double t_s)>;

// Of the poses.
PlaceAt places_of(const std::vector<model::PoseSample>& poses) {
  return [&poses](double t_s) -> std::optional<Eigen::Vector2d> {
    const auto next = std::upper_bound(poses.begin(), poses.end(), t_s,
                                       [](double t, const model::PoseSample& pose) { return t < pose.t_s; });
    if (next == poses.begin() || next == poses.end()) return std::nullopt;
    const model::PoseSample& from = *std::prev(next);
    const double fraction = (t_s - from.t_s) / (next->t_s - from.t_s);
    return Eigen::Vector2d(from.x_m + fraction * (next->x_m - from.x_m),
                           from.y_m + fraction * (next->y_m - from.y_m));
  };
}

// On the odometry's way, stretched out, so that its yaw rate does not matter.
PlaceAt places_on_way(const std::vector<model::OdometrySample>& odometry) {
  std::vector<std::pair<double, double>> way;  // time, distance
  double way_m = 0.0;
  for (std::size_t i = 0; i < odometry.size(); ++i) {
    if (i > 0) {
      way_m += std::hypot(odometry[i - 1].vx_mps, odometry[i - 1].vy_mps) *
               (odometry[i].t_s - odometry[i - 1].t_s);
    }
    way.emplace_back(odometry[i].t_s, way_m);
  }
  return [way = std::move(way)](double t_s) -> std::optional<Eigen::Vector2d> {
    const auto next = std::upper_bound(way.begin(), way.end(), std::pair(t_s, 0.0),
                                       [](const auto& a, const auto& b) { return a.first < b.first; });
    if (next == way.begin() || next == way.end()) return std::nullopt;
    const auto& from = *std::prev(next);
    const double fraction = (t_s - from.first) / (next->first - from.first);
    return Eigen::Vector2d(from.second + fraction * (next->second - from.second), 0.0);
  };
}

// Change of a range over the distance that the robot moved meanwhile, at most 1 without noise: its quantile
// over all pairs. Changes over at least `step_m` are compared.
constexpr double kQuantile = 0.8;  // by hand
std::optional<double> range_change_ratio(const PlaceAt& place_at,
                                         const std::vector<model::RangeSample>& ranges, double step_m) {
  struct Last {
    Eigen::Vector2d position_m;
    double range_m;
  };
  std::map<std::pair<model::NodeId, model::NodeId>, Last> last;
  std::vector<double> ratios;
  for (const model::RangeSample& range : ranges) {
    const auto position_m = place_at(range.t_s);
    if (!position_m) continue;
    const auto [at, is_new] =
        last.try_emplace({range.tag_id, range.anchor_id}, Last{*position_m, range.range_m});
    const double moved_m = (*position_m - at->second.position_m).norm();
    if (is_new || moved_m < step_m) continue;
    ratios.push_back(std::abs(range.range_m - at->second.range_m) / moved_m);
    at->second = {*position_m, range.range_m};
  }
  if (ratios.size() < kMinSamples) return std::nullopt;
  const auto at =
      ratios.begin() + static_cast<std::ptrdiff_t>(kQuantile * static_cast<double>(ratios.size()));
  std::nth_element(ratios.begin(), at, ratios.end());
  return *at;
}

// The middle of the ratio over all runs.
constexpr double kTypicalRatio = 0.85;

// The ratio over steps of 2 true metres, so that the noise of a range matters little, although the places may
// be in feet or millimetres; over shorter ones where the robot does not go so far. By hand.
std::optional<double> range_change_ratio(const Data& data, const std::vector<model::RangeSample>& ranges) {
  const PlaceAt place_at = data.poses.empty() ? places_on_way(data.odometry) : places_of(data.poses);
  std::optional<double> ratio;
  double step_m = 0.0;
  for (const double tried_m : {2.0, 1.0, 0.5}) {
    step_m = tried_m;
    ratio = range_change_ratio(place_at, ranges, step_m);
    if (ratio) break;
  }
  for (int round = 0; round < 3 && ratio && *ratio > 0.0 && *ratio < 0.5 * kTypicalRatio; ++round) {
    const auto again = range_change_ratio(place_at, ranges, step_m * kTypicalRatio / *ratio);
    if (!again) break;
    ratio = again;
  }
  return ratio;
}

// How well the course over ground and the yaw agree: 1 if they differ by a constant, 0 if by anything.
double course_agreement(const std::vector<model::PoseSample>& poses, double unit) {
  std::complex<double> sum;
  double count = 0.0;
  std::size_t from = 0;
  for (std::size_t i = 1; i < poses.size(); ++i) {
    const double dx = poses[i].x_m - poses[from].x_m;
    const double dy = poses[i].y_m - poses[from].y_m;
    if (std::hypot(dx, dy) < 0.3) continue;  // by hand: ten times the noise of a pose
    const double yaw_rad = 0.5 * (poses[i].yaw_rad + poses[from].yaw_rad) / unit;
    if (std::abs(poses[i].yaw_rad - poses[from].yaw_rad) < 1.0 * unit) {  // not where it wraps
      sum += std::polar(1.0, std::atan2(dy, dx) - yaw_rad);
      count += 1.0;
    }
    from = i;
  }
  return count < static_cast<double>(kMinSamples) ? 0.0 : std::abs(sum) / count;
}

// Whether roll and pitch are too large for a ground robot, as most are in degrees.
bool are_tilts_in_degrees(const std::vector<model::PoseSample>& poses) {
  // By hand: robots drive on slopes of 0.3 rad.
  constexpr double kMostTilt_rad = 0.5;
  std::vector<double> tilts_rad;
  for (const model::PoseSample& pose : poses) {
    if (std::isfinite(pose.roll_rad) && std::isfinite(pose.pitch_rad))
      tilts_rad.push_back(std::max(std::abs(pose.roll_rad), std::abs(pose.pitch_rad)));
  }
  return tilts_rad.size() >= kMinSamples && model::median(std::move(tilts_rad)) > kMostTilt_rad;
}

}  // namespace

std::vector<Finding> find_unknown_nodes(const Data& data, const std::set<model::NodeId>& known_anchors,
                                        std::string_view where_anchors) {
  // By hand: damaged rows have ids of all kinds, each rarely.
  constexpr double kMinShare = 0.005;
  const double least =
      std::max(static_cast<double>(kMinSamples), kMinShare * static_cast<double>(data.ranges.size()));
  std::set<model::NodeId> known_tags;
  for (const model::Tag& tag : data.tags) known_tags.insert(tag.id);
  std::map<model::NodeId, std::size_t> tags;
  std::map<model::NodeId, std::size_t> anchors;
  const auto note = [&](const model::RangeSample& range) {
    if (!known_tags.contains(range.tag_id)) {
      ++tags[range.tag_id];
    } else if (!known_anchors.empty() && !known_anchors.contains(range.anchor_id)) {
      ++anchors[range.anchor_id];
    }
  };
  std::for_each(data.ranges.begin(), data.ranges.end(), note);
  std::for_each(data.dropped_ranges.begin(), data.dropped_ranges.end(), note);
  std::vector<Finding> findings;
  const auto report = [&](std::string_view cause, std::string_view kind, std::string_view where,
                          const std::map<model::NodeId, std::size_t>& heard) {
    std::vector<model::NodeId> ids;
    std::size_t ranges = 0;
    for (const auto& [id, count] : heard) {
      if (static_cast<double>(count) < least) continue;
      ids.push_back(id);
      ranges += count;
    }
    if (ids.empty()) return;
    findings.push_back({.cause = cause,
                        .evidence = fmt::format("{} ranges are of {} {}, which {} lacks", ranges, kind,
                                                fmt::join(ids, ", "), where),
                        .remedy = fmt::format("add it to {}, or correct the id that is wrong there", where),
                        .of = ids});
  };
  report("unknown-tag", "tag", "tags.csv", tags);
  report("unknown-anchor", "anchor", where_anchors, anchors);
  return findings;
}

std::vector<Finding> find_wrong_times(Data& data) {
  std::vector<Finding> findings;
  if (const std::vector<Times> given = times_of(data); const auto unit = common_time_unit(given)) {
    findings.push_back(
        {.cause = "time-unit",
         .evidence = fmt::format("all times are in {}: the {} last {:.4g}, sampled every {:.4g}", unit->name,
                                 given.front().name, given.front().span_s(), given.front().interval_s),
         .remedy = fmt::format("divide the column t_s of all tables by {:.0f}", unit->factor),
         .value = {unit->factor}});
    for (const Times& of : given) scale_times(data, of.name, unit->factor);
  }
  for (const Times& of : times_of(data)) {
    const std::vector<Times> all = times_of(data);
    const std::optional<Unit> unit = time_unit(of, all);
    if (!unit) continue;
    findings.push_back(
        {.cause = "time-unit",
         .evidence = fmt::format("the times of the {} are in {}: they last {:.4g}, sampled every {:.4g}",
                                 of.name, unit->name, of.span_s(), of.interval_s),
         .remedy = fmt::format("divide the column t_s of the {} by {:.0f}", of.name, unit->factor),
         .value = {unit->factor},
         .is_of_odometry_alone = of.name == "odometry"});
    scale_times(data, of.name, unit->factor);
  }
  // By hand: with less than half of a table, most of its samples have nothing to compare with.
  constexpr double kMinOverlap = 0.5;
  const std::vector<Times> all = times_of(data);
  for (std::size_t i = 0; i < all.size(); ++i) {
    for (std::size_t k = i + 1; k < all.size(); ++k) {
      const double both_s = std::min(all[i].end_s, all[k].end_s) - std::max(all[i].begin_s, all[k].begin_s);
      if (both_s > kMinOverlap * std::min(all[i].span_s(), all[k].span_s())) continue;
      findings.push_back(
          {.cause = "time-overlap",
           .evidence = fmt::format("{} are from {:.3f} to {:.3f} s, {} from {:.3f} to {:.3f} s", all[i].name,
                                   all[i].begin_s, all[i].end_s, all[k].name, all[k].begin_s, all[k].end_s),
           .remedy =
               "timestamp both with one clock, or subtract the difference of their epochs; check that they "
               "are of one drive"});
      return findings;
    }
  }
  return findings;
}

std::vector<Finding> find_wrong_lengths(Data& data) {
  std::vector<Finding> findings;
  std::set<model::NodeId> known;
  for (const model::Tag& tag : data.tags) known.insert(tag.id);
  std::vector<model::RangeSample> with_dropped;
  for (const model::RangeSample& range : data.dropped_ranges) {
    if (!known.contains(range.tag_id)) continue;
    if (with_dropped.empty()) with_dropped = data.ranges;
    with_dropped.push_back(range);
  }
  std::stable_sort(with_dropped.begin(), with_dropped.end(),
                   [](const auto& a, const auto& b) { return a.t_s < b.t_s; });
  const std::vector<model::RangeSample>& all = with_dropped.empty() ? data.ranges : with_dropped;
  const std::optional<double> ratio = range_change_ratio(data, all);
  // By hand: a range changes by 0.5 to 1.0 of the way (quantile of all runs: 0.66 to 0.97); feet are 3.3.
  constexpr double kTolerance = 0.45;
  if (!ratio) return findings;
  const auto report = [&](std::string_view what, const Unit& unit, std::string_view remedy) {
    findings.push_back(
        {.cause = "length-unit",
         .evidence =
             fmt::format("ranges change by {:.3g} of the distance that the robot moves: {} seem to be in {}",
                         *ratio, what, unit.name),
         .remedy = std::string(remedy),
         .value = {unit.factor}});
  };
  if (const auto unit = unit_of(kLengthUnits, *ratio / kTypicalRatio, kTolerance)) {
    report("the ranges", *unit, "give the column range_m in metres");
    std::vector<model::RangeSample> in_metres = all;
    for (model::RangeSample& range : in_metres) range.range_m /= unit->factor;
    std::erase_if(in_metres, [](const model::RangeSample& range) {
      return !(range.range_m > 0.0 && range.range_m <= io::kMaxRange_m);
    });
    data.ranges = std::move(in_metres);
  } else if (const auto of_motion = unit_of(kLengthUnits, kTypicalRatio / *ratio, kTolerance)) {
    if (data.poses.empty()) {
      report("the speeds of the odometry", *of_motion, "give vx_mps and vy_mps in metres per second");
      findings.back().is_of_odometry_alone = true;
      for (model::OdometrySample& sample : data.odometry) {
        sample.vx_mps /= of_motion->factor;
        sample.vy_mps /= of_motion->factor;
      }
      return findings;
    }
    report("the poses", *of_motion, "give the positions of the poses in metres");
    for (model::PoseSample& pose : data.poses) {
      pose.x_m /= of_motion->factor;
      pose.y_m /= of_motion->factor;
      pose.z_m /= of_motion->factor;
    }
  }
  return findings;
}

std::vector<Finding> find_long_lever_arms(const Data& data) {
  // By hand: no robot of this program is longer, and hardly one has a tag nearer to base_link than this.
  constexpr double kLongest_m = 20.0;
  constexpr double kShortest_m = 0.05;
  const double longest_m = longest_lever_arm_m(data.tags);
  if (!(longest_m > kLongest_m)) return {};
  const auto unit = std::find_if(kLengthUnits.rbegin(), kLengthUnits.rend(),
                                 [&](const Unit& of) { return longest_m / of.factor > kShortest_m; });
  return {lever_arms_in(*unit, fmt::format("a tag is {:.0f} m from base_link", longest_m))};
}

std::vector<Finding> find_wrong_angles(Data& data) {
  std::vector<Finding> findings;
  if (are_tilts_in_degrees(data.poses)) {
    findings.push_back({.cause = "angle-unit",
                        .evidence =
                            "roll and pitch of the poses are too large for a robot on the ground, unless "
                            "they are in degrees",
                        .remedy = "give the columns roll_rad and pitch_rad of the poses in radians",
                        .value = {kDegrees.factor}});
    for (model::PoseSample& pose : data.poses) {
      pose.roll_rad /= kDegrees.factor;
      pose.pitch_rad /= kDegrees.factor;
    }
  }
  double largest = 0.0;
  for (const model::PoseSample& pose : data.poses) largest = std::max(largest, std::abs(pose.yaw_rad));
  // By hand: a yaw in radians is within a turn and a bit, unless it counts turns.
  if (largest < 7.0) return findings;
  const double as_degrees = course_agreement(data.poses, kDegrees.factor);
  const double as_radians = course_agreement(data.poses, 1.0);
  if (as_degrees < as_radians + 0.2) return findings;  // by hand: random angles agree by below 0.1
  for (model::PoseSample& pose : data.poses) pose.yaw_rad = model::wrap_angle(pose.yaw_rad / kDegrees.factor);
  findings.push_back(
      {.cause = "angle-unit",
       .evidence = fmt::format(
           "the yaw of the poses reaches {:.0f}, and follows their course if it is in degrees", largest),
       .remedy = "give the column yaw_rad of the poses in radians",
       .value = {kDegrees.factor}});
  return findings;
}

std::vector<Finding> find_wrong_height(const Data& data) {
  std::vector<double> heights_m;
  for (const model::PoseSample& pose : data.poses) {
    if (!std::isfinite(pose.z_m)) continue;
    const int chart = data.surface.nearest(pose.x_m, pose.y_m, pose.z_m);
    heights_m.push_back(pose.z_m - data.surface.height_m(pose.x_m, pose.y_m, chart));
  }
  if (heights_m.size() < kMinSamples) return {};
  const double above_m = model::median(heights_m);
  for (double& height_m : heights_m) height_m = std::abs(height_m - above_m);
  const double spread_m = model::kSigmaOfMad * model::median(std::move(heights_m));
  // By hand: what varies by half as much as it is off is no offset, but another shape or a robot that is not
  // on the ground.
  if (std::abs(above_m) < kLeastHeight_m || spread_m > 0.5 * std::abs(above_m)) return {};
  return {{.cause = "surface-height",
           .evidence = fmt::format("the surface is {:.2f} m {} the poses (spread {:.2f} m)",
                                   std::abs(above_m), above_m > 0.0 ? "below" : "above", spread_m),
           .remedy = "correct the surface's height in dataset.yaml, or the poses' z: both are of base_link",
           .value = {-above_m},
           .sigma = {std::max(spread_m, kHeightSystematic_m)}}};
}

}  // namespace groma::diagnosis
