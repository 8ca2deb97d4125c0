// groma doctor: examines what gromad needs, and gromad where it runs.
#include "host/doctor/doctor.hpp"

#include <fmt/format.h>

#include <filesystem>
#include <memory>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"

namespace groma::cli {

namespace {

struct DoctorOptions {
  std::filesystem::path config = "/etc/groma/gromad.yaml";
  double for_s = 3.0;
  bool json = false;
};

int run(const DoctorOptions& options) {
  const doctor::Examination examination = doctor::examine(options.config, options.for_s);
  if (options.json) {
    say_json(doctor::to_json(examination.checks));
  } else {
    say(doctor::as_text(examination.checks));
  }
  return doctor::exit_code(examination.checks);
}

}  // namespace

void add_doctor(CLI::App& app, Action& action) {
  const auto options = std::make_shared<DoctorOptions>();
  CLI::App* command = app.add_subcommand(
      "doctor",
      "Examine each link, node, pair, clock and output of gromad: facts, a verdict and what to do. Reads the "
      "configuration, and listens to gromad where it runs; otherwise it opens the ports itself.");
  command->add_option("--config", options->config, "Configuration file of gromad")
      ->capture_default_str()
      ->type_name("FILE");
  command->add_option("--for", options->for_s, "How long to listen to gromad, in seconds")
      ->check(CLI::Range(1.0, 600.0))
      ->capture_default_str()
      ->type_name("S");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
