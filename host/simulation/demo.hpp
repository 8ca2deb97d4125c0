// The complete system in simulation: simulated tags and anchors run the firmware, a first drive calibrates
// the anchors, every model localizes a second drive, and all results are scored against the truth.
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

// One model's estimate of the second drive.
struct ModelRun {
  filter::Model model = filter::Model::kOdometry;
  std::vector<model::PlanarEstimate> estimate;  // one per odometry sample
  evaluation::Evaluation evaluation;
};

struct DemoResult {
  calibration::Result calibration;
  double calibration_wall_s = 0.0;
  std::vector<double> anchor_errors_m;  // of calibration.anchors, in their order
  std::vector<ModelRun> models;
  io::Dataset first_drive;  // measurements and truth
  io::Dataset second_drive;
  double ranges_per_s = 0.0;      // delivered to the estimators, mean over both drives
  double nlos_share = 0.0;        // NLOS share of these ranges
  std::uint64_t frames_lost = 0;  // reports lost in the nodes' queues and on the links together
  double simulated_s = 0.0;
  double wall_s = 0.0;
};

struct DemoOptions {
  SiteOptions site{};
  std::span<const filter::Model> models = filter::kModels;
  // Called regularly with the current phase and the completed share, 0..1. May be empty.
  std::function<void(std::string_view phase, double done)> progress;
};

// The scenario has at least two drives; further drives are ignored. Throws io::DeviceError and
// sim::SimulationError as LockStep does, and io::DataError if a model gave no estimate.
[[nodiscard]] DemoResult run_demo(const sim::Scenario& scenario, const DemoOptions& options);

}  // namespace groma::simulation
