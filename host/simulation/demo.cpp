#include "host/simulation/demo.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <string>
#include <utility>

#include "host/daemon/calibration_drive.hpp"
#include "host/daemon/localizer.hpp"
#include "host/io/error.hpp"
#include "host/simulation/drive_dataset.hpp"
#include "host/simulation/lock_step.hpp"

namespace groma::simulation {

namespace {

constexpr double kProgressStep_s = 1.0;

double seconds_since(std::chrono::steady_clock::time_point begin) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}

model::PlanarEstimate planar(const daemon::PoseEstimate& pose) {
  return {pose.t_s, pose.x_m, pose.y_m, pose.yaw_rad, pose.planar_covariance};
}

std::vector<double> errors_of(const model::Calibration& calibration,
                              const std::vector<model::Anchor>& truth) {
  std::vector<double> errors;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const auto found =
        std::find_if(truth.begin(), truth.end(), [&](const model::Anchor& a) { return a.id == anchor.id; });
    errors.push_back(found == truth.end() ? std::nan("") : (anchor.position_m - found->position_m).norm());
  }
  return errors;
}

double nlos_share(const sim::World& world, const std::vector<model::RangeSample>& first,
                  const std::vector<model::RangeSample>& second) {
  std::size_t nlos = 0;
  for (const auto* ranges : {&first, &second}) {
    for (const model::RangeSample& range : *ranges) {
      nlos += world.is_los(range.tag_id, range.anchor_id, range.t_s) ? 0U : 1U;
    }
  }
  const std::size_t all = first.size() + second.size();
  return all == 0 ? 0.0 : static_cast<double>(nlos) / static_cast<double>(all);
}

}  // namespace

DemoResult run_demo(const sim::Scenario& scenario, const DemoOptions& options) {
  const auto begin = std::chrono::steady_clock::now();
  LockStep site(scenario, options.site);
  const sim::World& world = site.site().world();
  const sim::DriveTime& first = world.drives().at(0);
  const sim::DriveTime& second = world.drives().at(1);
  const auto run_until = [&](double t_s, std::string_view phase) {
    for (double next_s = site.site().now_s(); next_s < t_s;) {
      next_s = std::min(next_s + kProgressStep_s, t_s);
      site.run_until(next_s);
      if (options.progress) options.progress(phase, next_s / second.end_s);
    }
  };
  DemoResult result;
  result.first_drive = empty_dataset(scenario, first.name);
  result.second_drive = empty_dataset(scenario, second.name);

  {
    DriveRecorder recorder(result.first_drive);
    daemon::CalibrationDrive drive(scenario.tags, scenario.ground, result.first_drive.range_priors);
    site.session().attach(recorder);
    site.session().attach(drive);
    run_until(first.end_s, "calibration drive");
    site.session().detach(recorder);
    site.session().detach(drive);
    const auto solve_begin = std::chrono::steady_clock::now();
    result.calibration = drive.solve();
    result.calibration_wall_s = seconds_since(solve_begin);
  }
  result.anchor_errors_m = errors_of(result.calibration.calibration, scenario.anchors);

  for (const filter::Model model : options.models) result.models.push_back({model, {}, {}});
  std::vector<std::unique_ptr<daemon::Localizer>> localizers;
  for (ModelRun& run : result.models) {
    daemon::Localizer::Setup setup;
    setup.surface = scenario.ground;
    setup.tags = scenario.tags;
    setup.calibration = result.calibration.calibration;
    setup.filter.model = run.model;
    setup.filter.odometry = scenario.odometry.noise;
    setup.filter.range_sigma_m = scenario.range_sigma_m;
    setup.tracker.relocates = false;  // the models are compared from one start
    localizers.push_back(std::make_unique<daemon::Localizer>(
        std::move(setup),
        [&run](const daemon::PoseEstimate& pose) { run.estimate.push_back(planar(pose)); }));
    site.session().attach(*localizers.back());
  }
  DriveRecorder recorder(result.second_drive);
  site.session().attach(recorder);
  run_until(second.end_s, "second drive");
  site.session().flush();

  complete(result.first_drive, world, first);
  complete(result.second_drive, world, second);
  for (ModelRun& run : result.models) {
    const auto errors = evaluation::pose_errors(run.estimate, result.second_drive.ground_truth);
    const auto evaluation = evaluation::evaluate(errors);
    if (!evaluation) {
      throw io::DataError({result.second_drive.name},
                          fmt::format("the model {} gave no estimate", filter::model_name(run.model)),
                          "make the drive longer");
    }
    run.evaluation = *evaluation;
  }
  const std::vector<model::RangeSample>& first_ranges = result.first_drive.ranges;
  const std::vector<model::RangeSample>& second_ranges = result.second_drive.ranges;
  result.simulated_s = second.end_s;
  result.ranges_per_s = static_cast<double>(first_ranges.size() + second_ranges.size()) / second.end_s;
  result.nlos_share = nlos_share(world, first_ranges, second_ranges);
  result.frames_lost = site.session().frames_lost();
  result.wall_s = seconds_since(begin);
  return result;
}

}  // namespace groma::simulation
