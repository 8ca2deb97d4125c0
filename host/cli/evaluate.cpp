// groma evaluate: scores an estimate against the truth.
#include <fmt/format.h>

#include <memory>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/evaluation/evaluation.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"

namespace groma::cli {

namespace {

struct EvaluateOptions {
  std::string estimate;
  std::string truth;
  ReportFolder report;
  bool json = false;
};

std::vector<report::StateSpan> read_spans(const std::string& path) {
  std::vector<report::StateSpan> spans;
  for (io::StateRow& row : io::read_states(path)) {
    if (!spans.empty()) spans.back().to_s = row.t_s;
    if (spans.empty() || spans.back().state != row.state || spans.back().reason != row.reason)
      spans.push_back({row.t_s, row.t_s, std::move(row.state), std::move(row.reason)});
  }
  return spans;
}

void write_report(const EvaluateOptions& options, std::span<const model::PlanarEstimate> estimate,
                  std::span<const model::PoseSample> truth) {
  report::Page page(fmt::format("Evaluation of {}", options.estimate),
                    fmt::format("Against {}, at its times, without alignment.", options.truth));
  report::add_drive(page, {.rows = estimate, .truth = truth, .states = read_spans(options.estimate)});
  write_page(*options.report, std::move(page), {});
}

std::string format_table(const evaluation::Evaluation& evaluation) {
  Table table({"", "mean", "rmse", "std", "max"});
  const auto row = [&](const std::string& name, const evaluation::Statistics& s) {
    table.add({name, fmt::format("{:.4f}", s.mean), fmt::format("{:.4f}", s.rmse),
               fmt::format("{:.4f}", s.std), fmt::format("{:.4f}", s.max)});
  };
  row("position error (m)", evaluation.ate_m);
  row("heading error (rad)", evaluation.ate_rad);
  if (evaluation.nees) {
    table.add({"NEES / 3", fmt::format("{:.3f}", evaluation.nees->mean), "",
               fmt::format("{:.3f}", evaluation.nees->std), fmt::format("{:.3f}", evaluation.nees->max)});
  }
  std::string text = table.format();
  text += fmt::format("{} samples", evaluation.samples);
  if (evaluation.nees)
    text += fmt::format(", {:.1f} % inside the 95 % ellipsoid", 100.0 * evaluation.nees->inside_95);
  return text + '\n';
}

int run(const EvaluateOptions& options) {
  prepare_report(options.report);
  Warnings warnings;
  const std::vector<model::PlanarEstimate> estimate = io::read_estimate(options.estimate);
  io::DroppedRows dropped;
  const std::vector<model::PoseSample> truth = io::read_poses(options.truth, dropped);
  warnings.add(dropped);
  const auto errors = evaluation::pose_errors(estimate, truth);
  const auto result = evaluation::evaluate(errors);
  if (!result) {
    throw io::DataError({options.estimate},
                        fmt::format("no time of {} lies within it, or only in gaps over {} s", options.truth,
                                    evaluation::kMaxGap_s),
                        "give the truth of the same run");
  }
  if (result->samples_without_covariance > 0) {
    warnings.add(
        fmt::format("{}: {} samples have a covariance that is not positive definite; NEES leaves them out",
                    options.estimate, result->samples_without_covariance));
  }
  for (const evaluation::FrozenSpan& span : evaluation::frozen_spans(truth)) {
    warnings.add(fmt::format(
        "{}: repeats one pose from {:.3f} to {:.3f} s, then jumps by {:.3f} m; errors there count, but "
        "they are errors of the truth",
        options.truth, span.from_s, span.to_s, span.jump_m));
  }
  if (options.report) write_report(options, estimate, truth);
  if (options.json) {
    say_json(cli::to_json(*result));
  } else {
    say(format_table(*result));
  }
  return warnings.exit_code();
}

}  // namespace

void add_evaluate(CLI::App& app, Action& action) {
  const auto options = std::make_shared<EvaluateOptions>();
  CLI::App* command = app.add_subcommand("evaluate",
                                         "Score an estimate against the truth: position and heading errors "
                                         "(ATE) and consistency (NEES divided by 3), at "
                                         "the truth's times, without alignment.");
  command->add_option("ESTIMATE", options->estimate, "Table that groma replay has written")->required();
  command->add_option("TRUTH", options->truth, "Table t_s,x_m,y_m,z_m,yaw_rad, such as groundtruth.csv")
      ->required();
  add_report_option(*command, options->report);
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
