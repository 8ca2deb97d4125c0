#include <algorithm>
#include <array>
#include <string>
#include <vector>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "host/reproduce/rows.hpp"
#include "host/reproduce/study.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::reproduce {

namespace {

constexpr std::array kMethods{"paper-original", "paper-adapted",   "trilateration",
                              "iterated-ekf",   "particle-filter", "ceres-window"};
constexpr double kPerMicrosecond = 1e-3;

// As groma-baselines counts: with the share of the odometry samples.
double in_all_per_range_ns(const Localized& run) {
  const auto samples = static_cast<double>(run.rows.size());
  return run.update_ns + run.propagate_ns * samples / std::max(1.0, static_cast<double>(run.ranges));
}

}  // namespace

Json run_baselines(const Settings& settings) {
  std::vector<io::Dataset> drives =
      simulation::measure_drives(sim::paper_warehouse(), {.seed = settings.seed});
  io::Dataset& calibrates = drives.at(0);
  io::Dataset& localizes = drives.at(1);
  flatten(calibrates);
  flatten(localizes);
  const model::Calibration calibration = calibrate(calibrates).calibration;
  Json out;
  for (const filter::Model model : {filter::Model::kSchmidt, filter::Model::kJoint}) {
    const Localized run = localize(localizes, calibration, model);
    out[std::string(filter::model_name(model))] = {
        {"score", score(run.rows, localizes.ground_truth)},
        {"us_per_range", kPerMicrosecond * in_all_per_range_ns(run)}};
  }
  if (!settings.baselines.is_there()) return out;
  for (const bool is_tuned : {false, true}) {
    const std::vector<std::string> methods(kMethods.begin(), kMethods.end());
    const auto estimates =
        settings.baselines.run(localizes, calibration, methods, {}, is_tuned, settings.scratch);
    for (std::size_t i = 0; i < methods.size(); ++i) {
      out[methods[i] + (is_tuned ? ", tuned" : "")] = {
          {"score", score(estimates[i].rows, localizes.ground_truth)},
          {"us_per_range", kPerMicrosecond * estimates[i].facts.value("ns_in_all_per_range", 0.0)}};
    }
  }
  return out;
}

}  // namespace groma::reproduce
