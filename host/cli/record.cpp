// groma record: saves the last part of gromad's ring.
#include <fmt/format.h>

#include <array>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <memory>
#include <string>
#include <string_view>
#include <utility>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/terminal.hpp"
#include "host/daemon/config.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/log_ring.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct RecordOptions {
  double last_s = 0.0;
  std::filesystem::path config = "/etc/groma/gromad.yaml";
  std::filesystem::path output;
};

double parse_duration(const std::string& text) {
  constexpr std::array<std::pair<std::string_view, double>, 4> kUnits{
      {{"s", 1.0}, {"m", 60.0}, {"h", 3600.0}, {"d", 86400.0}}};
  double value = 0.0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  const std::string_view rest(end, static_cast<std::size_t>(text.data() + text.size() - end));
  if (error == std::errc() && std::isfinite(value) && value > 0.0) {
    for (const auto& [unit, unit_s] : kUnits) {
      if (rest == unit) return value * unit_s;
    }
  }
  throw CLI::ValidationError("--last", fmt::format("'{}' is not a duration such as 90s, 10m or 2h", text));
}

int run(const RecordOptions& options) {
  io::expect_writable(options.output);
  const daemon::Config config = daemon::read_config(options.config);
  if (!config.ring) {
    throw io::ConfigError({options.config}, "has no ring",
                          "add the key ring with a folder, and restart gromad");
  }
  const std::string log = io::last_of_ring(config.ring->folder, options.last_s);
  if (log.empty()) {
    throw io::DataError({config.ring->folder}, "holds no recording",
                        "start gromad, and look in its log whether it records");
  }
  io::write_file(options.output, log);
  say(fmt::format("{:.1f} MiB of {}, written to {}\n", static_cast<double>(log.size()) / (1U << 20U),
                  config.ring->folder.string(), options.output.string()));
  return io::kGood;
}

}  // namespace

void add_record(CLI::App& app, Action& action) {
  const auto options = std::make_shared<RecordOptions>();
  CLI::App* command = app.add_subcommand(
      "record",
      "Save the last part of the recording that gromad keeps in its ring, as a log. Gromad may run on.");
  command
      ->add_option_function<std::string>(
          "--last", [options](const std::string& text) { options->last_s = parse_duration(text); },
          "At least this much of recorded time, or all that there is: 90s, 10m, 2h, 1d")
      ->required()
      ->type_name("DURATION");
  command
      ->add_option("--config", options->config,
                   "Configuration file of gromad. Default: " + options->config.string())
      ->type_name("FILE");
  command->add_option("-o,--output", options->output, "Log to write")->required()->type_name("FILE");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
