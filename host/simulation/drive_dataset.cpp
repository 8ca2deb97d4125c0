#include "host/simulation/drive_dataset.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "firmware/sim/keyed_random.hpp"
#include "host/model/samples.hpp"
#include "host/simulation/lock_step.hpp"

namespace groma::simulation {

namespace {

constexpr double kTruthRate_hz = 25.0;

enum MeasurementPurpose : std::uint64_t { kRangeNoise = 0x6D65, kRangeLoss };

// Calls function(k) for each k with k / rate_hz in the drive.
template <class Function>
void for_each_sample(const sim::DriveTime& drive, double rate_hz, const Function& function) {
  const auto end = static_cast<std::uint64_t>(std::floor(drive.end_s * rate_hz));
  for (auto k = static_cast<std::uint64_t>(std::ceil(drive.begin_s * rate_hz)); k <= end; ++k) function(k);
}

// Estimators need a sigma, even where all pairs of the scenario have the same value.
model::ScalarPrior prior_of(const model::ScalarPrior& simulated, const model::ScalarPrior& usual) {
  return {simulated.mean, simulated.sigma > 0.0 ? simulated.sigma : usual.sigma};
}

}  // namespace

io::Dataset empty_dataset(const sim::Scenario& scenario, const std::string& drive) {
  io::Dataset dataset;
  dataset.name = fmt::format("{}/{}", scenario.name, drive);
  dataset.origin = "simulated";
  dataset.odometry_noise = scenario.odometry.noise;
  const model::RangePriors usual;
  dataset.range_priors = {scenario.range_sigma_m, prior_of(scenario.biases.beta_m, usual.beta_m),
                          prior_of(scenario.biases.gamma, usual.gamma)};
  dataset.surface = scenario.ground;
  dataset.surveyed_anchors = scenario.anchors;
  dataset.tags = scenario.tags;
  return dataset;
}

void complete(io::Dataset& dataset, const sim::World& world, const sim::DriveTime& time) {
  model::sort_ranges(dataset.ranges);
  const auto by_time = [](const auto& a, const auto& b) { return a.t_s < b.t_s; };
  std::stable_sort(dataset.odometry.begin(), dataset.odometry.end(), by_time);
  std::stable_sort(dataset.pose_prior.begin(), dataset.pose_prior.end(), by_time);
  for_each_sample(time, kTruthRate_hz, [&](std::uint64_t k) {
    dataset.ground_truth.push_back(world.robot().truth(static_cast<double>(k) / kTruthRate_hz));
  });
}

std::vector<io::Dataset> measure_drives(const sim::Scenario& scenario, const MeasurementOptions& options) {
  const sim::World world(scenario, options.seed);
  const sim::Robot& robot = world.robot();
  const sim::KeyedRandom random(options.seed);
  std::vector<std::pair<model::NodeId, model::NodeId>> pairs;
  for (const model::Anchor& anchor : scenario.anchors) {
    for (const model::Tag& tag : scenario.tags) pairs.emplace_back(tag.id, anchor.id);
  }
  std::vector<io::Dataset> out;
  for (const sim::DriveTime& drive : world.drives()) {
    io::Dataset& dataset = out.emplace_back(empty_dataset(scenario, drive.name));
    for_each_sample(drive, scenario.odometry.rate_hz,
                    [&](std::uint64_t k) { dataset.odometry.push_back(robot.odometry(k)); });
    for_each_sample(drive, scenario.pose_prior.rate_hz,
                    [&](std::uint64_t k) { dataset.pose_prior.push_back(robot.pose_prior(k)); });
    for_each_sample(drive, options.ranges_per_s, [&](std::uint64_t k) {
      const double t_s = static_cast<double>(k) / options.ranges_per_s;
      const auto& [tag, anchor] = pairs[k % pairs.size()];
      const sim::Propagation seen = world.between(tag, anchor, t_s);
      if (!seen.audible || random.of(kRangeLoss, k).uniform() < scenario.radio.loss) return;
      dataset.ranges.push_back(
          {.t_s = t_s,
           .tag_id = tag,
           .anchor_id = anchor,
           .range_m = seen.flight_m + random.of(kRangeNoise, k).normal(0.0, options.sigma_m),
           .first_path_power_dbm = static_cast<float>(seen.first_path_power_dbm),
           .receive_power_dbm = static_cast<float>(seen.receive_power_dbm)});
    });
    complete(dataset, world, drive);
  }
  return out;
}

std::vector<io::Dataset> emulate_drives(const sim::Scenario& scenario, const SiteOptions& options) {
  LockStep site(scenario, options);
  const sim::World& world = site.site().world();
  std::vector<io::Dataset> out;
  for (const sim::DriveTime& drive : world.drives()) {
    io::Dataset& dataset = out.emplace_back(empty_dataset(scenario, drive.name));
    DriveRecorder recorder(dataset);
    site.session().attach(recorder);
    site.run_until(drive.end_s);
    site.session().detach(recorder);
    complete(dataset, world, drive);
  }
  return out;
}

}  // namespace groma::simulation
