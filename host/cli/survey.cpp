// groma survey: measures the ranges between anchors.
#include <fmt/format.h>

#include <cstdint>
#include <memory>
#include <string>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/exit_code.hpp"
#include "host/provision/configure.hpp"

namespace groma::cli {

namespace {

struct SurveyOptions {
  std::string link;
  std::string nodes;
  unsigned baud = 1'000'000;
  std::uint16_t exchanges = 50;
  bool json = false;
};

int run(const SurveyOptions& options) {
  Warnings warnings;
  Json pairs = Json::array();
  int first_failure = io::kGood;
  if (!options.json) say("anchor_id,other_id,range_m,sigma_m,count\n");
  for (const model::NodeId anchor : parse_ids("--node", options.nodes)) {
    const provision::SurveyOutcome surveyed =
        provision::survey_from(options.link, options.baud, anchor, options.exchanges);
    if (const int code = report_outcome(surveyed.outcome, warnings); first_failure == io::kGood)
      first_failure = code;
    for (const provision::SurveyedPair& pair : surveyed.pairs) {
      if (options.json) {
        pairs.push_back({{"anchor", pair.from},
                         {"other", pair.to},
                         {"range_m", pair.range_m},
                         {"sigma_m", pair.sigma_m},
                         {"count", pair.count}});
      } else {
        say(fmt::format("{},{},{:.4f},{:.4f},{}\n", pair.from, pair.to, pair.range_m, pair.sigma_m,
                        pair.count));
      }
    }
  }
  if (options.json) say_json({{"pairs", pairs}});
  return first_failure != io::kGood ? first_failure : warnings.exit_code();
}

}  // namespace

void add_survey(CLI::App& app, Action& action) {
  const auto options = std::make_shared<SurveyOptions>();
  CLI::App* command = app.add_subcommand(
      "survey",
      "Make anchors range to their neighbour anchors, in the slot of a tag, which pauses meanwhile. Prints "
      "CSV.");
  command->add_option("PORT", options->link, "The tag's port, such as /dev/ttyACM0 or can:can0/3")
      ->required()
      ->type_name("PORT");
  command->add_option("--node", options->nodes, "The anchors, such as 10,11; not the master")
      ->required()
      ->type_name("IDS");
  command->add_option("--exchanges", options->exchanges, "Exchanges per pair of anchors")
      ->check(CLI::Range(1, 200))
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--baud", options->baud, "Bits per second of a serial port")
      ->capture_default_str()
      ->type_name("N");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
