// groma replay: a recorded drive through the filter, as it would have gone on the robot.
#include "host/filter/replay.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/exit_code.hpp"
#include "host/cli/json.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/output_file.hpp"
#include "host/model/calibration.hpp"

namespace groma::cli {

namespace {

constexpr double kSurveySigma_m = 0.02;

struct Options {
  std::filesystem::path dataset;
  std::optional<std::filesystem::path> calibration;
  bool surveyed = false;
  std::string model{filter::model_name(filter::Config{}.model)};
  Selection selection;
  std::optional<std::array<double, 3>> start;
  std::filesystem::path output;
  bool json = false;
};

std::vector<std::string> model_names() {
  std::vector<std::string> names;
  names.reserve(filter::kModels.size());
  for (const filter::Model model : filter::kModels) names.emplace_back(filter::model_name(model));
  return names;
}

model::Calibration load_calibration(const Options& options, const io::Dataset& dataset, Warnings& warnings) {
  if (options.surveyed) {
    if (dataset.surveyed_anchors.empty()) {
      throw io::DataError({options.dataset / "anchors.csv"}, "there are no surveyed anchors",
                          "add them, or give a calibration by --calibration");
    }
    return model::surveyed_calibration(dataset.surveyed_anchors, dataset.tags, dataset.range_priors,
                                       kSurveySigma_m);
  }
  model::Calibration calibration = io::read_calibration(*options.calibration);
  if (calibration.verdict == model::Verdict::kUnusable) {
    warnings.add(fmt::format("{}: its verdict is 'unusable'; trust no estimate made with it",
                             options.calibration->string()));
  }
  return calibration;
}

filter::Start find_start(const Options& options, const io::Dataset& dataset) {
  constexpr double kFirst = -std::numeric_limits<double>::infinity();
  const double from_s = options.selection.from_s().value_or(kFirst);
  if (options.start) {
    const auto first = std::find_if(dataset.odometry.begin(), dataset.odometry.end(),
                                    [&](const model::OdometrySample& row) { return row.t_s >= from_s; });
    if (first == dataset.odometry.end()) return {};
    const auto [x_m, y_m, yaw_rad] = *options.start;
    filter::Start start;
    start.t_s = options.selection.from_s().value_or(first->t_s);
    start.pose = {x_m, y_m, yaw_rad};
    return start;
  }
  const std::optional<filter::Start> start =
      filter::start_from_prior(dataset.pose_prior, from_s, dataset.surface);
  if (!start) {
    throw io::DataError({options.dataset}, "there is no pose prior to start from in the chosen time",
                        "choose another --from and --to, or give --start X,Y,YAW");
  }
  return *start;
}

std::int64_t now_ns() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
}

int run(const Options& options) {
  if (options.surveyed == options.calibration.has_value()) {
    throw CLI::ValidationError("replay", "give either --calibration FILE or --surveyed");
  }
  io::expect_writable(options.output);
  io::ReadOptions read;
  read.surveyed_anchors = options.surveyed;
  read.ground_truth = false;
  read.pose_prior = !options.start;
  read.log_section = options.selection.section();
  io::Dataset dataset = io::read_dataset(options.dataset, read);
  Warnings warnings;
  warnings.add(dataset);
  const model::Calibration calibration = load_calibration(options, dataset, warnings);
  options.selection.apply(dataset);

  filter::ReplayOptions replay;
  replay.config.model = *filter::model_from_name(options.model);
  replay.config.odometry = dataset.odometry_noise;
  replay.config.range_sigma_m = dataset.range_priors.sigma_m;
  replay.start = find_start(options, dataset);
  replay.to_s = options.selection.to_s();
  replay.now_ns = now_ns;
  const auto begin = std::chrono::steady_clock::now();
  const filter::ReplayResult result = filter::replay(
      {dataset.odometry, dataset.ranges, dataset.tags, &dataset.surface, &calibration}, replay);
  const double wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  if (result.rows.empty()) {
    throw io::DataError({options.dataset / "odometry.csv"}, "there is no odometry in the chosen time",
                        "choose another --from and --to");
  }
  io::write_file(options.output, io::format_estimate(result.rows));

  const filter::Counters& counters = result.counters;
  if (counters.ranges_unknown_anchor > 0) {
    warnings.add(fmt::format("{} ranges to anchors, or of pairs, that the calibration lacks were ignored",
                             counters.ranges_unknown_anchor));
  }
  const double duration_s = result.rows.back().t_s - replay.start.t_s;
  const double realtime_factor = wall_s > 0.0 ? duration_s / wall_s : 0.0;
  if (options.json) {
    say_json(Json{{"model", options.model},
                  {"ranges_seen", result.ranges_seen},
                  {"ranges_used", counters.ranges_used},
                  {"ranges_gated", counters.ranges_gated},
                  {"ranges_unknown_anchor", counters.ranges_unknown_anchor},
                  {"ranges_not_active", counters.ranges_not_active},
                  {"anchor_exchanges", counters.anchor_exchanges},
                  {"dropped", to_json(dataset.dropped)},
                  {"wall_s", wall_s},
                  {"realtime_factor", realtime_factor},
                  {"propagate_ns", {{"p50", result.propagate_ns.p50}, {"p99", result.propagate_ns.p99}}},
                  {"update_ns", {{"p50", result.update_ns.p50}, {"p99", result.update_ns.p99}}}});
  } else {
    say(fmt::format("{}: {} poses over {:.1f} s, written to {}\n", options.model, result.rows.size(),
                    duration_s, options.output.string()));
    say(fmt::format("{} ranges seen, {} used, {} gated; {:.0f} times real time\n", result.ranges_seen,
                    counters.ranges_used, counters.ranges_gated, realtime_factor));
  }
  return warnings.exit_code();
}

}  // namespace

void add_replay(CLI::App& app, Action& action) {
  const auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("replay",
                                         "Run the filter over a recorded drive. It sees no range, odometry "
                                         "row or pose before its time, and of the poses "
                                         "none but the first, from which it starts (sigma 0.1 m, 0.05 rad).");
  command
      ->add_option("DATASET_OR_LOG", options->dataset,
                   "Folder of the drive (dataset.yaml, ranges.csv, odometry.csv, ...), or the log that "
                   "gromad recorded")
      ->required();
  command->add_option("--calibration", options->calibration,
                      "Calibration file that groma calibrate has written");
  command->add_flag(
      "--surveyed", options->surveyed,
      "In its place: the positions of anchors.csv with sigma 0.02 m, biases at the data set's priors");
  command
      ->add_option(
          "--model", options->model,
          fmt::format(
              "How ranges are used: odometry (not at all), original (as pure distances), inflated "
              "(bias-aware, calibration uncertainty as white noise), schmidt (bias-aware, with all "
              "correlations to the calibration), anchor-states (anchor positions estimated too), joint "
              "(the whole calibration estimated too). Default: {}, which measures best",
              options->model))
      ->check(CLI::IsMember(model_names()))
      ->type_name("NAME");
  options->selection.add_options(*command);
  command
      ->add_option_function<std::string>(
          "--start",
          [options](const std::string& text) {
            const std::vector<double> values = parse_numbers("--start", text, 3);
            options->start = {values[0], values[1], values[2]};
          },
          "Start from this pose (m, rad) in the place of the first pose prior at or after --from")
      ->type_name("X,Y,YAW");
  command->add_option("-o,--output", options->output, "Table to write, one row for each odometry row")
      ->required();
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
