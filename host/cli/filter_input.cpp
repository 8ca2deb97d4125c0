#include "host/cli/filter_input.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/clock_fix.hpp"
#include "host/diagnosis/diagnose.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/csv.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/model/plausible.hpp"

namespace groma::cli {

namespace {

constexpr double kSurveySigma_m = 0.02;

}  // namespace

void FilterInput::add_options(CLI::App& command) {
  command
      .add_option("DATASET_OR_LOG", dataset_,
                  "Folder of the drive (dataset.yaml, ranges.csv, odometry.csv, ...), or the log that "
                  "gromad recorded")
      ->required();
  command.add_option("--calibration", calibration_, "Calibration file that groma calibrate wrote")
      ->type_name("FILE");
  command.add_flag(
      "--surveyed", surveyed_,
      "Instead of it: the positions of anchors.csv with sigma 0.02 m, biases at the data set's priors");
  selection_.add_options(command);
  command
      .add_option_function<std::string>(
          "--start",
          [this](const std::string& text) {
            const std::vector<double> values = parse_numbers("--start", text, 3);
            start_ = {values[0], values[1], values[2]};
            if (!model::is_plausible(
                    model::PoseSample{.x_m = values[0], .y_m = values[1], .yaw_rad = values[2]}))
              throw CLI::ValidationError("--start", "no robot is there; give metres and radians");
          },
          "Start from this pose (m, rad) instead of the first pose prior at or after --from")
      ->type_name("X,Y,YAW");
}

void FilterInput::add_output_file(CLI::App& command, const std::string& description) {
  command.add_option("-o,--output", output_, description)->required()->type_name("FILE");
}

void FilterInput::add_output(CLI::App& command) {
  add_output_file(command, "Table to write, one row per odometry sample");
  add_json(command);
}

void FilterInput::add_relocation(CLI::App& command) {
  command.add_flag("--relocate", relocates_,
                   "Re-initialize elsewhere if the ranges show another place, as gromad does; always on "
                   "without a pose to start from");
}

void FilterInput::add_json(CLI::App& command) {
  command.add_flag("--json", json_, "Print one JSON object");
}

model::Calibration FilterInput::load_calibration(const io::Dataset& dataset, Warnings& warnings) const {
  if (surveyed_) {
    if (dataset.surveyed_anchors.empty()) {
      throw io::DataError({dataset_ / "anchors.csv"}, "there are no surveyed anchors",
                          "add them, or give a calibration by --calibration");
    }
    return model::surveyed_calibration(dataset.surveyed_anchors, dataset.tags, dataset.range_priors,
                                       kSurveySigma_m);
  }
  model::Calibration calibration = io::read_calibration(*calibration_);
  if (calibration.verdict == model::Verdict::kUnusable) {
    warnings.add(fmt::format("{}: its verdict is 'unusable'; do not trust estimates made with it",
                             calibration_->string()));
  }
  return calibration;
}

std::optional<filter::Start> FilterInput::find_start(const io::Dataset& dataset) const {
  constexpr double kFirst = -std::numeric_limits<double>::infinity();
  const double from_s = selection_.from_s().value_or(kFirst);
  if (!start_) return filter::start_from_prior(dataset.pose_prior, from_s, dataset.surface);
  const auto first = std::find_if(dataset.odometry.begin(), dataset.odometry.end(),
                                  [&](const model::OdometrySample& sample) { return sample.t_s >= from_s; });
  if (first == dataset.odometry.end()) return filter::Start{};
  const auto [x_m, y_m, yaw_rad] = *start_;
  filter::Start start;
  start.t_s = selection_.from_s().value_or(first->t_s);
  constexpr double kAnyHeight_m = std::numeric_limits<double>::quiet_NaN();
  start.pose = {x_m, y_m, yaw_rad, dataset.surface.nearest(x_m, y_m, kAnyHeight_m)};
  return start;
}

io::Dataset FilterInput::read_whole(StartIs start, Warnings& warnings) const {
  io::ReadOptions read;
  read.surveyed_anchors = surveyed_;
  read.ground_truth = false;
  read.pose_prior = !start_;
  read.needs_pose_prior = start == StartIs::kNeeded;
  read.sensors = true;
  read.log_section = selection_.section();
  io::Dataset dataset = io::read_dataset(dataset_, read);
  warnings.add(dataset);
  return dataset;
}

io::Dataset FilterInput::read_drive(Warnings& warnings) const {
  io::Dataset dataset = read_whole(StartIs::kFoundOtherwise, warnings);
  selection_.apply(dataset);
  return dataset;
}

FilterInput::Drive FilterInput::read(const char* command, StartIs start, Warnings& warnings) const {
  if (surveyed_ == calibration_.has_value()) {
    throw CLI::ValidationError(command, "give either --calibration FILE or --surveyed");
  }
  Drive drive{.dataset = read_whole(start, warnings), .calibration = {}, .options = {}};
  drive.calibration = load_calibration(drive.dataset, warnings);
  if (drive.calibration.range_clock) correct_clock(*drive.calibration.range_clock, drive.dataset.ranges);
  selection_.apply(drive.dataset, drive.calibration.anchors);
  drive.options.config.odometry = drive.dataset.odometry_noise;
  drive.options.config.range_sigma_m = drive.dataset.range_priors.sigma_m;
  drive.options.relocates = relocates_;
  drive.options.config.sensors = filter::SensorConfig(drive.dataset.sensors);
  if (const auto found = find_start(drive.dataset)) {
    drive.options.start = *found;
  } else if (start == StartIs::kFoundOtherwise) {
    drive.options.knows_start = false;
    drive.options.start.t_s = selection_.from_s().value_or(-std::numeric_limits<double>::infinity());
  } else {
    throw io::DataError({dataset_}, "there is no pose prior to start from in the chosen time",
                        "choose another --from and --to, or give --start X,Y,YAW");
  }
  drive.options.to_s = selection_.to_s();
  return drive;
}

io::FilePlace FilterInput::odometry_place(double t_s) const {
  if (!std::filesystem::is_directory(dataset_)) return {dataset_};
  const std::filesystem::path path = io::odometry_file(dataset_);
  const std::string text = io::read_file(path);
  io::CsvReader csv(path, text, {{"t_s"}});
  while (csv.next()) {
    if (csv.number(0) == t_s) return csv.row_place();
  }
  return {path};
}

void FilterInput::expect_finite(std::span<const model::PlanarEstimate> rows,
                                std::span<const model::SpatialEstimate> spatial) const {
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const model::PlanarEstimate& row = rows[i];
    bool finite = std::isfinite(row.x_m) && std::isfinite(row.y_m) && std::isfinite(row.yaw_rad) &&
                  row.covariance.allFinite();
    if (i < spatial.size()) {
      const model::SpatialEstimate& at = spatial[i];
      finite = finite && std::isfinite(at.z_m) && std::isfinite(at.roll_rad) && std::isfinite(at.pitch_rad) &&
               at.covariance.allFinite();
    }
    if (finite) continue;
    throw io::DataError(
        odometry_place(row.t_s),
        fmt::format("the estimate is not finite from t_s = {} on; nothing was written", row.t_s),
        "check the calibration, the surface and the samples there, or end before it with --to");
  }
}

std::vector<diagnosis::Finding> FilterInput::diagnose(const Drive& drive) {
  diagnosis::Data data = diagnosis::data_of(drive.dataset);
  if (drive.options.knows_start && !drive.options.relocates)
    data.start = {.t_s = drive.options.start.t_s, .pose = drive.options.start.pose};
  return diagnosis::diagnose(std::move(data), drive.calibration);
}

std::optional<diagnosis::Finding> FilterInput::warn_of_mismatch(const filter::ReplayResult& result,
                                                                Warnings& warnings) {
  const auto& mismatch = result.map_mismatch;
  if (!mismatch) return std::nullopt;
  const bool is_placed = !result.rows.empty() && result.rows.front().t_s <= mismatch->t_s;
  diagnosis::Finding finding =
      diagnosis::map_mismatch(is_placed ? std::optional(mismatch->share) : std::nullopt);
  warnings.add(finding);
  return finding;
}

void FilterInput::warn_of_samples(const filter::Counters& counters, Warnings& warnings) {
  if (counters.odometry[filter::OdometryOutcome::kImplausible] > 0) {
    warnings.add(fmt::format("{} odometry samples were dropped: no robot moves or accelerates like that",
                             counters.odometry[filter::OdometryOutcome::kImplausible]));
  }
  for (std::size_t sensor = 0; sensor < model::kSensors; ++sensor) {
    const auto& of = counters.sensors.at(sensor);
    const std::size_t dropped = of[filter::SensorOutcome::kJumped] + of[filter::SensorOutcome::kBadValue];
    if (dropped == 0) continue;
    warnings.add(fmt::format("{} samples of {} were dropped: no robot can move like that", dropped,
                             model::kSensorNames.at(sensor)));
  }
}

void FilterInput::warn_of_ranges(const filter::Counters& counters, Warnings& warnings) {
  const std::size_t unknown = counters.ranges[filter::RangeOutcome::kUnknownAnchor];
  if (unknown == 0) return;
  warnings.add(
      fmt::format("{} ranges to anchors, or of pairs, that the calibration lacks were ignored", unknown));
}

void FilterInput::warn_without_ranges(std::size_t ranges_seen, Warnings& warnings) {
  warnings.add(
      ranges_seen == 0
          ? "there are no ranges of the chosen tags, anchors and time: the poses are from odometry only"
          : fmt::format("none of the {} ranges was used: the poses are from odometry only; check the "
                        "calibration and the start",
                        ranges_seen));
}

}  // namespace groma::cli
