// groma nodes: role, firmware and counters of each node of a site, also of nodes reached over the air.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <sstream>
#include <string>
#include <system_error>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

struct NodeTableOptions {
  std::string link;
  std::filesystem::path plan;
  std::string nodes;
  std::string leave;
  std::string prefer;
  unsigned baud = 1'000'000;
  bool json = false;
};

// Optional orders for the nodes: leave the network, or anchor hints.
struct Orders {
  bool leave = false;
  std::optional<std::vector<provision::AnchorHint>> hints;

  [[nodiscard]] const char* word() const { return leave ? "leave" : "prefer"; }
  [[nodiscard]] bool any() const { return leave || hints; }
};

// "10=200,11=0", or "none".
std::vector<provision::AnchorHint> parse_hints(const std::string& text) {
  std::vector<provision::AnchorHint> hints;
  if (text == "none") return hints;
  std::istringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) {
    const std::size_t at = part.find('=');
    std::uint8_t weight = 0;
    const char* end = part.data() + part.size();
    const auto parsed = at == std::string::npos ? std::from_chars_result{}
                                                : std::from_chars(part.data() + at + 1, end, weight);
    if (parsed.ptr != end || parsed.ec != std::errc{}) {
      throw CLI::ValidationError("--prefer",
                                 fmt::format("'{}' is not ANCHOR=WEIGHT with a weight of 0 to 255", part));
    }
    hints.push_back({parse_ids("--prefer", part.substr(0, at)).front(), weight});
  }
  if (hints.empty() || hints.size() > provision::kMaxAnchorHints) {
    throw CLI::ValidationError("--prefer",
                               fmt::format("names 1 to {} anchors, or none", provision::kMaxAnchorHints));
  }
  return hints;
}

Orders orders_of(NodeTableOptions& options) {
  Orders orders;
  if (!options.leave.empty()) {
    if (!options.prefer.empty() || !options.nodes.empty()) {
      throw CLI::ValidationError("--leave", "cannot be combined with --prefer or --node");
    }
    if (parse_ids("--leave", options.leave).size() != 1)
      throw CLI::ValidationError("--leave", "give exactly one id");
    orders.leave = true;
    options.nodes = options.leave;
  }
  if (!options.prefer.empty()) {
    if (options.nodes.empty()) throw CLI::ValidationError("--prefer", "name the tags with --node");
    orders.hints = parse_hints(options.prefer);
  }
  return orders;
}

struct Place {
  model::NodeId id = 0;  // 0: the node at the port
  std::string port;
  bool over_air = false;
};

std::vector<Place> places_of(NodeTableOptions& options, const Orders& orders) {
  std::vector<Place> places;
  if (options.plan.empty()) {
    if (!orders.any()) places.push_back({0, options.link, false});
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

// Without orders it does nothing and succeeds.
provision::NodeOutcome carry_out(const Orders& orders, const std::string& port, unsigned baud,
                                 model::NodeId target) {
  if (orders.leave) return provision::let_leave(port, baud, target);
  if (orders.hints) return provision::hint_anchors(port, baud, *orders.hints, target);
  return {};
}

Json counters_json(const groma_Counters& counters) {
  return {{"frames_sent", counters.frames_sent},
          {"frames_received", counters.frames_received},
          {"beacons_received", counters.beacons_received},
          {"beacons_missed", counters.beacons_missed},
          {"crc_errors", counters.crc_errors},
          {"header_errors", counters.header_errors},
          {"late_transmits", counters.late_transmits},
          {"power_up_errors", counters.power_up_errors},
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
          {"radio_recoveries", counters.radio_recoveries},
          {"pll_flags", counters.pll_flags}};
}

// Names of groma_SlotKind.
constexpr std::array<const char*, 5> kSlotNames{"beacon", "shared", "poll", "response", "final"};

std::span<const groma_SlotSlack> slots_of(const groma_Slack& slack) {
  return std::span(slack.slots).first(std::min<std::size_t>(slack.slots_count, kSlotNames.size()));
}
const char* name_of(const groma_SlotSlack& slot) {
  const auto kind = static_cast<std::size_t>(link::number_in(slot.kind));
  return kind < kSlotNames.size() ? kSlotNames[kind] : "unknown";
}

Json slack_json(const groma_Slack& slack) {
  Json json = Json::object();
  for (const groma_SlotSlack& slot : slots_of(slack)) {
    const auto counts =
        std::span(slot.counts).first(std::min(std::size_t{slot.counts_count}, std::size(slot.counts)));
    json[name_of(slot)] = {{"least", slot.least_us}, {"counts", std::vector(counts.begin(), counts.end())}};
  }
  return json;
}

// The slot with the least slack; null if there is none.
const groma_SlotSlack* tightest(const groma_Slack& slack) {
  const auto slots = slots_of(slack);
  const auto least = std::min_element(slots.begin(), slots.end(),
                                      [](const auto& a, const auto& b) { return a.least_us < b.least_us; });
  return least == slots.end() ? nullptr : &*least;
}

// Empty if the radio was always armed in good time.
std::string slack_warning(std::uint32_t node, const groma_Slack& slack) {
  constexpr std::int32_t kLeast_us = 20;
  const groma_SlotSlack* slot = tightest(slack);
  if (slot == nullptr || slot->least_us >= kLeast_us) return {};
  return fmt::format(
      "node {}: its radio was armed only {} us before a {} slot; below {} us its frames or ranges may be "
      "lost: "
      "increase schedule.{}",
      node, slot->least_us, name_of(*slot), kLeast_us,
      link::number_in(slot->kind) == groma_SlotKind_SLOT_RESPONSE ? "response_gap_us and turn_round_us"
                                                                  : "turn_round_us");
}

std::string share_missed(const groma_Counters& counters) {
  const double all = static_cast<double>(counters.beacons_received) + counters.beacons_missed;
  return all > 0.0 ? fmt::format("{:.1f} %", 100.0 * counters.beacons_missed / all) : "-";
}

int run(NodeTableOptions options) {
  if (options.link.empty() == options.plan.empty()) {
    throw CLI::ValidationError("nodes", "name either a port or --plan");
  }
  const Orders orders = orders_of(options);
  Warnings warnings;
  Table table({"node", "role", "port", "firmware", "schedule", "boots", "frames", "beacons missed", "late",
               "slack us"});
  Json list = Json::array();
  int first_failure = io::kGood;
  for (const Place& place : places_of(options, orders)) {
    provision::NodeReport report;
    if (place.port.empty()) {
      report.outcome.fault = provision::NodeFault::kNotInPlan;
      report.outcome.message =
          fmt::format("node {}: the plan names no port for it; add 'port:' or 'via:' to the node", place.id);
    } else {
      const model::NodeId target = place.over_air ? place.id : model::NodeId{0};
      report.outcome = carry_out(orders, place.port, options.baud, target);
      if (report.outcome.fault == provision::NodeFault::kNone) {
        report = provision::ask_node(place.port, options.baud, target);
      }
    }
    if (const int code = report_outcome(report.outcome, warnings); first_failure == io::kGood)
      first_failure = code;
    Json entry{{"id", place.id}, {"over_air", place.over_air}};
    entry.update(cli::to_json(report.outcome));
    entry.erase("result");
    if (orders.any()) {
      const bool done = report.outcome.fault == provision::NodeFault::kNone;
      entry["told"] = done ? Json(orders.word()) : Json(nullptr);
    }
    entry["counters"] = report.counters ? counters_json(*report.counters) : Json(nullptr);
    entry["slack_us"] = report.slack ? slack_json(*report.slack) : Json(nullptr);
    const auto& hello = report.outcome.hello;
    if (hello) {
      entry["id"] = hello->id;
      entry["role"] = link::role_word(hello->role);
      entry["network_id"] = hello->network_id;
      entry["schedule_hash"] = fmt::format("{:08x}", hello->schedule_hash);
      entry["boot_count"] = hello->boot_count;
    }
    if (hello && report.counters) {
      const groma_Counters& counters = *report.counters;
      const groma_SlotSlack* slot = report.slack ? tightest(*report.slack) : nullptr;
      table.add({fmt::format("{}", hello->id), link::role_word(hello->role),
                 (place.over_air ? "via " : "") + place.port, hello->version,
                 fmt::format("{:08x}", hello->schedule_hash), fmt::format("{}", hello->boot_count),
                 fmt::format("{}", counters.frames_received), share_missed(counters),
                 fmt::format("{}", counters.late_transmits + counters.late_receives),
                 slot != nullptr ? fmt::format("{}", slot->least_us) : "-"});
      if (const std::string text = report.slack ? slack_warning(hello->id, *report.slack) : ""; !text.empty())
        warnings.add(text);
    }
    list.push_back(std::move(entry));
  }
  if (options.json) {
    say_json({{"nodes", list}});
  } else {
    say(table.format(true));
  }
  return first_failure != io::kGood ? first_failure : warnings.exit_code();
}

}  // namespace

void add_nodes(CLI::App& app, Action& action) {
  const auto options = std::make_shared<NodeTableOptions>();
  CLI::App* command = app.add_subcommand(
      "nodes", "Print role, firmware and counters of each node of a site, over its port or over the air.");
  command->add_option("PORT", options->link, "Port of one node, such as /dev/ttyACM0 or can:can0/3")
      ->type_name("PORT");
  command->add_option("--plan", options->plan, "The site plan, instead of a port")->type_name("FILE");
  command
      ->add_option("--node", options->nodes,
                   "Only these nodes of the plan, such as 1,5; with a port: also these, over the air")
      ->type_name("IDS");
  command
      ->add_option("--leave", options->leave,
                   "This tag releases its slot and stops polling until it is configured or restarted")
      ->type_name("ID");
  command
      ->add_option("--prefer", options->prefer,
                   "The tags of --node choose anchors by these weights, such as 10=200,11=0 (100 is neutral, "
                   "0: only if there is room, none: no weights), until they restart")
      ->type_name("HINTS");
  command->add_option("--baud", options->baud, "Bits per second of a serial port")
      ->capture_default_str()
      ->type_name("N");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
