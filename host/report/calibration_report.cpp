#include "host/report/calibration_report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "host/calibration/association.hpp"
#include "host/io/calibration_file.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

bool is_known(const model::AnchorCalibration& anchor) {
  return anchor.covariance.rows() >= 3 && anchor.covariance.allFinite() && anchor.position_m.allFinite();
}

Cell number(double value, const char* format = "{:.3f}") {
  return {std::isfinite(value) ? fmt::format(fmt::runtime(format), value) : "–"};
}

Ink anchor_ink(const model::AnchorCalibration& anchor) {
  switch (tone(anchor.verdict)) {
    case Tone::kWarning:
      return Ink::kWarning;
    case Tone::kBad:
      return Ink::kBad;
    default:
      return Ink::kAnchor;
  }
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

void add_map(Page& page, const calibration::Drive& drive, const model::Calibration& calibration) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 720.0});
  std::vector<Vector2d> path;
  path.reserve(drive.poses.size());
  double last_s = kNone;
  for (const model::PoseSample& pose : drive.poses) {
    if (pose.t_s - last_s > 1.0) path.emplace_back(kNone, kNone);
    path.emplace_back(pose.x_m, pose.y_m);
    last_s = pose.t_s;
  }
  map.add_line("poses driven", Ink::kPath, std::move(path));
  struct Group {
    std::string name;
    std::vector<Mark> marks;
    std::vector<Ellipse> ellipses;
  };
  std::map<Ink, Group> groups{{Ink::kAnchor, {"anchor", {}, {}}},
                              {Ink::kWarning, {"anchor with a warning", {}, {}}},
                              {Ink::kBad, {"anchor not usable", {}, {}}}};
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!is_known(anchor)) continue;
    Group& group = groups[anchor_ink(anchor)];
    const Vector2d at = anchor.position_m.head<2>();
    group.marks.push_back({at, fmt::format("{}", anchor.id)});
    group.ellipses.push_back({at, anchor.covariance.topLeftCorner<2, 2>()});
  }
  for (auto& [ink, group] : groups) {
    if (group.marks.empty()) continue;
    map.add_ellipses("95 % ellipse", ink, std::move(group.ellipses));
    map.add_marks(group.name, ink, std::move(group.marks));
  }
  page.add_chart(map, "The drive from above, and where the anchors were found.");
}

void add_anchors(Page& page, const model::Calibration& calibration) {
  std::vector<std::vector<Cell>> rows;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const bool known = is_known(anchor);
    const auto coordinate = [&](int i) { return number(known ? anchor.position_m(i) : kNone); };
    const auto sigma = [&](double variance) { return number(known ? std::sqrt(variance) : kNone); };
    const Eigen::Matrix3d covariance =
        known ? Eigen::Matrix3d(anchor.covariance.topLeftCorner<3, 3>()) : Eigen::Matrix3d::Zero();
    rows.push_back({{fmt::format("{}", anchor.id)},
                    coordinate(0),
                    coordinate(1),
                    coordinate(2),
                    sigma(std::max(covariance(0, 0), covariance(1, 1))),
                    sigma(covariance(2, 2)),
                    {fmt::format("{}", anchor.ranges_used)},
                    {fmt::format("{}", anchor.ranges_rejected)},
                    number(anchor.held_out_rms_m.value_or(kNone)),
                    number(anchor.mirror_ratio.value_or(kNone), "{:.2f}"),
                    {std::string(io::word(anchor.verdict)), tone(anchor.verdict)},
                    {anchor.advice.empty() ? "–" : anchor.advice, Tone::kPlain, true}});
  }
  page.add_heading("Anchors");
  page.add_table({"anchor", "x m", "y m", "z m", "σ xy m", "σ z m", "used", "rejected", "held out m",
                  "mirror", "verdict", "advice"},
                 rows);
  page.add_text(
      "Held out: root mean square of the residuals over the last fifth of the drive, which that solution had "
      "not seen. "
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
  page.add_chart(chart, "What each pair of tag and anchor measures too long, with its 95 % interval.");
}

// Median of each of `bins` equal stretches of time; a break where there is nothing.
std::vector<Vector2d> medians(const std::vector<Vector2d>& values, double from_s, double to_s,
                              std::size_t bins) {
  std::vector<std::vector<double>> binned(bins);
  for (const Vector2d& value : values) {
    const double share = (value.x() - from_s) / (to_s - from_s);
    const auto bin = static_cast<std::size_t>(
        std::clamp(share * static_cast<double>(bins), 0.0, static_cast<double>(bins) - 1.0));
    binned[bin].push_back(value.y());
  }
  std::vector<Vector2d> points;
  points.reserve(bins);
  for (std::size_t i = 0; i < bins; ++i) {
    std::vector<double>& bin = binned[i];
    const double t_s = from_s + (static_cast<double>(i) + 0.5) * (to_s - from_s) / static_cast<double>(bins);
    if (bin.empty()) {
      points.emplace_back(t_s, kNone);
      continue;
    }
    const auto middle = bin.begin() + static_cast<std::ptrdiff_t>(bin.size() / 2);
    std::nth_element(bin.begin(), middle, bin.end());
    points.emplace_back(t_s, *middle);
  }
  return points;
}

void add_residuals(Page& page, const calibration::Drive& drive, const model::Calibration& calibration) {
  if (drive.ranges.empty()) return;
  const double from_s = drive.ranges.front().t_s;
  const double to_s = std::max(drive.ranges.back().t_s, from_s + 1.0);
  const calibration::Association association = calibration::associate(
      drive, calibration::Options{}.max_pose_gap_s, 0.0, calibration::HeightSource::kPose);
  constexpr std::size_t kBins = 120;
  std::vector<Chart> charts;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!is_known(anchor)) continue;
    const auto found = std::find_if(association.anchors.begin(), association.anchors.end(),
                                    [&](const auto& observations) { return observations.id == anchor.id; });
    if (found == association.anchors.end()) continue;
    Chart chart({.title = fmt::format("anchor {}", anchor.id),
                 .x_label = "time (s)",
                 .y_label = "residual (m)",
                 .width_px = 345.0,
                 .height_px = 190.0,
                 .legend = false,
                 .y_range = Vector2d(-0.5, 0.5)});
    for (std::size_t tag = 0; tag < association.tags.size(); ++tag) {
      const auto pair =
          std::find_if(anchor.pairs.begin(), anchor.pairs.end(),
                       [&](const model::PairBias& bias) { return bias.tag_id == association.tags[tag].id; });
      if (pair == anchor.pairs.end()) continue;
      std::vector<Vector2d> residuals;
      for (const calibration::Observation& row : found->rows) {
        if (row.tag != tag) continue;
        const double distance_m = (row.tag_m - anchor.position_m).norm();
        residuals.emplace_back(row.t_s, row.range_m - pair->gamma * distance_m - pair->beta_m);
      }
      chart.add_line("", series_ink(tag), medians(residuals, from_s, to_s, kBins));
    }
    charts.push_back(std::move(chart));
  }
  page.add_heading("Residuals");
  std::string tags;
  for (const model::Tag& tag : association.tags)
    tags += fmt::format("{}{}", tags.empty() ? "" : ", ", tag.id);
  page.add_charts(
      charts, fmt::format("Measured less predicted range over time, medians of {:.1f} s, a line for each of "
                          "the tags {} in the colours above. Long stretches off zero are blocked sight.",
                          (to_s - from_s) / static_cast<double>(kBins), tags));
}

}  // namespace

Tone tone(model::AnchorVerdict verdict) {
  switch (verdict) {
    case model::AnchorVerdict::kOk:
      return Tone::kGood;
    case model::AnchorVerdict::kWeakZ:
    case model::AnchorVerdict::kWeak:
    case model::AnchorVerdict::kNeverInSight:
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

void add_calibration(Page& page, const calibration::Drive& drive, const calibration::Result& result) {
  add_summary(page, drive, result);
  add_map(page, drive, result.calibration);
  add_anchors(page, result.calibration);
  add_biases(page, result.calibration);
  add_residuals(page, drive, result.calibration);
}

}  // namespace groma::report
