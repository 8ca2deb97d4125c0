// groma bugreport: what a report of a problem needs, in one file, without secrets.
#include <fmt/format.h>

#include <filesystem>
#include <memory>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/terminal.hpp"
#include "host/doctor/bug_report.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct BugReportOptions {
  doctor::ReportSource source{.config = "/etc/groma/gromad.yaml"};
  std::filesystem::path output;
};

int run(const BugReportOptions& options) {
  io::expect_writable(options.output);
  const std::vector<doctor::ReportFile> files = doctor::collect_report(options.source);
  io::write_file(options.output, doctor::tar_archive("groma-bugreport", files));
  for (const doctor::ReportFile& file : files) {
    say(fmt::format("{:<18}{:>9} bytes\n", file.name, file.content.size()));
  }
  say(fmt::format("{}: look at it before you send it: it has no keys, but positions of the site\n",
                  options.output.string()));
  return io::kGood;
}

}  // namespace

void add_bugreport(CLI::App& app, Action& action) {
  const auto options = std::make_shared<BugReportOptions>();
  CLI::App* command = app.add_subcommand("bugreport",
                                         "Write one tar archive with versions, configuration, calibration, "
                                         "what gromad reports, its last log lines "
                                         "and what groma doctor says. Keys and passwords are removed.");
  command->add_option("--config", options->source.config, "Configuration file of gromad")
      ->capture_default_str()
      ->type_name("FILE");
  command->add_option("--log", options->source.log, "File with gromad's log, instead of systemd's journal")
      ->type_name("FILE");
  command->add_option("-o,--output", options->output, "Archive to write")->required()->type_name("FILE");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
