// groma sim: a simulated site for other programs to connect to.
#include <fmt/format.h>

#include <csignal>
#include <cstdint>
#include <filesystem>
#include <memory>

#include <CLI/CLI.hpp>

#include "firmware/sim/world/scenario_file.hpp"
#include "host/cli/command.hpp"
#include "host/cli/emulation_option.hpp"
#include "host/cli/live_site.hpp"
#include "host/cli/stop_signal.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/exit_code.hpp"
#include "host/simulation/site_server.hpp"

namespace groma::cli {

namespace {

struct SimOptions {
  std::filesystem::path scenario;
  bool live = false;
  std::uint16_t port = kLivePort;
  simulation::SiteServer::Options server;
  EmulationChoice emulation;
};

int run(SimOptions options) {
  const sim::Scenario scenario = sim::read_scenario(options.scenario);
  options.server.site.image = chosen_image(options.emulation);
  if (options.live) return run_live(scenario, options.server, options.port);
  // Before any file is created that an early end would leave behind.
  const volatile std::sig_atomic_t& stop = stop_on_signals();
  simulation::SiteServer server(scenario, options.server);
  for (const std::filesystem::path& port : server.ports()) say(port.string() + '\n');
  say(fmt::format("{}\nrunning {} at {} times real time; end it with Ctrl-C\n",
                  (options.server.folder / "robot.sock").string(), scenario.name, options.server.speed));
  flush_output();
  stop_heartbeat();
  server.run(stop);
  return report_behind(server);
}

}  // namespace

void add_sim(CLI::App& app, Action& action) {
  const auto options = std::make_shared<SimOptions>();
  CLI::App* command =
      app.add_subcommand("sim",
                         "Keep a simulated site running: for each tag a pseudo-terminal that behaves like a "
                         "flashed tag's serial port, "
                         "and a socket that sends the robot's odometry and pose priors as JSON lines.");
  command->add_option("--scenario", options->scenario, "Site, nodes, robot and radio as YAML")
      ->required()
      ->type_name("FILE");
  command->add_option("--seed", options->server.site.seed, "Determines all randomness of the simulation")
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--speed", options->server.speed, "Speed as a multiple of real time")
      ->check(CLI::Range(0.01, 100.0))
      ->capture_default_str()
      ->type_name("X");
  add_emulation_options(*command, options->emulation);
  CLI::Option* const unconfigured = command->add_flag(
      "--unconfigured", options->server.site.unconfigured,
      "Unconfigured nodes, for 'groma configure'; then anchors have ports, too: anchor-10 and so on");
  CLI::Option* const live =
      command
          ->add_flag("--live", options->live,
                     "Also run gromad on the site, and print the address of its live page")
          ->excludes(unconfigured);
  command->add_option("--port", options->port, "TCP port of the live page")
      ->needs(live)
      ->check(CLI::Range(1, 65535))
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--ports", options->server.folder, "Folder for tag-1 and so on, and robot.sock")
      ->required()
      ->type_name("DIR");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
