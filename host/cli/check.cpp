// groma check: looks for mistakes in a data set, and estimates nothing from it.
#include <fmt/format.h>

#include <filesystem>
#include <memory>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/diagnosis/diagnose.hpp"
#include "host/io/dataset.hpp"

namespace groma::cli {

namespace {

struct CheckOptions {
  std::filesystem::path dataset;
  Selection selection;
  bool json = false;
};

int run(const CheckOptions& options) {
  io::ReadOptions read;
  read.needs_pose_prior = false;
  read.ground_truth = false;
  read.odometry = !std::filesystem::is_directory(options.dataset) ||
                  std::filesystem::exists(io::odometry_file(options.dataset));
  read.log_section = options.selection.section();
  io::Dataset dataset = io::read_dataset(options.dataset, read);
  Warnings warnings;
  warnings.add(dataset);
  options.selection.apply(dataset);
  const std::vector<diagnosis::Finding> findings = diagnosis::diagnose(diagnosis::data_of(dataset));
  for (const diagnosis::Finding& finding : findings) warnings.add(finding);
  if (options.json) {
    say_json(Json{{"diagnosis", diagnosis::to_json(findings)}, {"dropped", cli::to_json(dataset.dropped)}});
  } else if (findings.empty()) {
    say(fmt::format("{}: no mistake found\n", options.dataset.string()));
  }
  return warnings.exit_code();
}

}  // namespace

void add_check(CLI::App& app, Action& action) {
  const auto options = std::make_shared<CheckOptions>();
  CLI::App* command =
      app.add_subcommand("check",
                         "Look for mistakes in the data of a drive: clocks, units, headings, signs, scales, "
                         "tags. Compares poses, "
                         "ranges and odometry with each other, and names the most likely cause first.");
  command
      ->add_option(
          "DATASET_OR_LOG", options->dataset,
          "Folder of the drive (dataset.yaml, ranges.csv, tags.csv, ...), or the log that gromad recorded")
      ->required();
  options->selection.add_options(*command);
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
