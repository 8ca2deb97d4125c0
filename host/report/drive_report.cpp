#include "host/report/drive_report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <numbers>
#include <numeric>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/report/series.hpp"
#include "host/report/site.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;
using model::PlanarEstimate;

// A line breaks where its samples are farther apart.
constexpr double kGap_s = 1.0;
// More samples than a screen can show, at any zoom that is of use.
constexpr double kMostSamples = 6000.0;

double duration_s(std::span<const PlanarEstimate> rows) {
  return rows.back().t_s - rows.front().t_s;
}

double way_m(std::span<const PlanarEstimate> rows) {
  double sum_m = 0.0;
  for (std::size_t i = 1; i < rows.size(); ++i)
    sum_m += std::hypot(rows[i].x_m - rows[i - 1].x_m, rows[i].y_m - rows[i - 1].y_m);
  return sum_m;
}

// One of the samples in each of kMostSamples intervals: the one with the largest value by `size`.
template <class Samples, class Size>
std::vector<typename Samples::value_type> thinned(const Samples& samples, const Size& size) {
  std::vector<typename Samples::value_type> kept;
  if (samples.empty()) return kept;
  const double step_s = (samples.back().t_s - samples.front().t_s) / kMostSamples;
  double end_s = -std::numeric_limits<double>::infinity();
  for (const auto& sample : samples) {
    if (sample.t_s < end_s) {
      if (size(sample) > size(kept.back())) kept.back() = sample;
      continue;
    }
    kept.push_back(sample);
    end_s = sample.t_s + step_s;
  }
  return kept;
}

template <class Poses>
std::vector<Eigen::Vector3d> path_of(const Poses& poses) {
  std::vector<Eigen::Vector3d> path;
  double last_s = kNone;
  for (const auto& pose : thinned(poses, [](const auto& /*pose*/) { return 0.0; })) {
    if (pose.t_s - last_s > kGap_s) path.emplace_back(kNone, kNone, pose.t_s);
    path.emplace_back(pose.x_m, pose.y_m, pose.t_s);
    last_s = pose.t_s;
  }
  return path;
}

}  // namespace

// Start, end, and arrows in the direction of travel at equal distances along the way.
void add_course(Chart& map, std::span<const PlanarEstimate> rows, Ink ink) {
  constexpr int kArrows = 16;
  constexpr double kLeastStep_m = 0.5;
  const double step_m = std::max(way_m(rows) / kArrows, kLeastStep_m);
  std::vector<Mark> arrows;
  double travelled_m = 0.0;
  double next_m = 0.5 * step_m;
  for (std::size_t i = 1; i < rows.size(); ++i) {
    const Vector2d move(rows[i].x_m - rows[i - 1].x_m, rows[i].y_m - rows[i - 1].y_m);
    travelled_m += move.norm();
    if (travelled_m < next_m) continue;
    next_m += step_m;
    arrows.push_back({.at = {rows[i].x_m, rows[i].y_m},
                      .label = "",
                      .hint = fmt::format("{:.1f} s", rows[i].t_s),
                      .turn_rad = std::atan2(move.y(), move.x())});
  }
  map.add_marks("direction", ink, std::move(arrows), Shape::kArrow);
  const auto end = [](const PlanarEstimate& row, const char* name) {
    return std::vector<Mark>{
        {.at = {row.x_m, row.y_m}, .label = name, .hint = fmt::format("{} {:.1f} s", name, row.t_s)}};
  };
  map.add_marks("", ink, end(rows.front(), "start"), Shape::kStart);
  map.add_marks("", ink, end(rows.back(), "end"), Shape::kEnd);
}

namespace {

void add_map(Page& page, const DriveView& view) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 640.0});
  if (!view.truth.empty()) {
    const auto during = [&](const model::PoseSample& pose) {
      return pose.t_s >= view.rows.front().t_s && pose.t_s <= view.rows.back().t_s;
    };
    std::vector<model::PoseSample> truth;
    std::copy_if(view.truth.begin(), view.truth.end(), std::back_inserter(truth), during);
    map.add_path("truth", Ink::kTruth, path_of(truth), Stroke::kBroad);
  }
  map.add_path("estimate", Ink::kEstimate, path_of(view.rows));
  constexpr double kEllipses = 60.0;
  std::vector<Ellipse> ellipses;
  double next_s = -std::numeric_limits<double>::infinity();
  for (const PlanarEstimate& row : view.rows) {
    if (row.t_s < next_s) continue;
    next_s = row.t_s + std::max(duration_s(view.rows) / kEllipses, 1.0);
    ellipses.push_back({{row.x_m, row.y_m}, row.covariance.topLeftCorner<2, 2>()});
  }
  map.add_ellipses("95 % of the estimate", Ink::kEstimate, std::move(ellipses));
  add_course(map, view.rows, Ink::kEstimate);
  if (view.calibration != nullptr) add_anchors(map, *view.calibration);
  page.add_chart(map, "The drive from above.");
}

Ink state_ink(const std::string& state) {
  if (state == "TRACKING") return Ink::kGood;
  if (state == "DEGRADED") return Ink::kWarning;
  if (state == "LOST") return Ink::kBad;
  return state == "CONVERGING" ? Ink::kSeries1 : Ink::kOther;
}

std::string words(const StateSpan& span) {
  return span.reason.empty() ? span.state : fmt::format("{} ({})", span.state, span.reason);
}

void add_bands(Chart& chart, const std::vector<StateSpan>& states, bool with_tracking) {
  std::map<std::string, std::vector<Span>> bands;
  for (const StateSpan& span : states) {
    if (span.state == "TRACKING" && !with_tracking) continue;
    bands[span.state].push_back(
        {span.from_s, span.to_s,
         fmt::format("{} from {:.1f} to {:.1f} s", words(span), span.from_s, span.to_s)});
  }
  for (auto& [state, spans] : bands) chart.add_bands(state, state_ink(state), std::move(spans));
}

void add_states(Page& page, const std::vector<StateSpan>& states) {
  if (states.empty()) return;
  Chart chart({.title = "State",
               .x_label = "time (s)",
               .over_time = true,
               .height_px = 34.0,
               .y_range = Vector2d(0.0, 1.0)});
  add_bands(chart, states, true);
  page.add_chart(chart, "");
}

// The row at or before t_s.
const PlanarEstimate& row_at(std::span<const PlanarEstimate> rows, double t_s) {
  const auto after = std::upper_bound(rows.begin(), rows.end(), t_s,
                                      [](double t, const PlanarEstimate& row) { return t < row.t_s; });
  return after == rows.begin() ? *after : *std::prev(after);
}

double radius_95_m(const PlanarEstimate& row) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(row.covariance.topLeftCorner<2, 2>(),
                                                             Eigen::EigenvaluesOnly);
  return std::sqrt(kChiSquare95 * eigen.eigenvalues().y());
}

Chart::Axes over_time(const char* title, const char* y_label) {
  return {.title = title, .x_label = "time (s)", .y_label = y_label, .over_time = true, .height_px = 240.0};
}

Chart::Axes small(Chart::Axes axes) {
  axes.width_px = 345.0;
  axes.height_px = 190.0;
  return axes;
}

// A line over time that breaks at gaps.
class TimeLine {
 public:
  void add(double t_s, double value) {
    if (t_s - last_s_ > kGap_s) points_.emplace_back(t_s, kNone);
    points_.emplace_back(t_s, value);
    last_s_ = t_s;
  }
  [[nodiscard]] std::vector<Vector2d> take() { return std::move(points_); }

 private:
  std::vector<Vector2d> points_;
  double last_s_ = kNone;
};

// Without a truth, the estimate's own uncertainty.
void add_sigmas(Page& page, const DriveView& view) {
  TimeLine radius_m;
  TimeLine heading_rad;
  for (const PlanarEstimate& row : thinned(view.rows, radius_95_m)) {
    radius_m.add(row.t_s, radius_95_m(row));
    heading_rad.add(row.t_s, 2.0 * std::sqrt(row.covariance(2, 2)));
  }
  Chart::Axes position_axes = over_time("Uncertainty of the position", "95 % radius (m)");
  Chart::Axes heading_axes = over_time("Uncertainty of the heading", "2 sigma (rad)");
  position_axes.log_y = heading_axes.log_y = true;
  heading_axes.height_px = 160.0;
  Chart position(position_axes);
  add_bands(position, view.states, false);
  position.add_line("95 % radius of the estimate", Ink::kEstimate, radius_m.take());
  Chart heading(heading_axes);
  heading.add_line("2 sigma of the heading", Ink::kEstimate, heading_rad.take());
  page.add_heading("Uncertainty");
  page.add_chart(position, "");
  page.add_chart(heading, "There is no truth to compare with.");
}

void add_errors(Page& page, const DriveView& view, const std::vector<evaluation::PoseError>& errors) {
  const auto shown = thinned(errors, [](const evaluation::PoseError& e) { return std::hypot(e.x_m, e.y_m); });
  TimeLine distance_m;
  TimeLine radius_m;
  struct Axis {
    const char* title;
    const char* label;
    double evaluation::PoseError::*error;
    int index;
  };
  constexpr std::array kAxes{Axis{"Error along x", "error (m)", &evaluation::PoseError::x_m, 0},
                             Axis{"Error along y", "error (m)", &evaluation::PoseError::y_m, 1},
                             Axis{"Error of the heading", "error (rad)", &evaluation::PoseError::yaw_rad, 2}};
  std::array<std::array<TimeLine, 3>, 3> along;
  for (const evaluation::PoseError& error : shown) {
    const PlanarEstimate& row = row_at(view.rows, error.t_s);
    distance_m.add(error.t_s, std::hypot(error.x_m, error.y_m));
    radius_m.add(error.t_s, radius_95_m(row));
    for (std::size_t i = 0; i < kAxes.size(); ++i) {
      const double sigma = std::sqrt(row.covariance(kAxes[i].index, kAxes[i].index));
      along[i][0].add(error.t_s, error.*kAxes[i].error);
      along[i][1].add(error.t_s, 2.0 * sigma);
      along[i][2].add(error.t_s, -2.0 * sigma);
    }
  }
  Chart::Axes axes = over_time("Position error", "error (m)");
  axes.log_y = true;
  Chart chart(axes);
  add_bands(chart, view.states, false);
  chart.add_line("95 % radius of the estimate", Ink::kSeries2, radius_m.take());
  chart.add_line("error", Ink::kEstimate, distance_m.take());
  page.add_heading("Errors against their sigmas");
  page.add_chart(chart, "A consistent estimate is within its radius for at least 95 % of the time.");
  std::vector<Chart> charts;
  for (std::size_t i = 0; i < kAxes.size(); ++i) {
    Chart small_chart(small(over_time(kAxes[i].title, kAxes[i].label)));
    small_chart.add_line("error", Ink::kEstimate, along[i][0].take());
    small_chart.add_line("± 2 sigma", Ink::kSeries2, along[i][1].take());
    small_chart.add_line("", Ink::kSeries2, along[i][2].take());
    charts.push_back(std::move(small_chart));
  }
  page.add_charts(charts, "Estimate minus truth.");
}

void add_nees(Page& page, const std::vector<evaluation::PoseError>& errors) {
  TimeLine nees;
  bool is_any = false;
  for (const auto& error : thinned(errors, [](const auto& e) { return e.nees.value_or(0.0); })) {
    nees.add(error.t_s, error.nees.value_or(kNone));
    is_any = is_any || error.nees.has_value();
  }
  if (!is_any) return;
  Chart::Axes axes = over_time("NEES", "NEES / 3");
  axes.log_y = true;
  axes.height_px = 180.0;
  Chart chart(axes);
  const double from_s = errors.front().t_s;
  const double to_s = errors.back().t_s;
  const auto level = [&](double value) { return std::vector<Vector2d>{{from_s, value}, {to_s, value}}; };
  chart.add_line("NEES / 3", Ink::kEstimate, nees.take());
  chart.add_line("expected", Ink::kGood, level(1.0), Stroke::kDashed);
  chart.add_line("95 % are below", Ink::kSeries2, level(evaluation::kChiSquare95 / 3.0), Stroke::kDashed);
  page.add_chart(
      chart,
      "Squared error in units of its own covariance, divided by 3: above 1 for long, the estimate claims "
      "more than it knows; below, less.");
}

std::vector<model::NodeId> tags_of(const std::vector<RangeRow>& ranges) {
  std::vector<model::NodeId> tags;
  tags.reserve(ranges.size());
  for (const RangeRow& range : ranges) tags.push_back(range.tag_id);
  std::sort(tags.begin(), tags.end());
  tags.erase(std::unique(tags.begin(), tags.end()), tags.end());
  return tags;
}

std::map<model::NodeId, std::vector<RangeRow>> by_anchor(const std::vector<RangeRow>& ranges) {
  std::map<model::NodeId, std::vector<RangeRow>> anchors;
  for (const RangeRow& range : ranges) anchors[range.anchor_id].push_back(range);
  return anchors;
}

bool is_likely_los(const RangeRow& range) noexcept {
  return range.weight > 0.5;
}

// Ranges that are more likely LOS than not in their tag's colour with a line of medians, the others apart.
Chart innovation_chart(model::NodeId anchor, const std::vector<RangeRow>& ranges,
                       const std::vector<model::NodeId>& tags, const Vector2d& y_range,
                       const DriveView& view) {
  Chart::Axes axes = small({.title = fmt::format("Anchor {}", anchor),
                            .x_label = "time (s)",
                            .y_label = view.has_residuals ? "residual (m)" : "innovation (m)",
                            .over_time = true});
  axes.y_range = y_range;
  Chart chart(axes);
  std::map<model::NodeId, std::vector<Vector2d>> used;
  std::vector<Vector2d> light;
  for (const RangeRow& range : ranges) {
    (is_likely_los(range) ? used[range.tag_id] : light).emplace_back(range.t_s, range.innovation_m);
  }
  constexpr std::size_t kBins = 60;
  if (!light.empty()) chart.add_points("weight below 0.5", Ink::kOther, std::move(light));
  for (auto& [tag, points] : used) {
    const auto index =
        static_cast<std::size_t>(std::lower_bound(tags.begin(), tags.end(), tag) - tags.begin());
    const Ink ink = series_ink(index);
    std::vector<Vector2d> line = medians(points, view.rows.front().t_s, view.rows.back().t_s, kBins);
    chart.add_points("", ink, std::move(points));
    chart.add_line(fmt::format("tag {}", tag), ink, std::move(line));
  }
  return chart;
}

// 98 % of those, and at least 0.3 m to both sides.
Vector2d innovation_range(const std::vector<RangeRow>& ranges) {
  std::vector<double> values;
  values.reserve(ranges.size());
  for (const RangeRow& range : ranges) {
    if (is_likely_los(range)) values.push_back(range.innovation_m);
  }
  if (values.empty()) values.push_back(0.0);
  constexpr double kLeast_m = 0.3;
  return {std::min(-kLeast_m, 1.2 * quantile(values, 0.01)),
          std::max(kLeast_m, 1.2 * quantile(values, 0.99))};
}

void add_pair_table(Page& page, const DriveView& view) {
  std::map<std::pair<model::NodeId, model::NodeId>, std::vector<RangeRow>> pairs;
  for (const RangeRow& range : view.ranges) pairs[{range.anchor_id, range.tag_id}].push_back(range);
  std::vector<std::vector<Cell>> rows;
  for (const auto& [pair, ranges] : pairs) {
    std::vector<double> used_m;
    double nis = 0.0;
    Eigen::Vector3d correction = Eigen::Vector3d::Zero();
    for (const RangeRow& range : ranges) {
      correction += range.correction;
      if (!(view.has_residuals ? is_likely_los(range) : range.weight > 0.0)) continue;
      used_m.push_back(range.innovation_m);
      nis += model::square(range.innovation_m / range.sigma_m);
    }
    double square_m2 = 0.0;
    for (const double innovation_m : used_m) square_m2 += model::square(innovation_m);
    const double used = static_cast<double>(used_m.size());
    const auto number = [](double value, const char* format) {
      return Cell{std::isfinite(value) ? fmt::format(fmt::runtime(format), value) : "–"};
    };
    rows.push_back({{fmt::format("{}", pair.first)},
                    {fmt::format("{}", pair.second)},
                    {fmt::format("{}", ranges.size())},
                    number(100.0 * used / static_cast<double>(ranges.size()), "{:.0f} %"),
                    number(quantile(used_m, 0.5), "{:+.3f}"),
                    number(std::sqrt(square_m2 / used), "{:.3f}")});
    if (view.has_residuals) continue;
    rows.back().push_back(number(nis / used, "{:.2f}"));
    rows.back().push_back(number(100.0 * correction.x(), "{:+.1f}"));
    rows.back().push_back(number(100.0 * correction.y(), "{:+.1f}"));
  }
  std::vector<std::string> titles{"anchor",   "tag",  "ranges", view.has_residuals ? "LOS" : "used",
                                  "median m", "rms m"};
  if (!view.has_residuals) titles.insert(titles.end(), {"NIS", "correction x cm", "y cm"});
  page.begin_part("pairs", "Each pair of tag and anchor", "", Tone::kPlain, false);
  page.add_table(titles, rows);
  page.end_part();
}

void add_innovations(Page& page, const DriveView& view) {
  if (view.ranges.empty()) return;
  page.add_heading(view.has_residuals ? "Residuals of each pair" : "Innovations of each pair");
  const std::vector<model::NodeId> tags = tags_of(view.ranges);
  const Vector2d y_range = innovation_range(view.ranges);
  std::vector<Chart> charts;
  for (const auto& [anchor, ranges] : by_anchor(view.ranges))
    charts.push_back(innovation_chart(anchor, ranges, tags, y_range, view));
  page.add_charts(
      charts,
      view.has_residuals
          ? "Range minus the one that the smoothed pose and the calibration predict. Dots are ranges, "
            "lines their medians. A pair beside zero for long has a wrong bias or no line of sight."
          : "Range minus the predicted one, before the pose is corrected. Dots are ranges, lines their "
            "medians. A pair beside zero for long has a wrong bias or no line of sight; all pairs at "
            "once show a wrong pose.");
  add_pair_table(page, view);
}

struct AnchorCorrection {
  double sum_m = 0.0;  // of the lengths
  Eigen::Vector3d net = Eigen::Vector3d::Zero();
};

std::map<model::NodeId, AnchorCorrection> corrections(const std::vector<RangeRow>& ranges) {
  std::map<model::NodeId, AnchorCorrection> anchors;
  for (const RangeRow& range : ranges) {
    AnchorCorrection& anchor = anchors[range.anchor_id];
    anchor.sum_m += range.correction.head<2>().norm();
    anchor.net += range.correction;
  }
  return anchors;
}

std::vector<std::string> names_of(const std::map<model::NodeId, AnchorCorrection>& anchors) {
  std::vector<std::string> names;
  names.reserve(anchors.size());
  for (const auto& [anchor, of] : anchors) names.push_back(fmt::format("{}", anchor));
  return names;
}

void add_corrections(Page& page, const DriveView& view) {
  if (view.ranges.empty() || view.has_residuals) return;
  const auto anchors = corrections(view.ranges);
  std::vector<Bar> sums;
  std::vector<Bar> nets;
  double x = 0.0;
  for (const auto& [anchor, of] : anchors) {
    const double net_m = of.net.head<2>().norm();
    const std::string hint =
        fmt::format("anchor {}: corrections of {:.2f} m together, net {:.2f} m", anchor, of.sum_m, net_m);
    sums.push_back({x - 0.2, of.sum_m, hint});
    nets.push_back({x + 0.2, net_m, hint});
    x += 1.0;
  }
  Chart chart({.x_label = "anchor", .y_label = "correction of the position (m)", .height_px = 200.0});
  chart.name_x(names_of(anchors));
  chart.add_bars("sum of the lengths", Ink::kPath, std::move(sums), 0.36);
  chart.add_bars("net", Ink::kSeries1, std::move(nets), 0.36);
  page.add_heading("Corrections by anchor");
  page.add_chart(
      chart,
      "By how much the ranges of each anchor have moved the position. A net correction close to the sum is a "
      "steady pull to one side, which the other anchors undo: look at that anchor.");
}

void add_summary(Page& page, const DriveView& view, const std::optional<evaluation::Evaluation>& result) {
  std::vector<Fact> facts;
  if (result) {
    facts.push_back({fmt::format("{:.3f} m", result->ate_m.mean), "mean position error"});
    facts.push_back({fmt::format("{:.3f} m", result->ate_m.max), "largest position error"});
    facts.push_back({fmt::format("{:.4f} rad", result->ate_rad.mean), "mean heading error"});
    if (result->nees) {
      facts.push_back({fmt::format("{:.2f}", result->nees->mean), "mean NEES / 3; 1 is consistent"});
      facts.push_back(
          {fmt::format("{:.0f} %", 100.0 * result->nees->inside_95), "within the 95 % ellipsoid"});
    }
  }
  if (!view.states.empty()) {
    double tracking_s = 0.0;
    double all_s = 0.0;
    for (const StateSpan& span : view.states) {
      all_s += span.to_s - span.from_s;
      if (span.state == "TRACKING") tracking_s += span.to_s - span.from_s;
    }
    const double share = all_s > 0.0 ? tracking_s / all_s : 0.0;
    facts.push_back({fmt::format("{:.0f} %", 100.0 * share), "of the time TRACKING",
                     share > 0.9   ? Tone::kGood
                     : share > 0.5 ? Tone::kWarning
                                   : Tone::kBad});
  }
  if (!view.ranges.empty()) {
    // The smoother's weights are LOS probabilities.
    const double used =
        std::accumulate(view.ranges.begin(), view.ranges.end(), 0.0, [&](double sum, const RangeRow& range) {
          return sum + (view.has_residuals ? range.weight : range.weight > 0.0 ? 1.0 : 0.0);
        });
    facts.push_back(
        {fmt::format("{:.0f} %", 100.0 * used / static_cast<double>(view.ranges.size())),
         fmt::format("of {} ranges {}", view.ranges.size(), view.has_residuals ? "LOS" : "used")});
  }
  facts.push_back(
      {fmt::format("{:.0f} m", way_m(view.rows)), fmt::format("driven in {:.0f} s", duration_s(view.rows))});
  page.add_facts(facts);
}

}  // namespace

void add_drive(Page& page, const DriveView& view) {
  const std::vector<evaluation::PoseError> errors = evaluation::pose_errors(view.rows, view.truth);
  add_summary(page, view, evaluation::evaluate(errors));
  add_map(page, view);
  add_states(page, view.states);
  if (errors.empty()) {
    add_sigmas(page, view);
  } else {
    add_errors(page, view, errors);
    add_nees(page, errors);
  }
  add_innovations(page, view);
  add_corrections(page, view);
}

namespace {

// Lines from the pose to each anchor that answered.
void add_moment_map(Page& page, const MomentView& view) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 560.0});
  const PlanarEstimate& now = row_at(view.rows, view.at_s);
  const Vector2d place(now.x_m, now.y_m);
  std::vector<Vector2d> used;
  std::vector<Vector2d> rejected;
  for (const auto& [id, ranges] : by_anchor(view.ranges)) {
    const model::AnchorCalibration* anchor = model::find_anchor(*view.calibration, id);
    if (anchor == nullptr || !model::has_position(*anchor)) continue;
    const bool is_any =
        std::any_of(ranges.begin(), ranges.end(), [](const RangeRow& r) { return r.weight > 0.0; });
    std::vector<Vector2d>& lines = is_any ? used : rejected;
    lines.insert(lines.end(), {place, anchor->position_m.head<2>(), Vector2d::Constant(kNone)});
  }
  map.add_line("anchor whose ranges were used", Ink::kGood, std::move(used));
  if (!rejected.empty())
    map.add_line("anchor whose ranges were all rejected", Ink::kBad, std::move(rejected), Stroke::kDashed);
  map.add_path("estimate", Ink::kEstimate, path_of(view.rows));
  map.add_ellipses("95 % of the estimate", Ink::kEstimate, {{place, now.covariance.topLeftCorner<2, 2>()}});
  add_anchors(map, *view.calibration);
  map.add_marks(
      "pose and heading", Ink::kEstimate,
      {{.at = place,
        .label = "",
        .hint = fmt::format("x {:.3f} m\ny {:.3f} m\nheading {:.4f} rad", now.x_m, now.y_m, now.yaw_rad),
        .turn_rad = now.yaw_rad}},
      Shape::kArrow);
  page.add_chart(map, "The pose at that moment, and the anchors that answered within the window.");
}

// The pose relative to that of the moment, so that a jump is visible.
void add_moment_course(Page& page, const MomentView& view) {
  const PlanarEstimate& now = row_at(view.rows, view.at_s);
  struct Axis {
    const char* title;
    const char* label;
    double PlanarEstimate::*value;
    int index;
  };
  constexpr std::array kAxes{Axis{"x", "x since the moment (m)", &PlanarEstimate::x_m, 0},
                             Axis{"y", "y since the moment (m)", &PlanarEstimate::y_m, 1},
                             Axis{"Heading", "heading since the moment (rad)", &PlanarEstimate::yaw_rad, 2}};
  std::vector<Chart> charts;
  for (const Axis& axis : kAxes) {
    std::array<TimeLine, 3> lines;
    for (const PlanarEstimate& row : view.rows) {
      const double change = row.*axis.value - now.*axis.value;
      const double value = axis.index == 2 ? std::remainder(change, 2.0 * std::numbers::pi) : change;
      const double sigma = std::sqrt(row.covariance(axis.index, axis.index));
      lines[0].add(row.t_s, value);
      lines[1].add(row.t_s, value + 2.0 * sigma);
      lines[2].add(row.t_s, value - 2.0 * sigma);
    }
    Chart chart(small(over_time(axis.title, axis.label)));
    add_bands(chart, view.states, false);
    chart.add_bands("the moment", Ink::kSeries3, {{view.at_s, view.at_s, fmt::format("{} s", view.at_s)}});
    chart.add_line("estimate", Ink::kEstimate, lines[0].take());
    chart.add_line("± 2 sigma", Ink::kSeries2, lines[1].take());
    chart.add_line("", Ink::kSeries2, lines[2].take());
    charts.push_back(std::move(chart));
  }
  page.add_heading("The pose around that moment");
  page.add_charts(
      charts, "A jump within the lines of the time before it is a correction of what was uncertain then.");
}

// Of each pair the range nearest in time.
void add_moment_innovations(Page& page, const MomentView& view) {
  const std::vector<model::NodeId> tags = tags_of(view.ranges);
  std::vector<std::string> names;
  std::map<std::pair<std::size_t, bool>, std::pair<std::vector<Vector2d>, std::vector<double>>> groups;
  for (const auto& [anchor, ranges] : by_anchor(view.ranges)) {
    for (std::size_t i = 0; i < tags.size(); ++i) {
      const RangeRow* nearest = nullptr;
      for (const RangeRow& range : ranges) {
        if (range.tag_id != tags[i] || !std::isfinite(range.sigma_m)) continue;
        if (nearest == nullptr || std::abs(range.t_s - view.at_s) < std::abs(nearest->t_s - view.at_s))
          nearest = &range;
      }
      if (nearest == nullptr) continue;
      const double shift = 0.2 * (static_cast<double>(i) - 0.5 * static_cast<double>(tags.size() - 1));
      auto& [points, halves] = groups[{i, nearest->weight > 0.0}];
      points.emplace_back(static_cast<double>(names.size()) + shift, nearest->innovation_m);
      halves.push_back(2.0 * nearest->sigma_m);
    }
    names.push_back(fmt::format("{}", anchor));
  }
  Chart chart({.x_label = "anchor", .y_label = "innovation (m)", .height_px = 260.0});
  chart.name_x(std::move(names));
  for (auto& [group, values] : groups) {
    const auto& [tag, is_used] = group;
    chart.add_intervals(is_used ? fmt::format("tag {}", tags[tag]) : "rejected",
                        is_used ? series_ink(tag) : Ink::kBad, std::move(values.first),
                        std::move(values.second));
  }
  page.add_heading("Innovations");
  page.add_chart(
      chart,
      "Range minus the predicted one, of each pair the range nearest to the moment, with 2 sigma. Zero is "
      "within the bar where range and pose agree.");
}

void add_moment_corrections(Page& page, const MomentView& view) {
  const auto anchors = corrections(view.ranges);
  struct Axis {
    const char* title;
    const char* label;
    const char* unit;
    int index;
    double scale;
  };
  constexpr std::array kAxes{Axis{"x", "correction (cm)", "cm", 0, 100.0},
                             Axis{"y", "correction (cm)", "cm", 1, 100.0},
                             Axis{"Heading", "correction (mrad)", "mrad", 2, 1000.0}};
  std::vector<Chart> charts;
  for (const Axis& axis : kAxes) {
    std::vector<Bar> bars;
    for (const auto& [anchor, of] : anchors) {
      const double value = axis.scale * of.net[axis.index];
      bars.push_back({static_cast<double>(bars.size()), value,
                      fmt::format("anchor {}: {:+.2f} {}", anchor, value, axis.unit)});
    }
    Chart chart(small({.title = axis.title, .x_label = "anchor", .y_label = axis.label}));
    chart.name_x(names_of(anchors));
    chart.add_bars("", Ink::kSeries1, std::move(bars), 0.7);
    charts.push_back(std::move(chart));
  }
  page.add_heading("Corrections by anchor");
  page.add_charts(charts, "By how much the ranges of each anchor within the window have moved the pose.");
}

void add_moment_table(Page& page, const MomentView& view) {
  std::vector<std::vector<Cell>> rows;
  for (const RangeRow& range : view.ranges) {
    const bool is_judged = std::isfinite(range.sigma_m);
    const auto number = [&](const char* format, double value) {
      return Cell{is_judged ? fmt::format(fmt::runtime(format), value) : "–"};
    };
    rows.push_back({{fmt::format("{:.3f}", range.t_s)},
                    {fmt::format("{}", range.tag_id)},
                    {fmt::format("{}", range.anchor_id)},
                    {fmt::format("{:.3f}", range.range_m)},
                    number("{:+.3f}", range.innovation_m),
                    number("{:.3f}", range.sigma_m),
                    number("{:.2f}", range.weight),
                    number("{:+.2f}", 100.0 * range.correction.x()),
                    number("{:+.2f}", 100.0 * range.correction.y()),
                    number("{:+.2f}", 1000.0 * range.correction.z()),
                    {std::string(range.why)}});
  }
  page.begin_part("ranges", "Each range", fmt::format("{}", rows.size()), Tone::kPlain, false);
  page.add_table({"time s", "tag", "anchor", "range m", "innovation m", "sigma m", "weight", "x cm", "y cm",
                  "heading mrad", "why"},
                 rows);
  page.end_part();
}

}  // namespace

void add_moment(Page& page, const MomentView& view) {
  const PlanarEstimate& now = row_at(view.rows, view.at_s);
  const auto used = std::count_if(view.ranges.begin(), view.ranges.end(),
                                  [](const RangeRow& range) { return range.weight > 0.0; });
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();
  for (const RangeRow& range : view.ranges) moved += range.correction;
  std::string state = "–";
  for (const StateSpan& span : view.states) {
    if (span.from_s <= view.at_s || state == "–") state = words(span);
  }
  page.add_facts({{state, "state"},
                  {fmt::format("{:.3f} m", radius_95_m(now)), "95 % radius of the position"},
                  {fmt::format("{} of {}", used, view.ranges.size()), "ranges used"},
                  {fmt::format("{:.1f} cm", 100.0 * moved.head<2>().norm()), "correction by them together"},
                  {fmt::format("{:+.2f} mrad", 1000.0 * moved.z()), "of the heading"}});
  add_moment_map(page, view);
  add_moment_course(page, view);
  if (view.ranges.empty()) return;
  add_moment_innovations(page, view);
  add_moment_corrections(page, view);
  add_moment_table(page, view);
}

}  // namespace groma::report
