// The whole path at work: simulated tags and anchors run the firmware, a first drive calibrates the anchors,
// a second is localized by every model, and all is scored against the truth.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string_view>
#include <vector>

#include "firmware/sim/world/scenario.hpp"
#include "host/calibration/calibrate.hpp"
#include "host/evaluation/evaluation.hpp"
#include "host/filter/config.hpp"
#include "host/io/dataset.hpp"
#include "host/model/types.hpp"
#include "host/simulation/simulated_site.hpp"

namespace groma::simulation {

// One model's way through the second drive.
struct ModelRun {
  filter::Model model = filter::Model::kOdometry;
  std::vector<model::PlanarEstimate> estimate;  // a row for each odometry row
  evaluation::Evaluation evaluation;
};

struct DemoResult {
  calibration::Result calibration;
  double calibration_wall_s = 0.0;
  std::vector<double> anchor_errors_m;  // of calibration.anchors, in their order
  std::vector<ModelRun> models;
  io::Dataset first_drive;  // what was measured, with the truth
  io::Dataset second_drive;
  double ranges_per_s = 0.0;      // delivered to the estimators, over both drives
  double without_sight = 0.0;     // share of these whose straight way was blocked
  std::uint64_t frames_lost = 0;  // reports, in the nodes' queues and on the links together
  double simulated_s = 0.0;
  double wall_s = 0.0;
};

struct DemoOptions {
  SiteOptions site{};
  std::span<const filter::Model> models = filter::kModels;
  // Told now and then: what goes on, and the share of the whole that is done. May be empty.
  std::function<void(std::string_view phase, double done)> progress;
};

// The scenario has two drives or more; what comes after the second is left out. Throws io::DeviceError and
// sim::SimulationError as LockStep does, and io::DataError where a model gave no estimate.
[[nodiscard]] DemoResult run_demo(const sim::Scenario& scenario, const DemoOptions& options);

}  // namespace groma::simulation
