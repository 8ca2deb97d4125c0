// groma smooth: smooths a recorded drive, using all of its samples for each pose.
#include <fmt/format.h>

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/clock_fix.hpp"
#include "host/cli/command.hpp"
#include "host/cli/filter_input.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/filter/config.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/smoother/smoother.hpp"

namespace groma::cli {

namespace {

struct SmoothOptions {
  FilterInput input;
  std::string model{filter::model_name(filter::Model::kSchmidt)};
  ReportFolder report;
  bool fix = false;
};

void write_report(const SmoothOptions& options, const FilterInput::Drive& drive,
                  const smoother::Result& result) {
  report::Page page(fmt::format("Smoothed poses of {}", drive.dataset.name),
                    fmt::format("The model {} on a {} drive; each pose also uses later samples.",
                                options.model, drive.dataset.origin));
  const std::vector<model::PoseSample> truth = truth_of(options.input.dataset());
  report::add_drive(page, {.rows = result.rows,
                           .truth = truth,
                           .calibration = &drive.calibration,
                           .ranges = residuals(drive.run(), result),
                           .has_residuals = true});
  write_page(*options.report, std::move(page), versions_of(drive.dataset, drive.calibration));
}

// Throws DataError if there are no poses, or some are not finite.
void expect_poses(const SmoothOptions& options, const smoother::Result& result) {
  if (result.rows.empty()) {
    throw io::DataError({io::odometry_file(options.input.dataset())},
                        "there are fewer than two odometry samples in the chosen time",
                        "choose another --from and --to");
  }
  options.input.expect_finite(result.rows);
}

// The JSON object where the data gave no poses, and the diagnosis says why.
Json empty_json(const FilterInput::Drive& drive, const smoother::Result& result,
                const std::vector<diagnosis::Finding>& findings) {
  Json json{{"ranges_seen", result.ranges.size()}, {"diagnosis", diagnosis::to_json(findings)}};
  for (const char* key : {"ranges_in_sight", "rounds", "converged", "scale_error", "yaw_rate_bias_radps",
                          "range_delay_s", "odometry_delay_s"})
    json[key] = nullptr;
  json["dropped"] = cli::to_json(drive.dataset.dropped);
  return json;
}

int run(const SmoothOptions& options) {
  io::expect_writable(options.input.output());
  prepare_report(options.report);
  Warnings warnings;
  FilterInput::Drive drive = options.input.read("smooth", FilterInput::StartIs::kNeeded, warnings);
  drive.options.config.model = *filter::model_from_name(options.model);
  filter::set_unknown_delays(drive.options.config);
  const std::vector<diagnosis::Finding> findings = FilterInput::diagnose(drive);
  for (const diagnosis::Finding& finding : findings) warnings.add(finding);
  if (options.fix) fix_clock(findings, drive.dataset.ranges, warnings);
  const smoother::Result result = smoother::smooth(drive.run(), drive.options);
  try {
    expect_poses(options, result);
  } catch (const io::DataError&) {
    if (options.input.json() && !findings.empty()) say_json(empty_json(drive, result, findings));
    throw;
  }
  if (!result.converged) {
    warnings.add(fmt::format("{}: not converged after {} iterations; is the start right?",
                             options.input.dataset().string(), result.rounds));
  }
  io::write_file(options.input.output(), io::format_estimate(result.rows));
  if (options.report) write_report(options, drive, result);
  FilterInput::warn_of_samples(result.counters, warnings);
  // The sum of the LOS probabilities is below one.
  if (result.ranges_los < 1.0) FilterInput::warn_without_ranges(result.ranges.size(), warnings);
  if (options.input.json()) {
    say_json(Json{{"ranges_seen", result.ranges.size()},
                  {"diagnosis", diagnosis::to_json(findings)},
                  {"ranges_in_sight", result.ranges_los},
                  {"rounds", result.rounds},
                  {"converged", result.converged},
                  {"scale_error", result.scale_error},
                  {"yaw_rate_bias_radps", result.yaw_rate_bias_radps},
                  {"range_delay_s", result.range_delay_s},
                  {"odometry_delay_s", result.odometry_delay_s},
                  {"odometry_implausible", result.counters.odometry[filter::OdometryOutcome::kImplausible]},
                  {"dropped", cli::to_json(drive.dataset.dropped)}});
  } else {
    say(fmt::format("{} poses after {} iterations, written to {}\n", result.rows.size(), result.rounds,
                    options.input.output().string()));
    say(fmt::format(
        "{} ranges, {:.0f} % of them LOS; odometry scale error {:.4f}, yaw-rate bias {:.5f} rad/s\n",
        result.ranges.size(),
        !result.ranges.empty() ? 100.0 * result.ranges_los / static_cast<double>(result.ranges.size()) : 0.0,
        result.scale_error, result.yaw_rate_bias_radps));
  }
  return warnings.exit_code();
}

}  // namespace

void add_smooth(CLI::App& app, Action& action) {
  const auto options = std::make_shared<SmoothOptions>();
  CLI::App* command = app.add_subcommand(
      "smooth",
      "Estimate the most likely poses of a recorded drive. Each pose also uses later samples, which no "
      "filter can; the result shows what the data allows.");
  options->input.add_options(*command);
  command
      ->add_option(
          "--model", options->model,
          fmt::format("How the calibration is used: schmidt (its errors are considered, not estimated), "
                      "joint (it is estimated too). Default: {}",
                      options->model))
      ->check(CLI::IsMember({std::string(filter::model_name(filter::Model::kSchmidt)),
                             std::string(filter::model_name(filter::Model::kJoint))}))
      ->type_name("NAME");
  add_clock_fix(*command, options->fix);
  options->input.add_output(*command);
  add_report_option(*command, options->report);
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
