// groma configure: writes a site plan's configurations into its nodes.
#include "host/provision/configure.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/air_plan.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

struct ConfigureOptions {
  std::filesystem::path plan;
  std::string nodes;
  std::string link;
  std::string via;
  bool reassign = false;
  bool json = false;
};

int run(const ConfigureOptions& options) {
  const provision::SitePlan plan = provision::read_site_plan(options.plan);
  std::vector<const provision::PlannedNode*> nodes = select_nodes(plan, options.nodes);
  std::vector<provision::PlannedNode> by_air;
  if (!options.via.empty()) {
    by_air.reserve(nodes.size());
    for (const provision::PlannedNode*& node : nodes) {
      if (!node->port.empty()) continue;
      by_air.push_back(*node);
      by_air.back().via_port = options.via;
      node = &by_air.back();
    }
  }
  provision::PlannedNode relinked;
  if (!options.link.empty()) {
    if (nodes.size() != 1) throw CLI::ValidationError("--link", "requires one --node");
    relinked = *nodes.front();
    relinked.port = options.link;
    nodes.front() = &relinked;
  }
  provision::ConfigureOptions configuring;
  configuring.reassign = options.reassign;
  configuring.progress = [](const char* step) { show_progress(step); };

  Warnings warnings;
  for (const std::string& text : provision::plan_air(plan.nodes.front().config, plan.baud).warnings) {
    warnings.add(fmt::format("{}: {}", plan.path.string(), text));
  }
  Table table({"node", "role", "port", "result", "firmware"});
  Json json{{"plan", plan.path.string()}, {"nodes", Json::array()}};
  int first_failure = io::kGood;
  const auto outcomes = provision::configure_nodes(nodes, plan.baud, configuring);
  const auto advised = std::find_if(outcomes.begin(), outcomes.end(),
                                    [](const auto& outcome) { return !outcome.advice.empty(); });
  if (advised != outcomes.end()) warnings.add(fmt::format("{}: {}", plan.path.string(), advised->advice));
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const provision::PlannedNode* node = nodes[i];
    const provision::NodeOutcome& outcome = outcomes[i];
    if (const int code = report_outcome(outcome, warnings); first_failure == io::kGood) first_failure = code;
    const bool over_air = provision::is_reached_by_air(*node);
    table.add({fmt::format("{}", node->id), link::role_word(node->role),
               over_air ? "via " + outcome.port : outcome.port, result_word(outcome),
               outcome.hello ? outcome.hello->version : "-"});
    Json entry{{"id", node->id}, {"role", link::role_word(node->role)}, {"over_air", over_air}};
    entry.update(cli::to_json(outcome));
    json["nodes"].push_back(std::move(entry));
  }
  if (options.json) {
    say_json(json);
  } else {
    say(table.format(true));
  }
  return first_failure != io::kGood ? first_failure : warnings.exit_code();
}

}  // namespace

void add_configure(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ConfigureOptions>();
  CLI::App* command = app.add_subcommand(
      "configure",
      "Write a site plan's configuration into each node, read it back and apply it. A node that already has "
      "it is skipped: after an interruption repeat the command.");
  command->add_option("--plan", options->plan, "The site plan, a YAML file")->required()->type_name("FILE");
  command->add_option("--node", options->nodes, "Only these nodes, such as 1,5")->type_name("IDS");
  command->add_option("--link", options->link, "Port instead of the plan's; with one --node")
      ->type_name("PORT");
  command
      ->add_option("--via", options->via,
                   "Port of a node that relays over the air to the nodes that have no port")
      ->type_name("PORT");
  command->add_flag("--reassign", options->reassign, "Also nodes that are configured under another id");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
