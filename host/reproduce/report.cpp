#include "host/reproduce/report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <utility>

#include "host/io/version.hpp"
#include "host/model/types.hpp"
#include "host/report/series.hpp"
#include "host/reproduce/paper.hpp"
#include "host/reproduce/sensitivity.hpp"
#include "host/reproduce/summary.hpp"
#include "host/reproduce/tables.hpp"

namespace groma::reproduce {

namespace {

using Eigen::Vector2d;
using report::Cell;
using report::Chart;
using report::Ink;
using report::Page;
using Pointer = Json::json_pointer;

constexpr double kLowestError_m = 1e-3;
constexpr double kNs_per_us = 1e3;

std::string number(double value, const char* format) {
  return std::isfinite(value) ? fmt::format(fmt::runtime(format), value) : "–";
}

// `unit`: how many of the figure's units one of the shown is.
std::string text_of(const Band& band, const char* format, double unit = 1.0) {
  if (band.count == 0) return "–";
  std::string median = number(band.median / unit, format);
  if (band.count == 1) return median;
  return fmt::format("{} ({}–{})", median, number(band.low / unit, format), number(band.high / unit, format));
}

// What a figure shows: from which seeds, and the command that repeats it.
std::string source_of(const char* experiment, std::size_t seeds) {
  const std::string of = seeds == 1 ? "seed 1" : fmt::format("seeds 1 to {}", seeds);
  return fmt::format("Simulated, {}: groma reproduce {} --seeds {}, groma {}.", of, experiment, seeds,
                     io::build_name());
}

// Why a row of ours is not ahead of the paper's figure.
const char* why_behind(const TableRow& row) {
  if (row.key == "odometry") return "the odometry here is about as wrong as the paper's, on purpose";
  if (row.key == "original")
    return "it takes ranges for unbiased, as the paper's does, and no gate can mend that";
  return "the cause is not known";
}

void add_tables(Page& page, const TableSpec& table, const Seeds& seeds) {
  for (const Column& column : columns()) {
    std::vector<std::vector<Cell>> rows;
    std::string behind;
    for (const TableRow& row : table.rows) {
      const double paper = paper_value(row, column);
      const auto of = [&](Who who) {
        return band_at(seeds, run_of(row, who) / "score" / column.figure / column.statistic);
      };
      const Band ours = of(Who::kOurs);
      const bool is_ahead = std::isfinite(paper) && ours.count > 0 && ours.median < paper;
      if (std::isfinite(paper) && ours.count > 0 && !is_ahead)
        behind += fmt::format("{}{}: {}", behind.empty() ? "" : "; ", row.label, why_behind(row));
      rows.push_back({{.text = row.label, .words = true},
                      {number(paper, column.format)},
                      {text_of(of(Who::kPublished), column.format)},
                      {text_of(ours, column.format), is_ahead ? report::Tone::kGood : report::Tone::kPlain}});
    }
    page.add_table({column.title, "paper", "its filter here", "ours"}, rows);
    if (!behind.empty()) page.add_text(fmt::format("Not ahead of the paper's figure: {}.", behind));
  }
}

// A part of a row's run; null if the result has none.
const Json* part_of(const Json& result, const TableRow& row, Who who, const char* part) {
  const Pointer at = run_of(row, who) / part;
  return result.contains(at) ? &result.at(at) : nullptr;
}

// Errors over time of the first seed; `column`: 1 position, 3 NEES.
void add_errors(Page& page, const TableSpec& table, const Json& first, std::size_t column,
                const std::string& label) {
  Chart chart(
      {.x_label = "time (s)", .y_label = label, .log_y = true, .over_time = true, .height_px = 280.0});
  std::size_t series = 0;
  const auto add = [&](const std::string& name, const TableRow& row, Who who, report::Stroke stroke) {
    const Json* errors = part_of(first, row, who, "errors");
    if (errors == nullptr) return;
    std::vector<Vector2d> points;
    for (const Json& point : *errors) {
      const Json& value = point.at(column);
      points.emplace_back(point.at(0).get<double>(),
                          value.is_number() ? std::max(value.get<double>(), kLowestError_m) : report::kNone);
    }
    chart.add_line(name, series < 4 ? report::series_ink(series) : Ink::kOther, std::move(points), stroke);
    ++series;
  };
  for (const TableRow& row : table.rows) {
    if (row.key != "odometry" && row.key != "original" && row.key != "adapted") continue;
    if (!row.group.empty() && row.group != table.rows.front().group) continue;
    if (row.key == "adapted") add("schmidt", row, Who::kOurs, report::Stroke::kThin);
    add("paper's " + row.key, row, Who::kPublished, report::Stroke::kDashed);
  }
  page.add_chart(chart, fmt::format("The {} of the paper's filters and of ours. {}", label,
                                    source_of(table.experiment.c_str(), 1)));
}

void add_paths(Page& page, const TableSpec& table, const Json& first) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 420.0});
  const auto add = [&](const std::string& name, Ink ink, const Json* path, report::Stroke stroke) {
    if (path == nullptr) return;
    std::vector<Eigen::Vector3d> points;
    for (const Json& point : *path)
      points.emplace_back(point.at(0).get<double>(), point.at(1).get<double>(), point.at(2).get<double>());
    map.add_path(name, ink, points, stroke);
  };
  for (const TableRow& row : table.rows) {
    if (!row.group.empty() && row.group != table.rows.front().group) continue;
    const auto part = [&](Who who, const char* name) { return part_of(first, row, who, name); };
    if (row.key == "odometry") {
      add("truth", Ink::kTruth, part(Who::kOurs, "truth"), report::Stroke::kBroad);
      add("odometry", Ink::kOther, part(Who::kOurs, "path"), report::Stroke::kDashed);
    }
    if (row.key != "adapted") continue;
    add("paper's adapted", Ink::kSeries2, part(Who::kPublished, "path"), report::Stroke::kThin);
    add("schmidt", Ink::kEstimate, part(Who::kOurs, "path"), report::Stroke::kThin);
    const Json* ellipses = part(Who::kOurs, "ellipses");
    if (ellipses == nullptr) continue;
    std::vector<report::Ellipse> drawn;
    for (const Json& at : *ellipses) {
      report::Ellipse& ellipse = drawn.emplace_back();
      ellipse.center = {at.at(0).get<double>(), at.at(1).get<double>()};
      ellipse.covariance << at.at(2).get<double>(), at.at(3).get<double>(), at.at(3).get<double>(),
          at.at(4).get<double>();
    }
    map.add_ellipses("95 % of schmidt", Ink::kEstimate, std::move(drawn));
  }
  page.add_chart(map, fmt::format("Trajectories. {}", source_of(table.experiment.c_str(), 1)));
}

void add_section(Page& page, const TableSpec& table, const std::map<std::string, Seeds>& parts) {
  const auto part = parts.find("");
  if (part == parts.end()) return;
  const Seeds& seeds = part->second;
  page.add_heading(table.title);
  page.add_text(table.remark);
  page.add_text(source_of(table.experiment.c_str(), seeds.size()));
  add_tables(page, table, seeds);
  if (const auto firmware = parts.find(kFirmware); firmware != parts.end()) {
    page.add_text("Seed 1 with nodes that run the firmware on the modelled radio:");
    add_tables(page, table, firmware->second);
  }
  const auto first = seeds.find(1);
  if (first == seeds.end()) return;
  add_errors(page, table, first->second, 1, "position error (m)");
  add_errors(page, table, first->second, 3, "NEES");
  add_paths(page, table, first->second);
}

void add_table1(Page& page, const Seeds& seeds) {
  page.add_heading("Table I: calibration on the indoor drive");
  page.add_text(
      "Each anchor's distance from its true place. The paper's true places are what this simulation takes "
      "for them, so that directions of sight are as there; walls and noise are assumed.");
  std::vector<std::vector<Cell>> rows;
  std::vector<std::string> names;
  std::vector<report::Mark> marks;
  std::vector<report::Mark> paper;
  for (std::size_t i = 0; i < kTable1.size(); ++i) {
    const Pointer anchor = Pointer() / "anchors" / i;
    const Band error_m = band_at(seeds, anchor / "error_m");
    rows.push_back({{fmt::format("{}", kTable1.at(i).id)},
                    {number(kTable1.at(i).error_m, "{:.3f}")},
                    {text_of(error_m, "{:.3f}")},
                    {number(std::sqrt(3.0 * kTable1.at(i).variance_m2), "{:.3f}")},
                    {text_of(band_at(seeds, anchor / "sigma_m"), "{:.3f}")},
                    {text_of(band_at(seeds, anchor / "nees"), "{:.2f}")}});
    names.push_back(fmt::format("{}", kTable1.at(i).id));
    marks.push_back({{static_cast<double>(i), error_m.median}, ""});
    paper.push_back({{static_cast<double>(i), kTable1.at(i).error_m}, ""});
  }
  rows.push_back({{"mean"},
                  {number(kTable1Mean_m, "{:.2f}")},
                  {text_of(band_at(seeds, Pointer() / "mean_m"), "{:.3f}")},
                  {"–"},
                  {"–"},
                  {"–"}});
  page.add_table({"anchor", "error m: paper", "ours", "sigma m: paper", "ours", "NEES ours"}, rows);
  page.add_text("The paper's text gives 0.18 m as the mean; the mean of its table's column is 0.230 m.");
  Chart chart({.x_label = "anchor", .y_label = "error (m)", .height_px = 240.0});
  chart.name_x(std::move(names));
  chart.add_marks("paper", Ink::kTruth, std::move(paper));
  chart.add_marks("ours, median", Ink::kAnchor, std::move(marks));
  page.add_chart(chart, fmt::format("The paper's are recorded. {}", source_of("table1", seeds.size())));
}

void add_effort(Page& page, const Seeds& table2) {
  page.add_heading("Computational effort");
  page.add_text(fmt::format(
      "Median times of one call on this computer, in the runs of Table II. The paper states under {} µs "
      "for a propagation and under {} µs for an update, on a computer that it does not name.",
      kPropagate_us, kUpdate_us));
  std::vector<std::vector<Cell>> rows;
  for (const char* key : {"original", "adapted", "anchor-states", "joint"}) {
    const Pointer run = Pointer() / key / "ours";
    rows.push_back({{.text = std::string(key) == "adapted" ? "schmidt" : key, .words = true},
                    {text_of(band_at(table2, run / "propagate_ns"), "{:.2f}", kNs_per_us)},
                    {text_of(band_at(table2, run / "update_ns"), "{:.2f}", kNs_per_us)}});
  }
  page.add_table({"model", "odometry sample µs", "range µs"}, rows);
  page.add_text(source_of("effort", table2.size()));
}

void add_anchor_states(Page& page, const Seeds& seeds) {
  const auto first = seeds.find(1);
  if (first == seeds.end() || !first->second.is_array()) return;
  page.add_heading("Anchor positions as states");
  Chart chart(
      {.x_label = "time (s)", .y_label = "position error (m)", .over_time = true, .height_px = 300.0});
  std::map<int, std::vector<Vector2d>> anchors;
  for (const Json& point : first->second)
    anchors[point.at(1).get<int>()].emplace_back(point.at(0).get<double>(), point.at(2).get<double>());
  std::size_t series = 0;
  for (auto& [id, points] : anchors) {
    chart.add_line(fmt::format("{}", id), report::series_ink(series % 4), std::move(points),
                   series < 4 ? report::Stroke::kThin : report::Stroke::kDashed);
    ++series;
  }
  page.add_chart(chart, fmt::format("Each anchor's error on the outdoor drive, as our filter estimates it. "
                                    "In the paper some improve and most stay or degrade. {}",
                                    source_of("anchor-states", 1)));
}

// Where it breaks, in words.
std::string break_of(const Factor& factor, const std::vector<LevelBands>& bands) {
  std::string broken;
  for (std::size_t i = 0; i < bands.size(); ++i) {
    if (!is_broken(bands[i], bands[factor.usual])) continue;
    broken += fmt::format("{}{}: {:.3f} m, NEES {:.1f}", broken.empty() ? "" : "; ", factor.levels[i].label,
                          bands[i].ate_m.median, bands[i].nees.median);
  }
  if (broken.empty()) return "It breaks at none of these levels.";
  return fmt::format("It breaks at {} (usually {:.3f} m).", broken, bands[factor.usual].ate_m.median);
}

void add_sensitivity(Page& page, const std::map<std::string, Seeds>& parts) {
  page.add_heading("What the paper leaves open: sensitivity");
  page.add_text(
      "Simulated: the warehouse's indoor drive calibrates, the second indoor drive is localized by schmidt. "
      "A line is the median over the seeds, dashed lines are 5 and 95 %.");
  for (const Factor& factor : factors()) {
    const auto part = parts.find(factor.name);
    if (part == parts.end()) continue;
    std::vector<std::string> names;
    std::array<std::vector<Vector2d>, 3> lines;
    std::vector<LevelBands> bands;
    std::vector<std::vector<Cell>> rows;
    for (std::size_t i = 0; i < factor.levels.size(); ++i) {
      const LevelBands& at = bands.emplace_back(bands_of(part->second, i));
      names.push_back(factor.levels[i].label);
      const auto x = static_cast<double>(i);
      lines[0].emplace_back(x, std::max(at.ate_m.median, kLowestError_m));
      lines[1].emplace_back(x, std::max(at.ate_m.low, kLowestError_m));
      lines[2].emplace_back(x, std::max(at.ate_m.high, kLowestError_m));
      rows.push_back({{.text = factor.levels[i].label, .words = true},
                      {text_of(at.ate_m, "{:.3f}")},
                      {text_of(at.nees, "{:.2f}")},
                      {text_of(at.anchors_m, "{:.3f}")}});
    }
    page.begin_part("sensitivity-" + factor.name, factor.meaning, break_of(factor, bands),
                    report::Tone::kPlain, true);
    Chart chart({.x_label = factor.meaning, .y_label = "mean ATE (m)", .log_y = true, .height_px = 220.0});
    chart.name_x(std::move(names));
    chart.add_line("median", Ink::kEstimate, std::move(lines[0]));
    chart.add_line("5 and 95 %", Ink::kEstimate, std::move(lines[1]), report::Stroke::kDashed);
    chart.add_line("", Ink::kEstimate, std::move(lines[2]), report::Stroke::kDashed);
    page.add_chart(chart, source_of("sensitivity", part->second.size()));
    page.add_table({"level", "mean ATE m", "NEES", "anchors marked ok: error m"}, rows);
    page.end_part();
  }
}

void add_baselines(Page& page, const Seeds& seeds, bool has_program) {
  page.add_heading("What a user would otherwise take");
  page.add_text(
      "Simulated: the second indoor drive, calibrated by the first with our calibration for all. Tuned: "
      "parameters found on other seeds, see groma-baselines.");
  if (!has_program) {
    page.add_notice("Not run:", "groma-baselines is not beside groma. It needs Debian's libceres-dev.",
                    report::Tone::kWarning);
  }
  std::vector<std::vector<Cell>> rows;
  for (const auto& [method, run] : seeds.begin()->second.items()) {
    const Pointer score = Pointer() / method / "score";
    rows.push_back({{.text = method, .words = true},
                    {text_of(band_at(seeds, score / "ate_m" / "mean"), "{:.3f}")},
                    {text_of(band_at(seeds, score / "ate_m" / "max"), "{:.3f}")},
                    {text_of(band_at(seeds, score / "nees" / "mean"), "{:.2f}")},
                    {text_of(band_at(seeds, Pointer() / method / "us_per_range"), "{:.2f}")}});
  }
  page.add_table({"method", "mean ATE m", "max ATE m", "NEES", "µs a range"}, rows);
  page.add_text(source_of("baselines", seeds.size()));
}

void add_recorded(Page& page, const std::map<std::string, Seeds>& parts) {
  page.add_heading("Recorded runs");
  page.add_text(
      "Recorded by others; none replays the drive that calibrated it. All rows have our calibration: of the "
      "first half of a drive, or of mcd_ntu_day_09. Mean ATE in m, NEES. The paper's filters, which have no "
      "gate, are metres off on the campus of mcd_ntu, where buildings reflect.");
  std::vector<std::vector<Cell>> rows;
  for (const auto& [name, seeds] : parts) {
    std::vector<Cell>& cells = rows.emplace_back();
    cells.push_back({.text = name, .words = true});
    const auto add = [&, &of = seeds](const char* key, Who who) {
      const Pointer score = run_of({"", key, "", nullptr}, who) / "score";
      const Band ate_m = band_at(of, score / "ate_m" / "mean");
      cells.push_back({ate_m.count == 0
                           ? "–"
                           : fmt::format("{:.3f}, {}", ate_m.median,
                                         text_of(band_at(of, score / "nees" / "mean"), "{:.1f}"))});
    };
    add("odometry", Who::kPublished);
    add("original", Who::kPublished);
    add("adapted", Who::kPublished);
    add("adapted", Who::kOurs);
    add("joint", Who::kOurs);
  }
  page.add_text(fmt::format("groma reproduce recorded --recorded DIR, groma {}.", io::build_name()));
  page.add_table({"run", "paper's odometry", "paper's original", "paper's adapted", "schmidt", "joint"},
                 rows);
}

}  // namespace

Page page_of(const Outcome& outcome, const Plan& plan) {
  Page page(
      "The source paper's experiments, and ours beside them",
      fmt::format("Seeds 1 to {}; figures are medians over the seeds, with 5 to 95 % in brackets. Simulated, "
                  "but for the recorded runs.",
                  plan.seeds));
  if (!outcome.has_baselines) {
    page.add_notice("Not run:",
                    "the paper's own filters and other baselines, because groma-baselines is not beside "
                    "groma. It is built where Debian's libceres-dev is.",
                    report::Tone::kWarning);
  }
  const auto with = [&](std::string_view experiment, const std::function<void(const Seeds&)>& add) {
    const auto found = outcome.results.find(experiment);
    if (found != outcome.results.end() && !found->second.empty()) add(found->second.begin()->second);
  };
  with("table1", [&](const Seeds& seeds) { add_table1(page, seeds); });
  for (const TableSpec& table : tables()) {
    if (const auto found = outcome.results.find(table.experiment); found != outcome.results.end())
      add_section(page, table, found->second);
  }
  with("anchor-states", [&](const Seeds& seeds) { add_anchor_states(page, seeds); });
  with("table2", [&](const Seeds& seeds) { add_effort(page, seeds); });
  with("baselines", [&](const Seeds& seeds) { add_baselines(page, seeds, outcome.has_baselines); });
  if (const auto found = outcome.results.find("sensitivity"); found != outcome.results.end())
    add_sensitivity(page, found->second);
  if (const auto found = outcome.results.find("recorded"); found != outcome.results.end())
    add_recorded(page, found->second);
  return page;
}

}  // namespace groma::reproduce
