#include "host/reproduce/sensitivity.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>
#include <string>
#include <utility>
#include <vector>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/uneven_ground.hpp"
#include "host/reproduce/rows.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::reproduce {

namespace {

model::BSpline::Grid grid() {
  return {-5.0, -2.0, 1.0, 1.0, 44, 22};
}
sim::UnevenArea hall(double height_m, const Eigen::Vector2d& slope = Eigen::Vector2d::Zero()) {
  return {.from_m = {-4.0, -1.0}, .to_m = {22.0, 16.0}, .edge_m = 2.0, .slope = slope, .height_m = height_m};
}

// The calibration drive's waypoints; the robot faces its way.
std::vector<sim::Waypoint> course(const std::vector<Eigen::Vector2d>& points) {
  std::vector<sim::Waypoint> out;
  out.reserve(points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Eigen::Vector2d way = i + 1 < points.size() ? Eigen::Vector2d(points[i + 1] - points[i])
                                                      : Eigen::Vector2d(points[i] - points[i - 1]);
    out.push_back({points[i].x(), points[i].y(), std::atan2(way.y(), way.x()), 0.0});
  }
  return out;
}
std::vector<Eigen::Vector2d> repeated(const std::vector<Eigen::Vector2d>& points, int times) {
  std::vector<Eigen::Vector2d> out;
  for (int i = 0; i < times; ++i) out.insert(out.end(), points.begin(), points.end());
  return out;
}

std::vector<Level> excitation() {
  const std::vector<Eigen::Vector2d> straight{{3.0, 7.6}, {17.8, 7.8}};
  const std::vector<Eigen::Vector2d> loop{{3.0, 7.6}, {17.6, 7.6}, {18.0, 3.8}, {3.4, 3.6}, {2.8, 6.0}};
  const std::vector<Eigen::Vector2d> eight{{3.0, 7.6},  {12.8, 7.6},  {13.2, 3.6}, {3.4, 3.6}, {2.8, 7.4},
                                           {12.4, 7.8}, {13.0, 11.2}, {3.4, 11.4}, {2.8, 8.0}};
  std::vector<Level> out;
  const auto add = [&](const std::string& label, std::vector<Eigen::Vector2d> points) {
    out.push_back(
        {label, static_cast<double>(out.size()), [points = std::move(points)](Conditions& conditions) {
           conditions.scenario.drives[0].waypoints = course(points);
         }});
  };
  add("straight, 15 m", straight);
  add("straight, there and back", {straight[0], straight[1], {3.2, 7.9}});
  add("loop, 37 m", loop);
  add("two loops", repeated(loop, 2));
  add("eight, 65 m", eight);
  add("two eights", repeated(eight, 2));
  return out;
}

std::vector<Level> levels(const std::vector<double>& values, const char* format,
                          const std::function<void(Conditions&, double)>& change) {
  std::vector<Level> out;
  out.reserve(values.size());
  for (const double value : values)
    out.push_back({fmt::format(fmt::runtime(format), value), value,
                   [change, value](Conditions& conditions) { change(conditions, value); }});
  return out;
}

void keep_anchors(Conditions& conditions, std::vector<model::NodeId> ids) {
  std::erase_if(conditions.scenario.anchors, [&](const model::Anchor& anchor) {
    return std::find(ids.begin(), ids.end(), anchor.id) == ids.end();
  });
  conditions.scenario.schedule.master_id = conditions.scenario.anchors.front().id;
}
void keep_tags(Conditions& conditions, const std::vector<model::NodeId>& ids) {
  std::erase_if(conditions.scenario.tags, [&](const model::Tag& tag) {
    return std::find(ids.begin(), ids.end(), tag.id) == ids.end();
  });
}

void add_obstacles(Conditions& conditions, double count) {
  const sim::KeyedRandom random(17);
  const auto machine = static_cast<std::size_t>(
      std::find_if(conditions.scenario.materials.begin(), conditions.scenario.materials.end(),
                   [](const sim::Material& material) { return material.name == "machine"; }) -
      conditions.scenario.materials.begin());
  for (int i = 0; i < static_cast<int>(count); ++i) {
    const sim::KeyedRandom draw = random.of(static_cast<std::uint64_t>(i));
    const Eigen::Vector2d at(draw.of(0).uniform(0.0, 19.0), draw.of(1).uniform(1.0, 14.0));
    const double turn_rad = draw.of(2).uniform(0.0, std::numbers::pi);
    const Eigen::Vector2d half = 0.8 * Eigen::Vector2d(std::cos(turn_rad), std::sin(turn_rad));
    conditions.scenario.walls.push_back(
        {.from_m = at - half, .to_m = at + half, .top_m = 2.4, .material = machine});
  }
}

}  // namespace

const std::vector<Factor>& factors() {
  static const std::vector<Factor> all = [] {
    std::vector<Factor> out;
    out.push_back({"pose-noise", "white noise of the poses that calibrate, m",
                   levels({0.0, 0.01, 0.03, 0.1, 0.3}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.scenario.pose_prior.white_sigma_m = value;
                            conditions.scenario.pose_prior.white_sigma_rad = 0.2 * value;
                          }),
                   1});
    out.push_back({"pose-drift", "slow drift of the poses that calibrate, m",
                   levels({0.0, 0.02, 0.05, 0.1, 0.2, 0.5}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.scenario.pose_prior.correlated_sigma_m = value;
                            conditions.scenario.pose_prior.correlated_sigma_rad = 0.15 * value;
                          }),
                   1});
    out.push_back({"pose-bias", "turn of the poses' heading, rad",
                   levels({0.0, 0.01, 0.03, 0.1, 0.2}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.alter = [value](io::Dataset& calibrates, io::Dataset&) {
                              for (model::PoseSample& pose : calibrates.pose_prior) pose.yaw_rad += value;
                            };
                          }),
                   0});
    out.push_back({"unevenness", "unevenness of a floor that is taken for flat, m",
                   levels({0.0, 0.01, 0.03, 0.06, 0.12}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.scenario.ground = sim::uneven_ground(grid(), {hall(value)}, 11);
                          }),
                   0});
    out.push_back(
        {"ramp", "slope of a floor that is taken for flat",
         levels({0.0, 0.01, 0.03, 0.06, 0.1}, "{:g}",
                [](Conditions& conditions, double value) {
                  conditions.scenario.ground = sim::uneven_ground(grid(), {hall(0.0, {value, 0.0})}, 11);
                }),
         0});
    out.push_back({"surface-height", "error of the floor's height after the calibration, m",
                   levels({0.0, 0.05, 0.1, 0.2, 0.5}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.alter = [value](io::Dataset&, io::Dataset& localizes) {
                              localizes.surface = model::Plane(value, {0.0, 0.0, 1.0});
                            };
                          }),
                   0});
    out.push_back({"excitation", "shape and length of the drive that calibrates", excitation(), 4});
    out.push_back({"obstacles", "machines in the hall, 1.6 m wide and 2.4 m high",
                   levels({0, 5, 10, 20, 40}, "{:g}", add_obstacles), 0});
    out.push_back({"range-sigma", "configured sigma of the ranges over the true one",
                   levels({0.1, 0.3, 1.0, 3.0, 10.0}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.scenario.range_sigma_m = 0.03 * value;
                          }),
                   2});
    out.push_back({"odometry-sigma", "configured sigmas of the odometry over the true ones",
                   levels({0.1, 0.3, 1.0, 3.0, 10.0}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.alter = [value](io::Dataset&, io::Dataset& localizes) {
                              model::OdometryNoise& noise = localizes.odometry_noise;
                              noise.sigma_vx_mps *= value;
                              noise.sigma_vy_mps *= value;
                              noise.sigma_omega_radps *= value;
                            };
                          }),
                   2});
    out.push_back({"anchors",
                   "anchors in the hall",
                   {{"3 (4, 7, 11)", 3,
                     [](Conditions& conditions) {
                       keep_anchors(conditions, {4, 7, 11});
                     }},
                    {"4 (4, 5, 7, 11)", 4,
                     [](Conditions& conditions) {
                       keep_anchors(conditions, {4, 5, 7, 11});
                     }},
                    {"4 in line (8, 9, 10, 11)", 4.5,
                     [](Conditions& conditions) {
                       keep_anchors(conditions, {8, 9, 10, 11});
                     }},
                    {"6", 6,
                     [](Conditions& conditions) {
                       keep_anchors(conditions, {4, 5, 6, 7, 8, 11});
                     }},
                    {"8", 8,
                     [](Conditions& conditions) {
                       keep_anchors(conditions, {4, 5, 6, 7, 8, 9, 10, 11});
                     }},
                    {"12", 12, [](Conditions&) {}}},
                   5});
    out.push_back({"tags",
                   "tags",
                   {{"1 (tag 1)", 1, [](Conditions& conditions) { keep_tags(conditions, {1}); }},
                    {"1 (tag 3, low)", 1.5, [](Conditions& conditions) { keep_tags(conditions, {3}); }},
                    {"2 (tags 1, 2)", 2,
                     [](Conditions& conditions) {
                       keep_tags(conditions, {1, 2});
                     }},
                    {"3", 3, [](Conditions&) {}}},
                   3});
    out.push_back(
        {"range-rate", "ranges per second",
         levels({5, 15, 50, 150, 300}, "{:g}",
                [](Conditions& conditions, double value) { conditions.measurement.ranges_per_s = value; }),
         4});
    out.push_back(
        {"loss", "share of ranges that are lost",
         levels({0.0, 0.2, 0.5, 0.8, 0.95}, "{:g}",
                [](Conditions& conditions, double value) { conditions.scenario.radio.loss = value; }),
         0});
    out.push_back({"clock", "ranges' times are late, s",
                   levels({0.0, 0.01, 0.03, 0.1, 0.3}, "{:g}",
                          [](Conditions& conditions, double value) {
                            conditions.alter = [value](io::Dataset& calibrates, io::Dataset& localizes) {
                              for (io::Dataset* drive : {&calibrates, &localizes}) {
                                for (model::RangeSample& range : drive->ranges) range.t_s += value;
                              }
                            };
                          }),
                   0});
    return out;
  }();
  return all;
}

Json run_factor(const Factor& factor, std::uint64_t seed) {
  Json out = Json::array();
  for (const Level& level : factor.levels) {
    Conditions conditions{.scenario = sim::paper_warehouse(), .measurement = {}, .alter = {}};
    level.change(conditions);
    conditions.measurement.seed = seed;
    std::vector<io::Dataset> drives = simulation::measure_drives(conditions.scenario, conditions.measurement);
    io::Dataset& calibrates = drives.at(0);
    io::Dataset& localizes = drives.at(1);
    flatten(calibrates);
    flatten(localizes);
    if (conditions.alter) conditions.alter(calibrates, localizes);
    const model::Calibration calibration = calibrate(calibrates).calibration;
    double sum_m = 0.0;
    double count = 0.0;
    for (const model::Anchor& anchor : conditions.scenario.anchors) {
      const model::AnchorCalibration* found = model::find_anchor(calibration, anchor.id);
      if (found == nullptr || found->verdict != model::AnchorVerdict::kOk) continue;
      sum_m += (found->position_m - anchor.position_m).norm();
      count += 1.0;
    }
    out.push_back({{"label", level.label},
                   {"x", level.x},
                   {"score", score(localize(localizes, calibration, filter::Model::kSchmidt).rows,
                                   localizes.ground_truth)},
                   {"anchors_ok", count},
                   {"anchor_error_m", count > 0.0 ? Json(sum_m / count) : Json(nullptr)}});
  }
  return out;
}

}  // namespace groma::reproduce
