// Data sets of a scenario's drives.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "firmware/sim/world/scenario.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/daemon/session.hpp"
#include "host/io/dataset.hpp"
#include "host/simulation/simulated_site.hpp"

namespace groma::simulation {

// What is known of the site, without samples.
[[nodiscard]] io::Dataset empty_dataset(const sim::Scenario& scenario, const std::string& drive);
// Sorts measurements that arrived late by time, and adds the truth.
void complete(io::Dataset& dataset, const sim::World& world, const sim::DriveTime& time);

// Stores the session's measurements in a data set.
class DriveRecorder : public daemon::MeasurementSink {
 public:
  explicit DriveRecorder(io::Dataset& dataset) : dataset_(dataset) {}

  void on_odometry(const model::OdometrySample& sample) override { dataset_.odometry.push_back(sample); }
  void on_range(const model::RangeSample& range) override { dataset_.ranges.push_back(range); }
  void on_pose_prior(const model::PoseSample& pose) override { dataset_.pose_prior.push_back(pose); }
  void on_clock_set() override {}

 private:
  io::Dataset& dataset_;
};

struct MeasurementOptions {
  std::uint64_t seed = 1;
  double ranges_per_s = 300.0;  // that are tried, by all pairs of tag and anchor in turn
  double sigma_m = 0.03;        // of a range, white; about that of the emulated radio
};

// All drives of a scenario without nodes and frames, which takes a hundredth of the time of LockStep: a range
// is the flight of the world with white noise, and is lost as a frame is.
[[nodiscard]] std::vector<io::Dataset> measure_drives(const sim::Scenario& scenario,
                                                      const MeasurementOptions& options);

// All drives of a scenario, as LockStep records them. Throws as LockStep.
[[nodiscard]] std::vector<io::Dataset> emulate_drives(const sim::Scenario& scenario,
                                                      const SiteOptions& options);

}  // namespace groma::simulation
