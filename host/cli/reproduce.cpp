// groma reproduce: the source paper's experiments, and ours beside them.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cstddef>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/reproduce/report.hpp"
#include "host/reproduce/runner.hpp"
#include "host/reproduce/summary.hpp"

namespace groma::cli {

namespace {

constexpr std::size_t kSeeds = 20;
constexpr std::size_t kQuickSeeds = 3;

struct ReproduceOptions {
  std::vector<std::string> experiments;
  ReportFolder report;
  std::optional<std::size_t> seeds;
  bool is_quick = false;
  bool json = false;
  std::optional<std::filesystem::path> recorded;
};

std::vector<std::string> wanted(const ReproduceOptions& options) {
  std::vector<std::string> out = options.experiments.empty() ? reproduce::experiments() : options.experiments;
  // The effort is measured in the runs of Table II.
  const auto has = [&](const char* name) { return std::find(out.begin(), out.end(), name) != out.end(); };
  if (has("effort") && !has("table2")) out.emplace_back("table2");
  return out;
}

std::string text_of(const reproduce::Json& summary) {
  std::string text;
  for (const auto& [experiment, rows] : summary.items()) {
    Table table({experiment, "metric", "paper", "its filter here", "ours"});
    for (const auto& [row, figures] : rows.items()) {
      const reproduce::Json& of = figures;
      for (const auto& [name, any] : of.at(of.contains("ours") ? "ours" : "published").items()) {
        const auto number = [](const reproduce::Json& value) {
          return value.is_number() ? fmt::format("{:.3f}", value.get<double>()) : std::string("-");
        };
        const auto median = [&, &metric = name](const char* who) {
          const bool has = of.contains(who) && of.at(who).contains(metric);
          return has ? number(of.at(who).at(metric).at("median")) : "-";
        };
        table.add({row, name, number(any.at("paper")), median("published"), median("ours")});
      }
    }
    text += table.format() + '\n';
  }
  return text;
}

int run(const ReproduceOptions& options) {
  if (options.recorded && !std::filesystem::is_directory(*options.recorded)) {
    throw io::PathError({*options.recorded}, "is no folder", "give the folder that holds the recorded runs");
  }
  prepare_report(options.report);
  const reproduce::Plan plan{
      .wanted = wanted(options),
      .seeds = options.seeds.value_or(options.is_quick ? kQuickSeeds : kSeeds),
      .has_firmware = !options.is_quick,
      .folder = *options.report,
      .recorded = options.recorded,
      .progress = [](std::string_view phase, double done) { show_progress(phase, done); }};
  const reproduce::Outcome outcome = reproduce::run(plan);
  write_page(*options.report, reproduce::page_of(outcome, plan), {});
  const reproduce::Json summary = reproduce::summary_of(outcome);
  if (options.json) {
    say_json(summary);
  } else {
    say(text_of(summary));
    say(fmt::format("report: {}\n", (*options.report / "report.html").string()));
  }
  return io::kGood;
}

}  // namespace

void add_reproduce(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ReproduceOptions>();
  CLI::App* command =
      app.add_subcommand("reproduce",
                         "Run the source paper's experiments on simulated sites, and ours beside them: "
                         "calibration (table1), the indoor and the outdoor trial (indoor, table2), anchor "
                         "positions as states, computational effort, the "
                         "forklift (table3), and what the paper leaves open: sensitivity, baselines, "
                         "recorded runs. A run that was interrupted goes on where it ended.");
  command
      ->add_option("EXPERIMENTS", options->experiments,
                   fmt::format("Of {}. Default: all", fmt::join(reproduce::experiments(), ", ")))
      ->check(CLI::IsMember(reproduce::experiments()));
  add_report_option(*command, options->report);
  command->get_option("--report")->required();
  command
      ->add_option("--seeds", options->seeds,
                   fmt::format("Seeds from 1 on. Default: {}, or {} with --quick", kSeeds, kQuickSeeds))
      ->check(CLI::Range(1, 1000))
      ->type_name("N");
  command->add_flag("--quick", options->is_quick, "Few seeds, for a first look");
  command
      ->add_option("--recorded", options->recorded,
                   "Folder with recorded runs (lias_fast, plaza1, mcd_ntu_day_09, ...), for recorded")
      ->type_name("DIR");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
