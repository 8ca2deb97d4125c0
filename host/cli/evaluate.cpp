// groma evaluate: scores an estimate against the truth.
#include <fmt/format.h>

#include <algorithm>
#include <cstddef>
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

// Below this share of either file a score says little of it.
constexpr double kLeastScored = 0.5;

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

std::string format_table(const evaluation::Evaluation& evaluation, const evaluation::Coverage& scored) {
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
  return text + fmt::format("\nscored: {:.1f} % of the estimate, {:.1f} % of the truth\n",
                            100.0 * scored.estimate, 100.0 * scored.truth);
}

// The first spans, and the number of all.
std::string frozen_text(const std::vector<evaluation::FrozenSpan>& spans) {
  constexpr std::size_t kFirst = 3;
  std::string list;
  for (std::size_t i = 0; i < std::min(spans.size(), kFirst); ++i) {
    list += fmt::format("{}from {:.3f} to {:.3f} s, then jumps by {:.3f} m", i > 0 ? ", " : "",
                        spans[i].from_s, spans[i].to_s, spans[i].jump_m);
  }
  if (spans.size() > kFirst) list += fmt::format(", and {} more times", spans.size() - kFirst);
  return list;
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
  if (const auto spans = evaluation::frozen_spans(truth); !spans.empty()) {
    warnings.add(fmt::format("{}: repeats one pose {}; errors there count, but they are errors of the truth",
                             options.truth, frozen_text(spans)));
  }
  const evaluation::Coverage scored = evaluation::coverage(estimate, truth, errors);
  if (scored.estimate < kLeastScored || scored.truth < kLeastScored) {
    warnings.add(
        fmt::format("only {:.1f} % of {} and {:.1f} % of {} were scored; check that both are of the same run "
                    "and the same "
                    "clock, unless one of them is a part",
                    100.0 * scored.estimate, options.estimate, 100.0 * scored.truth, options.truth));
  }
  if (options.report) write_report(options, estimate, truth);
  if (options.json) {
    Json json = cli::to_json(*result);
    json["scored"] = {{"estimate", scored.estimate}, {"truth", scored.truth}};
    say_json(json);
  } else {
    say(format_table(*result, scored));
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
  command->add_option("ESTIMATE", options->estimate, "Table that groma replay has written")
      ->required()
      ->type_name("FILE");
  command->add_option("TRUTH", options->truth, "Table t_s,x_m,y_m,z_m,yaw_rad, such as groundtruth.csv")
      ->required()
      ->type_name("FILE");
  add_report_option(*command, options->report);
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
