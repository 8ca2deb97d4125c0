#include "host/report/calibration_report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <vector>

#include "host/io/calibration_file.hpp"
#include "host/report/series.hpp"
#include "host/report/site.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;

Cell number(double value, const char* format = "{:.3f}") {
  return {std::isfinite(value) ? fmt::format(fmt::runtime(format), value) : "–"};
}

void add_summary(Page& page, const calibration::Drive& drive, const calibration::Result& result) {
  const model::Calibration& calibration = result.calibration;
  const auto good =
      std::count_if(calibration.anchors.begin(), calibration.anchors.end(),
                    [](const auto& anchor) { return anchor.verdict == model::AnchorVerdict::kOk; });
  double way_m = 0.0;
  for (std::size_t i = 1; i < drive.poses.size(); ++i) {
    way_m +=
        std::hypot(drive.poses[i].x_m - drive.poses[i - 1].x_m, drive.poses[i].y_m - drive.poses[i - 1].y_m);
  }
  const double duration_s = drive.poses.empty() ? 0.0 : drive.poses.back().t_s - drive.poses.front().t_s;
  const double all = std::max<double>(1.0, static_cast<double>(result.ranges_used + result.ranges_rejected));
  page.add_facts(
      {{std::string(io::word(calibration.verdict)), "verdict", tone(calibration.verdict)},
       {fmt::format("{} of {}", good, calibration.anchors.size()), "anchors ok"},
       {fmt::format("{}", result.ranges_used), "ranges used"},
       {fmt::format("{:.1f} %", 100.0 * static_cast<double>(result.ranges_rejected) / all), "rejected"},
       {fmt::format("{:.0f} m", way_m), fmt::format("driven in {:.0f} s", duration_s)}});
}

// Scales shared by all anchors' charts.
struct Scales {
  double from_s = 0.0;
  double to_s = 1.0;
  std::vector<model::NodeId> tags;  // ascending
  [[nodiscard]] Ink ink(model::NodeId tag) const {
    return series_ink(static_cast<std::size_t>(
        std::distance(tags.begin(), std::lower_bound(tags.begin(), tags.end(), tag))));
  }
};

Scales scales_of(const calibration::Drive& drive) {
  Scales scales;
  if (!drive.ranges.empty()) {
    scales.from_s = drive.ranges.front().t_s;
    scales.to_s = std::max(drive.ranges.back().t_s, scales.from_s + 1.0);
  }
  for (const model::Tag& tag : drive.tags) scales.tags.push_back(tag.id);
  std::sort(scales.tags.begin(), scales.tags.end());
  return scales;
}

Chart::Axes small(std::string title, std::string x_label, std::string y_label) {
  return {.title = std::move(title),
          .x_label = std::move(x_label),
          .y_label = std::move(y_label),
          .width_px = 345.0,
          .height_px = 200.0};
}

Chart::Axes over_time(Chart::Axes axes) {
  axes.over_time = true;
  return axes;
}

// Where the anchor's ranges were LOS, and where NLOS.
Chart los_map(const model::AnchorCalibration& anchor, std::span<const calibration::FittedRange> rows) {
  Chart::Axes axes = small("Line of sight", "x (m)", "y (m)");
  axes.same_scale = true;
  Chart map(axes);
  std::vector<Vector2d> los;
  std::vector<Vector2d> nlos;
  for (const calibration::FittedRange& row : rows) (row.los < 0.5 ? nlos : los).push_back(row.antenna_m);
  map.add_points("LOS", Ink::kGood, std::move(los));
  map.add_points("NLOS or outlier", Ink::kBad, std::move(nlos));
  if (model::has_position(anchor)) {
    const Vector2d at = anchor.position_m.head<2>();
    map.add_ellipses("", anchor_ink(anchor.verdict), {{at, anchor.covariance.topLeftCorner<2, 2>()}});
    map.add_marks("", anchor_ink(anchor.verdict), {{at, fmt::format("{}", anchor.id)}});
  }
  return map;
}

// Each pair's residuals over `x` of a range: dots, and a line of medians.
template <class Of>
Chart residual_chart(Chart::Axes axes, std::span<const calibration::FittedRange> rows, const Scales& scales,
                     double from, double to, const Of& x) {
  axes.y_range = Vector2d(-0.6, 1.0);
  Chart chart(std::move(axes));
  constexpr std::size_t kBins = 60;
  std::map<model::NodeId, std::vector<Vector2d>> pairs;
  for (const calibration::FittedRange& row : rows) pairs[row.tag_id].emplace_back(x(row), row.residual_m);
  for (const auto& [tag, values] : pairs)
    chart.add_line(fmt::format("tag {}", tag), scales.ink(tag), medians(values, from, to, kBins));
  for (auto& [tag, values] : pairs) chart.add_points("", scales.ink(tag), std::move(values));
  return chart;
}

void add_pairs(Page& page, const model::AnchorCalibration& anchor,
               std::span<const calibration::FittedRange> rows) {
  std::vector<std::vector<Cell>> cells;
  for (const model::PairBias& pair : anchor.pairs) {
    std::size_t count = 0;
    double los = 0.0;
    double square_m2 = 0.0;
    for (const calibration::FittedRange& row : rows) {
      if (row.tag_id != pair.tag_id) continue;
      ++count;
      los += row.los;
      square_m2 += row.los * row.residual_m * row.residual_m;
    }
    const double all = static_cast<double>(count);
    cells.push_back({{fmt::format("{}", pair.tag_id)},
                     {fmt::format("{}", count)},
                     number(100.0 * (1.0 - los / all), "{:.0f} %"),
                     number(std::sqrt(square_m2 / los))});
    for (const model::PairTerm& term : model::kPairTerms) {
      cells.back().push_back(number(pair.*term.value, term.text.number));
      cells.back().push_back(number(pair.*term.sigma, term.text.number));
    }
  }
  std::vector<std::string> titles{"tag", "ranges", "NLOS", "rms LOS m"};
  for (const model::PairTerm& term : model::kPairTerms)
    titles.insert(titles.end(), {term.text.title, fmt::format("σ {}", term.text.title)});
  page.add_table(titles, cells);
}

double los_share(std::span<const calibration::FittedRange> rows) {
  double sum = 0.0;
  for (const calibration::FittedRange& row : rows) sum += row.los;
  return rows.empty() ? kNone : sum / static_cast<double>(rows.size());
}

void add_each_anchor(Page& page, const calibration::Drive& drive, const calibration::Result& result) {
  const Scales scales = scales_of(drive);
  page.add_heading("Each anchor");
  page.add_text(
      "For each anchor, where its ranges were measured, and each pair's residuals (measured minus predicted) "
      "over time and over distance: dots are ranges, lines their medians, colours the tags. A long time "
      "above zero is a blocked line of sight (NLOS); a slope over distance is a wrong scale; a step in time "
      "is an anchor that was moved.");
  const std::vector<model::AnchorCalibration>& anchors = result.calibration.anchors;
  for (std::size_t i = 0; i < anchors.size() && i < result.fitted.size(); ++i) {
    const model::AnchorCalibration& anchor = anchors[i];
    const std::vector<calibration::FittedRange>& rows = result.fitted[i];
    const bool ok = anchor.verdict == model::AnchorVerdict::kOk;
    page.begin_part(anchor_part(anchor.id), fmt::format("Anchor {}", anchor.id),
                    std::string(io::word(anchor.verdict)), tone(anchor.verdict), !ok);
    if (!anchor.advice.empty()) page.add_text(anchor.advice);
    if (!rows.empty()) {
      add_pairs(page, anchor, rows);
      double farthest_m = 1.0;
      for (const calibration::FittedRange& row : rows) farthest_m = std::max(farthest_m, row.distance_m);
      page.add_charts(
          {los_map(anchor, rows),
           residual_chart(over_time(small("Residual over time", "time (s)", "residual (m)")), rows, scales,
                          scales.from_s, scales.to_s,
                          [](const calibration::FittedRange& row) { return row.t_s; }),
           residual_chart(small("Residual over distance", "distance (m)", "residual (m)"), rows, scales, 0.0,
                          farthest_m, [](const calibration::FittedRange& row) { return row.distance_m; })},
          "");
    }
    page.end_part();
  }
}

// Anchors with a LOS range in each second of the drive.
std::map<long, std::set<model::NodeId>> los_anchors(const calibration::Result& result) {
  std::map<long, std::set<model::NodeId>> out;
  for (std::size_t i = 0; i < result.fitted.size(); ++i) {
    for (const calibration::FittedRange& row : result.fitted[i]) {
      if (row.los >= 0.5) out[std::lround(std::floor(row.t_s))].insert(result.calibration.anchors[i].id);
    }
  }
  return out;
}

// The path, coloured by the number of LOS anchors.
void add_path(Chart& map, const calibration::Drive& drive, const calibration::Result& result) {
  const std::map<long, std::set<model::NodeId>> seen = los_anchors(result);
  struct Part {
    std::string name;
    Ink ink;
    std::vector<Eigen::Vector3d> line{};
  };
  std::array<Part, 3> parts{Part{"path, LOS to 5 anchors or more", Ink::kGood}, Part{"3 or 4", Ink::kSeries2},
                            Part{"fewer", Ink::kOther}};
  std::size_t last_part = parts.size();
  std::optional<model::PoseSample> last;
  for (const model::PoseSample& pose : drive.poses) {
    const auto found = seen.find(std::lround(std::floor(pose.t_s)));
    const std::size_t count = found == seen.end() ? 0 : found->second.size();
    const std::size_t part = count >= 5 ? 0 : count >= 3 ? 1 : 2;
    std::vector<Eigen::Vector3d>& line = parts[part].line;
    if (last && pose.t_s - last->t_s > 1.0) last.reset();
    if (!last || part != last_part) {
      line.emplace_back(kNone, kNone, pose.t_s);
      if (last) line.emplace_back(last->x_m, last->y_m, last->t_s);
    }
    line.emplace_back(pose.x_m, pose.y_m, pose.t_s);
    last = pose;
    last_part = part;
  }
  for (auto& [name, ink, line] : parts) {
    if (!line.empty()) map.add_path(name, ink, line);
  }
}

// The anchors' advice; anchors with equal advice share one notice.
void add_advice(Page& page, const model::Calibration& calibration) {
  struct Notice {
    std::vector<model::NodeId> anchors;
    std::string text;
    Tone tone;
  };
  std::vector<Notice> notices;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (anchor.advice.empty()) continue;
    const std::string text = fmt::format("{}: {}", io::word(anchor.verdict), anchor.advice);
    const auto same = std::find_if(notices.begin(), notices.end(),
                                   [&](const Notice& notice) { return notice.text == text; });
    if (same == notices.end()) {
      notices.push_back({{anchor.id}, text, tone(anchor.verdict)});
    } else {
      same->anchors.push_back(anchor.id);
    }
  }
  for (const Notice& notice : notices) {
    page.add_notice(
        fmt::format("Anchor{} {}", notice.anchors.size() > 1 ? "s" : "", fmt::join(notice.anchors, ", ")),
        notice.text, notice.tone);
  }
}

void add_map(Page& page, const calibration::Drive& drive, const calibration::Result& result,
             const Walls& walls) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 720.0});
  add_walls(map, walls);
  add_path(map, drive, result);
  add_anchors(map, result.calibration, true);
  page.add_chart(map,
                 "The drive and the estimated anchor positions from above. Click an anchor for its details.");
}

void add_anchor_table(Page& page, const calibration::Result& result) {
  std::vector<std::vector<Cell>> rows;
  for (std::size_t n = 0; n < result.calibration.anchors.size(); ++n) {
    const model::AnchorCalibration& anchor = result.calibration.anchors[n];
    const bool known = model::has_position(anchor);
    const auto coordinate = [&](int i) { return number(known ? anchor.position_m(i) : kNone); };
    const auto sigma = [&](double variance) { return number(known ? std::sqrt(variance) : kNone); };
    const Eigen::Matrix3d covariance =
        known ? Eigen::Matrix3d(anchor.covariance.topLeftCorner<3, 3>()) : Eigen::Matrix3d::Zero();
    rows.push_back(
        {{fmt::format("{}", anchor.id)},
         {std::string(io::word(anchor.verdict)), tone(anchor.verdict)},
         coordinate(0),
         coordinate(1),
         coordinate(2),
         sigma(std::max(covariance(0, 0), covariance(1, 1))),
         sigma(covariance(2, 2)),
         {fmt::format("{}", anchor.ranges_used)},
         {fmt::format("{}", anchor.ranges_rejected)},
         number(n < result.fitted.size() ? 100.0 * los_share(result.fitted[n]) : kNone, "{:.0f} %"),
         number(anchor.held_out_rms_m.value_or(kNone)),
         number(anchor.mirror_ratio.value_or(kNone), "{:.2f}")});
  }
  page.add_heading("Anchors");
  // A narrow screen shows the first columns without scrolling.
  page.add_table({"anchor", "verdict", "x m", "y m", "z m", "σ xy m", "σ z m", "used", "rejected", "LOS",
                  "held out m", "mirror"},
                 rows);
  page.add_text(
      "Held out: root mean square of the residuals over the last fifth of the drive, for a solution from the "
      "rest. "
      "Mirror: how well the best position on the other side of the tags explains the ranges, from 0 (not at "
      "all) to 1 "
      "(as well).");
}

// Bias of each pair, side by side within each anchor.
void add_biases(Page& page, const model::Calibration& calibration) {
  std::vector<std::string> names;
  std::map<model::NodeId, std::pair<std::vector<Vector2d>, std::vector<double>>> betas;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    for (const model::PairBias& pair : anchor.pairs) betas[pair.tag_id];
  }
  if (betas.empty()) return;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    for (const model::PairBias& pair : anchor.pairs) {
      const auto slot = static_cast<double>(std::distance(betas.begin(), betas.find(pair.tag_id)));
      const double shift = 0.2 * (slot - 0.5 * static_cast<double>(betas.size() - 1));
      auto& [points, sigmas] = betas[pair.tag_id];
      points.emplace_back(static_cast<double>(names.size()) + shift, pair.beta_m);
      sigmas.push_back(1.96 * pair.beta_sigma_m);
    }
    names.push_back(fmt::format("{}", anchor.id));
  }
  Chart chart({.x_label = "anchor", .y_label = "beta (m)", .height_px = 280.0});
  chart.name_x(names);
  std::size_t n = 0;
  for (auto& [tag, values] : betas) {
    chart.add_intervals(fmt::format("tag {}", tag), series_ink(n++), std::move(values.first),
                        std::move(values.second));
  }
  page.add_heading("Range biases");
  page.add_chart(chart, "Constant range bias β of each pair of tag and anchor, with its 95 % interval.");
}

}  // namespace

Tone tone(model::AnchorVerdict verdict) {
  switch (verdict) {
    case model::AnchorVerdict::kOk:
      return Tone::kGood;
    case model::AnchorVerdict::kWeakZ:
    case model::AnchorVerdict::kWeak:
    case model::AnchorVerdict::kNeverLos:
      return Tone::kWarning;
    case model::AnchorVerdict::kMoved:
    case model::AnchorVerdict::kNoData:
      return Tone::kBad;
  }
  return Tone::kPlain;
}

Tone tone(model::Verdict verdict) {
  switch (verdict) {
    case model::Verdict::kUsable:
      return Tone::kGood;
    case model::Verdict::kWarnings:
      return Tone::kWarning;
    case model::Verdict::kUnusable:
      return Tone::kBad;
  }
  return Tone::kPlain;
}

void add_calibration(Page& page, const calibration::Drive& drive, const calibration::Result& result,
                     const Walls& walls) {
  add_summary(page, drive, result);
  add_advice(page, result.calibration);
  add_map(page, drive, result, walls);
  add_anchor_table(page, result);
  add_biases(page, result.calibration);
  add_each_anchor(page, drive, result);
}

}  // namespace groma::report
