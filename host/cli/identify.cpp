// groma identify: makes a node blink.
#include <fmt/format.h>

#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

constexpr std::uint32_t kMaxIdentify_s = 3'600;

struct IdentifyOptions {
  std::string link;
  std::filesystem::path plan;
  std::string node;
  unsigned baud = 1'000'000;
  std::uint32_t for_s = 10;
  bool json = false;
};

int run(IdentifyOptions options) {
  model::NodeId target = 0;
  if (options.plan.empty() && !options.node.empty()) {
    const std::vector<model::NodeId> ids = parse_ids("--node", options.node);
    if (ids.size() != 1) throw CLI::ValidationError("--node", "give exactly one id");
    target = ids.front();
  }
  if (options.link.empty() == options.plan.empty()) {
    throw CLI::ValidationError("identify", "name either the port or --plan and --node");
  }
  if (!options.plan.empty()) {
    const provision::SitePlan plan = provision::read_site_plan(options.plan);
    const auto nodes = select_nodes(plan, options.node);
    if (options.node.empty() || nodes.size() != 1)
      throw CLI::ValidationError("--node", "give exactly one node of the plan");
    const provision::PlannedNode& node = *nodes.front();
    const bool over_air = provision::is_reached_by_air(node);
    if (over_air) target = node.id;
    options.link = over_air ? node.via_port : node.can_link.empty() ? node.port : node.can_link;
    options.baud = plan.baud;
    if (options.link.empty()) {
      complain(fmt::format("{}: names no port for node {}; add 'port:' or 'via:' to it", plan.path.string(),
                           node.id));
      return io::kBadConfiguration;
    }
  }
  const provision::NodeOutcome outcome =
      provision::identify_node(options.link, options.baud, options.for_s, link::open_link, target);
  if (outcome.fault != provision::NodeFault::kNone) {
    complain(outcome.message);
    return cli::exit_code_of(outcome.fault);
  }
  const bool known = outcome.hello.has_value();
  const char* role = known ? link::role_word(outcome.hello->role) : "";
  if (options.json) {
    say_json({{"port", outcome.port},
              {"for_s", options.for_s},
              {"role", known ? Json(role) : Json(nullptr)},
              {"id", known ? Json(outcome.hello->id) : Json(nullptr)},
              {"network_id", known ? Json(outcome.hello->network_id) : Json(nullptr)}});
    return io::kGood;
  }
  const bool configured = known && outcome.hello->role != groma_Role_ROLE_UNCONFIGURED;
  const std::string who =
      configured ? fmt::format("{} {} of network {}", role, outcome.hello->id, outcome.hello->network_id)
                 : "an unconfigured node";
  say(fmt::format("{}: {} blinks for {} s{}\n", outcome.port, known ? who : "the node", options.for_s,
                  target == 0 ? "" : ", over the air"));
  return io::kGood;
}

}  // namespace

void add_identify(CLI::App& app, Action& action) {
  const auto options = std::make_shared<IdentifyOptions>();
  CLI::App* command = app.add_subcommand("identify", "Make a node blink, and print its role and id.");
  command->add_option("PORT", options->link, "Its port, such as /dev/ttyACM0 or can:can0/3")
      ->type_name("PORT");
  command->add_option("--plan", options->plan, "The site plan, instead of a port")->type_name("FILE");
  command
      ->add_option("--node", options->node,
                   "The node of the plan; with a port: the node to which the node there relays over the air")
      ->type_name("ID");
  command->add_option("--baud", options->baud, "Bits per second of a serial port")
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--for", options->for_s, "Duration in seconds; 0 ends it")
      ->check(CLI::Range(0U, kMaxIdentify_s))
      ->capture_default_str()
      ->type_name("S");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
