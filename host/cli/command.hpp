// The subcommands. Each add_...() declares the options of one subcommand and sets the action to run if it is
// chosen. Each is in a file of its own; main() turns exceptions into exit codes.
#pragma once

#include <functional>

#include <CLI/App.hpp>

namespace groma::cli {

// Returns the exit code.
using Action = std::function<int()>;

void add_bugreport(CLI::App& app, Action& action);
void add_calibrate(CLI::App& app, Action& action);
void add_check(CLI::App& app, Action& action);
void add_configure(CLI::App& app, Action& action);
void add_convert(CLI::App& app, Action& action);
void add_demo(CLI::App& app, Action& action);
void add_diff(CLI::App& app, Action& action);
void add_doctor(CLI::App& app, Action& action);
void add_evaluate(CLI::App& app, Action& action);
void add_explain(CLI::App& app, Action& action);
void add_export(CLI::App& app, Action& action);
void add_flash(CLI::App& app, Action& action);
void add_identify(CLI::App& app, Action& action);
void add_import(CLI::App& app, Action& action);
void add_listen(CLI::App& app, Action& action);
void add_log(CLI::App& app, Action& action);
void add_monitor(CLI::App& app, Action& action);
void add_nodes(CLI::App& app, Action& action);
void add_plan(CLI::App& app, Action& action);
void add_record(CLI::App& app, Action& action);
void add_replay(CLI::App& app, Action& action);
void add_reproduce(CLI::App& app, Action& action);
void add_sim(CLI::App& app, Action& action);
void add_smooth(CLI::App& app, Action& action);
void add_surface(CLI::App& app, Action& action);
void add_survey(CLI::App& app, Action& action);

// Adds examples, and the pages that explain it, to the help of each command. Call it after the others.
void add_guides(CLI::App& app);

}  // namespace groma::cli
