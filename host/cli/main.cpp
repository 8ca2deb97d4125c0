// groma: calibrates, replays and evaluates UWB localization.
#include <fmt/format.h>

#include <csignal>
#include <optional>
#include <span>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/help/help.hpp"
#include "host/io/version.hpp"

namespace groma::cli {

namespace {

int run(int argc, char** argv) {
  CLI::App app(
      "UWB localization for ground robots: calibrates anchors from a drive, replays drives through the "
      "filter, "
      "and scores the result. 'groma help COMMAND' describes a command.",
      "groma");
  help::prepare(
      app, 1,
      "Exit codes: 0 good, 2 usage, 3 done with warnings, 65 bad data or a result that is not usable,\n"
      "69 device or service unavailable, 77 permission, 78 bad configuration.");
  app.set_version_flag("--version", fmt::format("groma {}", io::program_version()));
  app.require_subcommand(1);
  Action action;
  add_bugreport(app, action);
  add_calibrate(app, action);
  add_check(app, action);
  add_configure(app, action);
  add_convert(app, action);
  add_demo(app, action);
  add_diff(app, action);
  add_doctor(app, action);
  add_evaluate(app, action);
  add_explain(app, action);
  add_export(app, action);
  add_flash(app, action);
  help::add_help_command(app);
  add_identify(app, action);
  add_import(app, action);
  add_listen(app, action);
  add_log(app, action);
  add_monitor(app, action);
  add_nodes(app, action);
  add_plan(app, action);
  add_record(app, action);
  add_replay(app, action);
  add_reproduce(app, action);
  add_sim(app, action);
  add_smooth(app, action);
  add_surface(app, action);
  add_survey(app, action);
  add_guides(app);
  if (const std::optional<int> code = help::parse(app, argc, argv)) return *code;
  const Heartbeat heartbeat("groma " + app.get_subcommands().front()->get_name());
  return action();
}

}  // namespace

}  // namespace groma::cli

int main(int argc, char** argv) {
  // A full disk or a closed pipe then makes the write fail, so that the program can clean up and report it.
  std::signal(SIGXFSZ, SIG_IGN);
  std::signal(SIGPIPE, SIG_IGN);
  groma::cli::note_command_line({argv, static_cast<std::size_t>(argc)});
  return groma::help::guarded(
      [&] {
        const int code = groma::cli::run(argc, argv);
        groma::cli::flush_output();
        return code;
      },
      groma::cli::complain);
}
