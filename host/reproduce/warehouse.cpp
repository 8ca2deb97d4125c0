#include <algorithm>
#include <cmath>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/calibration/calibrate.hpp"
#include "host/reproduce/drawn_calibration.hpp"
#include "host/reproduce/rows.hpp"
#include "host/reproduce/study.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::reproduce {

namespace {

constexpr double kCurveStep_s = 1.0;
// Anchor 13 malfunctioned on the paper's outdoor drive.
constexpr model::NodeId kSilent = 13;

// Table II.
const std::vector<Row>& table2_rows() {
  static const std::vector<Row> rows{
      {"odometry", "paper-odometry", filter::Model::kOdometry, {}},
      {"original", "paper-original", filter::Model::kOriginal, {}},
      {"adapted", "paper-adapted", filter::Model::kSchmidt, {}},
      {"anchor-states", "paper-anchor-states", filter::Model::kAnchorStates, {}},
      {"joint", "", filter::Model::kJoint, {}},
      {"anchors 5-8-12-14", "paper-adapted", filter::Model::kSchmidt, {.anchors = {5, 8, 12, 14}}},
      {"tags 1-2", "paper-adapted", filter::Model::kSchmidt, {.tags = {1, 2}}},
      {"tag 1", "paper-adapted", filter::Model::kSchmidt, {.tags = {1}}},
      {"tag 3", "paper-adapted", filter::Model::kSchmidt, {.tags = {3}}},
  };
  return rows;
}

std::vector<Row> indoor_rows() {
  const std::vector<Row>& rows = table2_rows();
  return {rows.begin(), rows.begin() + 3};
}

struct Warehouse {
  io::Dataset indoor;
  io::Dataset again;
  io::Dataset outdoor;
  std::vector<model::Anchor> anchors;
  calibration::Result ours;
  model::Calibration drawn;
};

Warehouse simulate(const Settings& settings) {
  const sim::Scenario scenario = sim::paper_warehouse();
  std::vector<io::Dataset> drives = settings.is_emulated
                                        ? simulation::emulate_drives(scenario, {.seed = settings.seed})
                                        : simulation::measure_drives(scenario, {.seed = settings.seed});
  // The filters take the floor for flat.
  for (io::Dataset& drive : drives) flatten(drive);
  Warehouse out{.indoor = std::move(drives.at(0)),
                .again = std::move(drives.at(1)),
                .outdoor = std::move(drives.at(2)),
                .anchors = scenario.anchors,
                .ours = {},
                .drawn = {}};
  std::erase_if(out.outdoor.ranges,
                [](const model::RangeSample& range) { return range.anchor_id == kSilent; });
  out.ours = calibrate(out.indoor);
  const sim::World world(scenario, settings.seed);
  out.drawn = drawn_calibration(world, out.indoor, out.anchors, settings.seed);
  return out;
}

Json table1(const Warehouse& site) {
  Json anchors = Json::array();
  double sum_m = 0.0;
  for (const model::Anchor& anchor : site.anchors) {
    const model::AnchorCalibration* found = model::find_anchor(site.ours.calibration, anchor.id);
    if (found == nullptr || !model::has_position(*found)) {
      anchors.push_back({{"id", anchor.id}, {"error_m", nullptr}});
      continue;
    }
    const Eigen::Vector3d error_m = found->position_m - anchor.position_m;
    const Eigen::Matrix3d covariance = found->covariance.topLeftCorner<3, 3>();
    sum_m += error_m.norm();
    anchors.push_back({{"id", anchor.id},
                       {"error_m", error_m.norm()},
                       {"height_error_m", std::abs(error_m.z())},
                       {"sigma_m", std::sqrt(covariance.trace())},
                       {"nees", error_m.dot(covariance.ldlt().solve(error_m)) / 3.0},
                       {"is_ok", found->verdict == model::AnchorVerdict::kOk}});
  }
  return {{"anchors", std::move(anchors)},
          {"mean_m", sum_m / static_cast<double>(site.anchors.size())},
          {"ranges", site.indoor.ranges.size()}};
}

// Positions of the anchors as they are estimated, each second: [[t_s, id, error_m], ...].
Json anchor_curves(const Warehouse& site, filter::Model model) {
  Json out = Json::array();
  double next_s = -1.0;
  std::optional<filter::ReplayOptions> options = replay_options(site.outdoor, model);
  if (!options) return out;
  options->on_odometry = [&](const filter::Tracker& tracker, const model::OdometrySample& sample) {
    if (sample.t_s < next_s) return;
    next_s = sample.t_s + kCurveStep_s;
    const filter::Filter& filter = tracker.filter().filter();
    for (const model::Anchor& anchor : site.anchors) {
      const int index = filter.site().anchor_index(anchor.id);
      const int slot = index < 0 ? -1 : filter.parameters().slot_of(index);
      if (slot < 0) continue;
      const Eigen::Vector3d at = filter.parameters().values().segment<3>(filter.parameters().position(slot));
      out.push_back({sample.t_s, anchor.id, (at - anchor.position_m).norm()});
    }
  };
  static_cast<void>(filter::replay({site.outdoor.odometry, site.outdoor.ranges, site.outdoor.tags,
                                    &site.outdoor.surface, &site.ours.calibration, nullptr},
                                   *options));
  return out;
}

}  // namespace

Json run_warehouse(const Settings& settings, const Wanted& wanted) {
  const Warehouse site = simulate(settings);
  const model::Calibration& ours = site.ours.calibration;
  Json out = Json::object();
  if (wanted.contains("table1")) out["table1"] = table1(site);
  if (wanted.contains("indoor")) {
    out["indoor"] = {
        {"same drive", run_rows(indoor_rows(), {site.indoor, ours}, {site.indoor, site.drawn}, settings)},
        {"other drive", run_rows(indoor_rows(), {site.again, ours}, {site.again, site.drawn}, settings)}};
  }
  if (wanted.contains("table2"))
    out["table2"] = run_rows(table2_rows(), {site.outdoor, ours}, {site.outdoor, site.drawn}, settings);
  if (wanted.contains("anchor-states") && settings.has_curves)
    out["anchor-states"] = anchor_curves(site, filter::Model::kAnchorStates);
  return out;
}

}  // namespace groma::reproduce
