// groma replay: runs the filter over a recorded drive, causally, as on the robot.
#include "host/filter/replay.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/filter_input.hpp"
#include "host/cli/json.hpp"
#include "host/cli/replay_stream.hpp"
#include "host/cli/replay_summary.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct ReplayOptions {
  FilterInput input;
  std::string model{filter::model_name(filter::Config{}.model)};
  std::optional<std::filesystem::path> stream;
  ReportFolder report;
};

std::vector<std::string> model_names() {
  std::vector<std::string> names;
  names.reserve(filter::kModels.size());
  for (const filter::Model model : filter::kModels) names.emplace_back(filter::model_name(model));
  return names;
}

std::int64_t now_ns() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
}

double begin_s(const FilterInput::Drive& drive) {
  if (drive.options.knows_start) return drive.options.start.t_s;
  return std::max(drive.options.start.t_s, drive.dataset.odometry.front().t_s);
}

Json sensors_json(const filter::Counters& counters) {
  using Outcome = filter::SensorOutcome;
  Json json = Json::object();
  for (std::size_t i = 0; i < model::kSensors; ++i) {
    const auto& of = counters.sensors.at(i);
    json[model::kSensorNames.at(i)] = {{"used", of[Outcome::kUsed]},
                                       {"gated", of[Outcome::kGated]},
                                       {"jumped", of[Outcome::kJumped]},
                                       {"bad_value", of[Outcome::kBadValue]},
                                       {"out_of_order", of[Outcome::kOutOfOrder]},
                                       {"not_started", of[Outcome::kNotStarted]}};
  }
  return json;
}

// The truth is read when the estimate is complete.
void write_report(const ReplayOptions& options, const FilterInput::Drive& drive,
                  const filter::ReplayResult& result, std::vector<report::RangeRow> ranges) {
  report::Page page(
      fmt::format("Replay of {}", drive.dataset.name),
      fmt::format("The model {} on a {} drive, causally.", options.model, drive.dataset.origin));
  const std::vector<model::PoseSample> truth = truth_of(options.input.dataset());
  report::add_drive(page, {.rows = result.rows,
                           .truth = truth,
                           .states = state_spans(result),
                           .calibration = &drive.calibration,
                           .ranges = std::move(ranges)});
  write_page(*options.report, std::move(page), versions_of(drive.dataset, drive.calibration));
}

// The JSON object where the data gave no poses, and the diagnosis says why.
Json empty_json(const ReplayOptions& options, const FilterInput::Drive& drive,
                const filter::ReplayResult& result, const std::vector<diagnosis::Finding>& findings) {
  return Json{{"model", options.model},
              {"ranges_seen", result.ranges_seen},
              {"ranges_used", result.counters.ranges[filter::RangeOutcome::kUsed]},
              {"ranges_gated", result.counters.ranges[filter::RangeOutcome::kGated]},
              {"state", nullptr},
              {"state_shares", Json::object()},
              {"diagnosis", diagnosis::to_json(findings)},
              {"dropped", cli::to_json(drive.dataset.dropped)},
              {"wall_s", nullptr},
              {"realtime_factor", nullptr},
              {"propagate_ns", nullptr},
              {"update_ns", nullptr}};
}

// Throws DataError if there are no poses, or some are not finite.
void expect_poses(const ReplayOptions& options, const FilterInput::Drive& drive,
                  const filter::ReplayResult& result) {
  if (result.rows.empty() && drive.options.knows_start) {
    throw io::DataError({io::odometry_file(options.input.dataset())},
                        "there is no odometry in the chosen time", "choose another --from and --to");
  }
  if (result.rows.empty()) {
    throw io::DataError({options.input.dataset()},
                        "there is no pose prior to start from in the chosen time, and no start was found "
                        "from ranges and motion",
                        "choose another --from and --to, or give --start X,Y,YAW");
  }
  options.input.expect_finite(result.rows, result.spatial);
}

int run(const ReplayOptions& options) {
  if (options.stream) {
    return replay_stream({.capture = options.input.dataset(),
                          .section = options.input.selection().section(),
                          .output = *options.stream,
                          .json = options.input.json()});
  }
  if (options.input.output().empty()) throw CLI::RequiredError("--output");
  io::expect_writable(options.input.output());
  prepare_report(options.report);
  Warnings warnings;
  FilterInput::Drive drive = options.input.read("replay", FilterInput::StartIs::kFoundOtherwise, warnings);
  filter::ReplayOptions& replay = drive.options;
  replay.config.model = *filter::model_from_name(options.model);
  filter::set_unknown_delays(replay.config);
  replay.now_ns = now_ns;
  std::vector<report::RangeRow> ranges;
  if (options.report) record_ranges(replay, ranges);
  // The diagnosis takes a third of the filter's time, and neither needs the other.
  auto diagnosed = std::async(std::launch::async, [&drive] { return FilterInput::diagnose(drive); });
  const auto begin = std::chrono::steady_clock::now();
  const filter::ReplayResult result = filter::replay(drive.run(), replay);
  const double wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  std::vector<diagnosis::Finding> findings = diagnosed.get();
  for (const diagnosis::Finding& finding : findings) warnings.add(finding);
  // A calibration that does not match is what is left if no mistake explains the ranges.
  if (findings.empty()) {
    if (const auto mismatch = FilterInput::warn_of_mismatch(result, warnings)) findings.push_back(*mismatch);
  }
  try {
    expect_poses(options, drive, result);
  } catch (const io::DataError&) {
    if (options.input.json() && !findings.empty()) say_json(empty_json(options, drive, result, findings));
    throw;
  }
  std::vector<io::RowWords> words;
  words.reserve(result.states.size());
  for (const auto& [state, reason] : result.states)
    words.push_back({filter::state_name(state), filter::reason_name(reason)});
  io::write_file(options.input.output(),
                 io::format_estimate(result.rows, result.spatial, drive.dataset.surface, words));
  if (options.report) write_report(options, drive, result, std::move(ranges));

  const filter::Counters& counters = result.counters;
  FilterInput::warn_of_ranges(counters, warnings);
  FilterInput::warn_of_samples(counters, warnings);
  if (counters.ranges[filter::RangeOutcome::kUsed] == 0 && replay.config.model != filter::Model::kOdometry)
    FilterInput::warn_without_ranges(result.ranges_seen, warnings);
  const ReplaySummary summary = summarize(result, replay.config.model);
  warn_of(summary, warnings);
  const double duration_s = result.rows.back().t_s - begin_s(drive);
  const double realtime_factor = wall_s > 0.0 ? duration_s / wall_s : 0.0;
  if (options.input.json()) {
    say_json(Json{{"model", options.model},
                  {"ranges_seen", result.ranges_seen},
                  {"ranges_used", counters.ranges[filter::RangeOutcome::kUsed]},
                  {"ranges_gated", counters.ranges[filter::RangeOutcome::kGated]},
                  {"ranges_unknown_anchor", counters.ranges[filter::RangeOutcome::kUnknownAnchor]},
                  {"ranges_not_active", counters.ranges[filter::RangeOutcome::kNotActive]},
                  {"anchor_exchanges", counters.anchor_exchanges},
                  {"relocations", result.relocations},
                  {"slips", counters.slips},
                  {"odometry_implausible", counters.odometry[filter::OdometryOutcome::kImplausible]},
                  {"state", words.back().state},
                  {"state_shares", summary.state_shares},
                  {"diagnosis", diagnosis::to_json(findings)},
                  {"sensors", sensors_json(counters)},
                  {"dropped", cli::to_json(drive.dataset.dropped)},
                  {"wall_s", wall_s},
                  {"realtime_factor", realtime_factor},
                  {"propagate_ns", {{"p50", result.propagate_ns.p50}, {"p99", result.propagate_ns.p99}}},
                  {"update_ns", {{"p50", result.update_ns.p50}, {"p99", result.update_ns.p99}}}});
  } else {
    say(fmt::format("{}: {} poses over {:.1f} s, at {:.0f} times real time, written to {}\n", options.model,
                    result.rows.size(), duration_s, realtime_factor, options.input.output().string()));
    say(states_text(summary));
    say(ranges_text(summary));
  }
  return warnings.exit_code();
}

}  // namespace

void add_replay(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ReplayOptions>();
  CLI::App* command =
      app.add_subcommand("replay",
                         "Run the filter over a recorded drive, causally. Of the poses it uses only the "
                         "first, from which it starts (sigma 0.1 m, 0.05 rad). Without "
                         "a pose, it finds the start from ranges and motion.");
  options->input.add_options(*command);
  options->input.add_relocation(*command);
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
  options->input.add_output(*command);
  command->get_option("--output")->required(false);
  add_report_option(*command, options->report);
  CLI::Option* stream =
      command
          ->add_option(
              "--stream", options->stream,
              "Instead of a table: write the POSE lines that went out, from a capture of gromad that "
              "this build recorded, and say whether they are the same. Takes calibration and start "
              "from the capture; all sections, unless --section chooses one")
          ->type_name("FILE");
  for (const char* other : {"--calibration", "--surveyed", "--from", "--to", "--tags", "--anchors", "--start",
                            "--relocate", "--model", "--output", "--report"})
    stream->excludes(command->get_option(other));
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
