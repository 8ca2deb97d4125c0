#include "host/cli/demo_report.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "host/report/calibration_report.hpp"
#include "host/report/drive_report.hpp"
#include "host/report/page.hpp"

namespace groma::cli {

namespace {

using Eigen::Vector2d;
using report::Cell;
using report::Chart;
using report::Ink;
using report::Page;

constexpr double kEllipseEvery_s = 4.0;
constexpr double kPointEvery_s = 0.1;
constexpr double kLowestError_m = 1e-3;
constexpr double kOverhead_m = 2.0;  // walls with a higher bottom (lintels) are not drawn

const simulation::ModelRun* run_of(const simulation::DemoResult& result, filter::Model model) {
  const auto found = std::find_if(result.models.begin(), result.models.end(),
                                  [model](const simulation::ModelRun& run) { return run.model == model; });
  return found == result.models.end() ? nullptr : &*found;
}

void add_summary(Page& page, const simulation::DemoResult& result) {
  std::vector<report::Fact> facts;
  if (const auto* run = run_of(result, filter::Model::kSchmidt)) {
    facts.push_back({fmt::format("{:.3f} m", run->evaluation.ate_m.mean), "mean position error, schmidt"});
  }
  if (const auto* run = run_of(result, filter::Model::kOriginal)) {
    facts.push_back({fmt::format("{:.3f} m", run->evaluation.ate_m.mean), "mean position error, original"});
  }
  facts.push_back({fmt::format("{:.0f}", result.ranges_per_s), "ranges per second"});
  facts.push_back({fmt::format("{:.0f} %", 100.0 * result.nlos_share), "NLOS ranges"});
  facts.push_back({fmt::format("{}", result.frames_lost), "frames lost",
                   result.frames_lost == 0 ? report::Tone::kGood : report::Tone::kWarning});
  page.add_facts(facts);
}

std::vector<Eigen::Vector3d> way(const std::vector<model::PoseSample>& poses) {
  std::vector<Eigen::Vector3d> points;
  points.reserve(poses.size());
  for (const model::PoseSample& pose : poses) points.emplace_back(pose.x_m, pose.y_m, pose.t_s);
  return points;
}

void add_map(Page& page, const sim::Scenario& scenario, const simulation::DemoResult& result) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 640.0});
  report::add_walls(map, walls_of(scenario));
  map.add_path("first drive", Ink::kPath, way(result.first_drive.ground_truth), report::Stroke::kDashed);
  map.add_path("second drive, truth", Ink::kTruth, way(result.second_drive.ground_truth),
               report::Stroke::kBroad);
  if (const auto* run = run_of(result, filter::Model::kSchmidt)) {
    std::vector<Eigen::Vector3d> points;
    std::vector<report::Ellipse> ellipses;
    double next_s = -1.0;
    for (const model::PlanarEstimate& row : run->estimate) {
      points.emplace_back(row.x_m, row.y_m, row.t_s);
      if (row.t_s < next_s) continue;
      next_s = row.t_s + kEllipseEvery_s;
      ellipses.push_back({{row.x_m, row.y_m}, row.covariance.topLeftCorner<2, 2>()});
    }
    map.add_path("second drive, estimate", Ink::kEstimate, points);
    map.add_ellipses("95 % of the estimate", Ink::kEstimate, std::move(ellipses));
    report::add_course(map, run->estimate, Ink::kEstimate);
  }
  std::vector<report::Mark> true_places;
  for (const model::Anchor& anchor : scenario.anchors) {
    true_places.push_back({anchor.position_m.head<2>(), fmt::format("{}", anchor.id)});
  }
  std::vector<report::Mark> calibrated;
  std::vector<report::Ellipse> ellipses;
  for (const model::AnchorCalibration& anchor : result.calibration.calibration.anchors) {
    if (anchor.covariance.rows() < 3) continue;
    calibrated.push_back({anchor.position_m.head<2>(), ""});
    ellipses.push_back({anchor.position_m.head<2>(), anchor.covariance.topLeftCorner<2, 2>()});
  }
  map.add_marks("anchor, truth", Ink::kTruth, std::move(true_places));
  map.add_marks("anchor, calibrated", Ink::kAnchor, std::move(calibrated));
  map.add_ellipses("its 95 % ellipse", Ink::kAnchor, std::move(ellipses));
  page.add_chart(
      map,
      "The hall, its yard and both drives. The estimate is that of the model schmidt, calibrated from only "
      "the first drive.");
}

void add_models(Page& page, const simulation::DemoResult& result) {
  page.add_heading("Localization on the second drive");
  std::vector<std::vector<Cell>> rows;
  Chart chart({.x_label = "time (s)",
               .y_label = "position error (m)",
               .log_y = true,
               .over_time = true,
               .height_px = 300.0});
  std::size_t series = 0;
  for (const simulation::ModelRun& run : result.models) {
    const evaluation::Evaluation& e = run.evaluation;
    const std::string name(filter::model_name(run.model));
    rows.push_back({{name},
                    {fmt::format("{:.3f}", e.ate_m.mean)},
                    {fmt::format("{:.3f}", e.ate_m.max)},
                    {fmt::format("{:.4f}", e.ate_rad.mean)},
                    {fmt::format("{:.4f}", e.ate_rad.max)},
                    {e.nees ? fmt::format("{:.2f}", e.nees->mean) : "–"},
                    {e.nees ? fmt::format("{:.0f} %", 100.0 * e.nees->inside_95) : "–"}});
    std::vector<Vector2d> points;
    double next_s = -1.0;
    for (const evaluation::PoseError& error :
         evaluation::pose_errors(run.estimate, result.second_drive.ground_truth)) {
      if (error.t_s < next_s) continue;
      next_s = error.t_s + kPointEvery_s;
      points.emplace_back(error.t_s, std::max(std::hypot(error.x_m, error.y_m), kLowestError_m));
    }
    const Ink ink = run.model == filter::Model::kOdometry   ? Ink::kOther
                    : run.model == filter::Model::kOriginal ? Ink::kBad
                                                            : report::series_ink(series++);
    chart.add_line(name, ink, std::move(points),
                   run.model == filter::Model::kOdometry ? report::Stroke::kDashed : report::Stroke::kThin);
  }
  page.add_table(
      {"model", "ATE mean m", "ATE max m", "heading mean rad", "heading max rad", "NEES mean", "inside 95 %"},
      rows);
  page.add_chart(chart, "The position error of each model over time, on a logarithmic scale.");
}

void add_calibration_errors(Page& page, const simulation::DemoResult& result) {
  const auto& anchors = result.calibration.calibration.anchors;
  std::vector<std::string> names;
  std::vector<report::Mark> marks;
  double largest_m = 0.0;
  for (std::size_t i = 0; i < anchors.size(); ++i) {
    if (std::isfinite(result.anchor_errors_m[i])) largest_m = std::max(largest_m, result.anchor_errors_m[i]);
    marks.push_back({{static_cast<double>(i), result.anchor_errors_m[i]},
                     fmt::format("{:.2f}", result.anchor_errors_m[i])});
    names.push_back(fmt::format("{}", anchors[i].id));
  }
  Chart chart({.x_label = "anchor",
               .y_label = "error (m)",
               .height_px = 240.0,
               .y_range = Vector2d(0.0, std::max(1.2 * largest_m, 0.1))});
  chart.name_x(std::move(names));
  chart.add_marks("distance of the calibrated position from the truth", Ink::kAnchor, std::move(marks));
  page.add_heading("Calibration from the first drive");
  page.add_chart(chart, "Position error of each calibrated anchor.");
}

}  // namespace

report::Walls walls_of(const sim::Scenario& scenario) {
  report::Walls walls;
  for (const sim::Wall& wall : scenario.walls) {
    if (wall.bottom_m > kOverhead_m) continue;
    const bool opaque = scenario.materials[wall.material].loss_db >= sim::kOpaqueLoss_db;
    (opaque ? walls.opaque : walls.others).emplace_back(wall.from_m, wall.to_m);
  }
  return walls;
}

report::Page demo_report(const sim::Scenario& scenario, const simulation::DemoResult& result,
                         std::uint64_t seed) {
  Page page("groma demo",
            fmt::format("{}, seed {}: {} tags and {} anchors ran the firmware on a modelled radio and "
                        "streamed over pseudo-terminals",
                        scenario.name, seed, scenario.tags.size(), scenario.anchors.size()));
  add_summary(page, result);
  add_map(page, scenario, result);
  add_models(page, result);
  add_calibration_errors(page, result);
  calibration::Drive drive;
  drive.ranges = result.first_drive.ranges;
  drive.poses = result.first_drive.pose_prior;
  drive.tags = result.first_drive.tags;
  drive.surface = &result.first_drive.surface;
  drive.priors = result.first_drive.range_priors;
  report::add_calibration(page, drive, result.calibration, walls_of(scenario));
  return page;
}

}  // namespace groma::cli
