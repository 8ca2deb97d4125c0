// groma nodes: what each node of a site is and has counted, also of those without a cable.
#include <fmt/format.h>

#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/exit_code.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

struct Options {
  std::string link;
  std::filesystem::path plan;
  std::string nodes;
  unsigned baud = 1'000'000;
  bool json = false;
};

struct Place {
  model::NodeId id = 0;  // 0: whoever is at the port
  std::string port;
  bool over_air = false;
};

std::vector<Place> places_of(Options& options) {
  std::vector<Place> places;
  if (options.plan.empty()) {
    places.push_back({0, options.link, false});
    if (options.nodes.empty()) return places;
    for (const model::NodeId id : parse_ids("--node", options.nodes))
      places.push_back({id, options.link, true});
    return places;
  }
  const provision::SitePlan plan = provision::read_site_plan(options.plan);
  options.baud = plan.baud;
  for (const provision::PlannedNode* node : select_nodes(plan, options.nodes)) {
    if (provision::is_reached_by_air(*node)) {
      places.push_back({node->id, node->via_port, true});
    } else {
      places.push_back({node->id, node->port.empty() ? node->can_link : node->port, false});
    }
  }
  return places;
}

Json counters_json(const groma_Counters& counters) {
  return {{"frames_sent", counters.frames_sent},
          {"frames_received", counters.frames_received},
          {"beacons_received", counters.beacons_received},
          {"beacons_missed", counters.beacons_missed},
          {"crc_errors", counters.crc_errors},
          {"header_errors", counters.header_errors},
          {"late_transmits", counters.late_transmits},
          {"late_receives", counters.late_receives},
          {"foreign_frames", counters.foreign_frames},
          {"malformed_frames", counters.malformed_frames},
          {"stale_frames", counters.stale_frames},
          {"bad_stamps", counters.bad_stamps},
          {"ranges_completed", counters.ranges_completed},
          {"ranges_lost", counters.ranges_lost},
          {"reports_dropped", counters.reports_dropped},
          {"link_frames_bad", counters.link_frames_bad},
          {"link_bytes_lost", counters.link_bytes_lost},
          {"radio_recoveries", counters.radio_recoveries}};
}

std::string share_missed(const groma_Counters& counters) {
  const double all = static_cast<double>(counters.beacons_received) + counters.beacons_missed;
  return all > 0.0 ? fmt::format("{:.1f} %", 100.0 * counters.beacons_missed / all) : "-";
}

int run(Options options) {
  if (options.link.empty() == options.plan.empty()) {
    throw CLI::ValidationError("nodes", "name either a port or --plan");
  }
  Warnings warnings;
  Table table({"node", "role", "port", "firmware", "schedule", "boots", "frames", "beacons missed", "late"});
  Json list = Json::array();
  int first_failure = kGood;
  for (const Place& place : places_of(options)) {
    provision::NodeReport report;
    if (place.port.empty()) {
      report.outcome.fault = provision::NodeFault::kNotInPlan;
      report.outcome.message =
          fmt::format("node {}: the plan names no port for it; add 'port:' or 'via:' to the node", place.id);
    } else {
      report = provision::ask_node(place.port, options.baud, place.over_air ? place.id : model::NodeId{0});
    }
    if (const int code = tell(report.outcome, warnings); first_failure == kGood) first_failure = code;
    Json entry{{"id", place.id}, {"over_air", place.over_air}};
    entry.update(to_json(report.outcome));
    entry.erase("result");
    entry["counters"] = report.counters ? counters_json(*report.counters) : Json(nullptr);
    const auto& hello = report.outcome.hello;
    if (hello) {
      entry["id"] = hello->id;
      entry["role"] = provision::role_word(hello->role);
      entry["network_id"] = hello->network_id;
      entry["schedule_hash"] = fmt::format("{:08x}", hello->schedule_hash);
      entry["boot_count"] = hello->boot_count;
    }
    if (hello && report.counters) {
      const groma_Counters& counters = *report.counters;
      table.add({fmt::format("{}", hello->id), provision::role_word(hello->role),
                 (place.over_air ? "via " : "") + place.port, hello->version,
                 fmt::format("{:08x}", hello->schedule_hash), fmt::format("{}", hello->boot_count),
                 fmt::format("{}", counters.frames_received), share_missed(counters),
                 fmt::format("{}", counters.late_transmits + counters.late_receives)});
    }
    list.push_back(std::move(entry));
  }
  if (options.json) {
    say_json({{"nodes", list}});
  } else {
    say(table.format(true));
  }
  return first_failure != kGood ? first_failure : warnings.exit_code();
}

}  // namespace

void add_nodes(CLI::App& app, Action& action) {
  const auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand(
      "nodes", "Ask each node of a site what it is and has counted, over its port or over the air.");
  command->add_option("link", options->link, "Port of one node, such as /dev/ttyACM0 or can:can0/3");
  command->add_option("--plan", options->plan, "The site plan, in the place of a port");
  command->add_option("--node", options->nodes,
                      "These of the plan alone, such as 1,5; with a port: also these, over the air");
  command->add_option("--baud", options->baud, "Bits per second of a serial port")->capture_default_str();
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
