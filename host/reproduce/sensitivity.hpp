// What the source paper leaves open: how accuracy depends on what a site and a robot are like.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "firmware/sim/world/scenario.hpp"
#include "host/reproduce/score.hpp"
#include "host/simulation/drive_dataset.hpp"

namespace groma::reproduce {

// What a level changes: the simulated site, how its ranges are measured, and then the data as an estimator
// sees them.
struct Conditions {
  sim::Scenario scenario;
  simulation::MeasurementOptions measurement;
  std::function<void(io::Dataset& calibrates, io::Dataset& localizes)> alter;
};

struct Level {
  std::string label;
  double x = 0.0;
  std::function<void(Conditions&)> change;
};

struct Factor {
  std::string name;
  std::string meaning;  // with the unit
  std::vector<Level> levels;
  std::size_t usual = 0;  // index of the level that is nearest to the warehouse as it is
};

[[nodiscard]] const std::vector<Factor>& factors();

// One drive of the warehouse calibrates, another one is localized by `schmidt`, at each level:
// [{"label", "x", "score", "anchors_ok", "anchor_error_m"}, ...].
[[nodiscard]] Json run_factor(const Factor& factor, std::uint64_t seed);

}  // namespace groma::reproduce
