#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/reproduce/drawn_calibration.hpp"
#include "host/reproduce/rows.hpp"
#include "host/reproduce/study.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::reproduce {

namespace {

constexpr double kRangesPer_s = 200.0;
constexpr double kMostAnchorError_m = 0.05;
// Of the odometry, for the paper's filters: they know no wrong wheelbase, steering offset and slip, and need
// white noise that makes up for them (half a radian in 270 s).
constexpr model::OdometryNoise kWhiteNoise{0.3, 0.1, 0.1};

// Table III; then ours with a calibration of its own, from another drive.
const std::vector<Row>& table3_rows() {
  static const std::vector<Row> rows{{"odometry", "paper-odometry", filter::Model::kOdometry, {}},
                                     {"original", "paper-original", filter::Model::kOriginal, {}},
                                     {"adapted", "paper-adapted", filter::Model::kSchmidt, {}},
                                     {"joint", "", filter::Model::kJoint, {}}};
  return rows;
}

}  // namespace

Json run_forklift(const Settings& settings) {
  const sim::Scenario scenario = sim::paper_forklift();
  std::vector<io::Dataset> drives =
      simulation::measure_drives(scenario, {.seed = settings.seed, .ranges_per_s = kRangesPer_s});
  for (io::Dataset& drive : drives) flatten(drive);
  const io::Dataset& yard = drives.at(1);
  const sim::World world(scenario, settings.seed);
  const model::Calibration given =
      pre_calibration(world, yard, scenario.anchors, kMostAnchorError_m, settings.seed);
  const model::Calibration own = calibrate(drives.at(0)).calibration;
  io::Dataset white = yard;
  white.odometry_noise = kWhiteNoise;
  std::vector<Row> ours{table3_rows()[2]};
  ours.front().published.clear();
  return {{"pre-calibrated", run_rows(table3_rows(), {yard, given}, {white, given}, settings)},
          {"calibrated by another drive", run_rows(ours, {yard, own}, {yard, own}, settings)}};
}

}  // namespace groma::reproduce
