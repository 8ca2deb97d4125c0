// groma plan: predicts the figures of a schedule before it is written into a node.
#include <fmt/format.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include <CLI/CLI.hpp>

#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/provision/air_plan.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

struct PlanOptions {
  std::filesystem::path plan;
  unsigned tags = 3;
  unsigned anchors = 12;
  unsigned backups = provision::kDefaultBackups;
  std::string method = "next-poll";
  std::optional<std::string> link;
  provision::SiteSettings site;
  double loss = 0.0;
  bool authenticated = false;
  bool json = false;
};

// The configuration of a site that is given by numbers only, without a plan file.
groma_Config config_from_numbers(const PlanOptions& options) {
  provision::SiteSettings site = options.site;
  for (unsigned i = 0; i < options.tags; ++i) site.tag_ids.push_back(static_cast<model::NodeId>(1 + i));
  for (unsigned i = 0; i < options.anchors; ++i)
    site.anchor_ids.push_back(static_cast<model::NodeId>(100 + i));
  site.master_id = site.anchor_ids.front();
  site.backup_ids = provision::first_backups(site, options.backups);
  site.method = options.method == "final" ? groma_RangingMethod_METHOD_DS_FINAL
                                          : groma_RangingMethod_METHOD_DS_NEXT_POLL;
  site.link = options.link == "can"      ? groma_Link_LINK_CAN
              : options.link == "can-fd" ? groma_Link_LINK_CAN_FD
                                         : groma_Link_LINK_UART;
  if (options.authenticated) site.network_key.emplace();
  const groma_Config config = provision::config_of(site, groma_Role_ROLE_TAG, site.tag_ids.front());
  if (const char* fault = node::fault_of(config); *fault != '\0') throw CLI::ValidationError("plan", fault);
  return config;
}

std::string_view link_name(groma_Link link) {
  if (link == groma_Link_LINK_CAN) return "CAN";
  return link == groma_Link_LINK_CAN_FD ? "CAN FD" : "UART";
}

std::string ms(double t_s) {
  return fmt::format("{:.3f} ms", 1e3 * t_s);
}
std::string percent(double share) {
  return fmt::format("{:.1f} %", 100.0 * share);
}

std::string as_text(const provision::AirPlan& plan, double loss, double success) {
  Table air({"", ""});
  air.add(
      {"superframe", fmt::format("{} ({:.1f} a second)", ms(plan.superframe_s), 1.0 / plan.superframe_s)});
  air.add({"  beacon", ms(plan.beacon_s)});
  air.add({"  shared slot",
           fmt::format("{}, open {:.1f} times a second", ms(plan.shared_s), plan.open_slots_per_s)});
  air.add({fmt::format("  {} slots of", plan.slots),
           fmt::format("{}, {} anchors in each", ms(plan.slot_s), plan.responses)});
  air.add({"on the air", percent(plan.air_use)});
  air.add({"a tag transmits", percent(plan.tag_duty)});
  air.add({"an anchor", percent(plan.anchor_duty)});
  air.add({"the master", percent(plan.master_duty)});
  air.add({"ranges", fmt::format("{:.0f} a second, {:.0f} of each of {} tag{}", plan.ranges_per_s,
                                 plan.tag_ranges_per_s, plan.tags, plan.tags == 1 ? "" : "s")});
  if (loss > 0.0) {
    air.add({fmt::format("  at {} loss", percent(loss)),
             fmt::format("{:.0f} a second", plan.ranges_per_s * success)});
  }
  air.add({"  the frames' bound", fmt::format("{:.0f} a second", plan.bound_ranges_per_s)});
  Table links({"link", "of", "report bytes", "busy", "ranges/s at most"});
  for (const provision::LinkLoad& link : plan.links) {
    links.add({link.name, link.name == "UART" ? "each tag" : "all tags",
               fmt::format("{:.0f}", link.report_bytes), percent(link.busy),
               fmt::format("{:.0f}", link.most_ranges_per_s)});
  }
  return air.format(true) + "\n" + links.format();
}

Json as_json(const provision::AirPlan& plan, double loss, double success) {
  Json links = Json::array();
  for (const provision::LinkLoad& link : plan.links) {
    links.push_back({{"link", link.name},
                     {"report_bytes", link.report_bytes},
                     {"busy", link.busy},
                     {"most_ranges_per_s", link.most_ranges_per_s}});
  }
  return {{"superframe_s", plan.superframe_s},
          {"beacon_s", plan.beacon_s},
          {"shared_s", plan.shared_s},
          {"slot_s", plan.slot_s},
          {"slots", plan.slots},
          {"tags", plan.tags},
          {"responses", plan.responses},
          {"ranges_per_s", plan.ranges_per_s},
          {"tag_ranges_per_s", plan.tag_ranges_per_s},
          {"bound_ranges_per_s", plan.bound_ranges_per_s},
          {"loss", loss},
          {"ranges_per_s_at_loss", plan.ranges_per_s * success},
          {"air_use", plan.air_use},
          {"tag_duty", plan.tag_duty},
          {"anchor_duty", plan.anchor_duty},
          {"master_duty", plan.master_duty},
          {"open_slots_per_s", plan.open_slots_per_s},
          {"links", std::move(links)},
          {"warnings", plan.warnings}};
}

int run(const PlanOptions& options) {
  unsigned baud = 1'000'000;
  groma_Config config = groma_Config_init_zero;
  if (options.plan.empty()) {
    config = config_from_numbers(options);
  } else {
    const provision::SitePlan site = provision::read_site_plan(options.plan);
    const auto tag = std::find_if(site.nodes.begin(), site.nodes.end(),
                                  [](const auto& node) { return node.role == groma_Role_ROLE_TAG; });
    config = tag->config;
    baud = site.baud;
  }
  provision::AirPlan plan = provision::plan_air(config, baud);
  if (!options.plan.empty() || options.link) {
    std::erase_if(plan.links,
                  [&](const provision::LinkLoad& load) { return load.name != link_name(config.link); });
  }
  const double success = provision::range_success(config.schedule.method, 1.0 - options.loss);
  if (options.json) {
    say_json(as_json(plan, options.loss, success));
  } else {
    say(as_text(plan, options.loss, success));
  }
  Warnings warnings;
  for (const std::string& text : plan.warnings) {
    warnings.add(options.plan.empty() ? text : fmt::format("{}: {}", options.plan.string(), text));
  }
  return warnings.exit_code();
}

}  // namespace

void add_plan(CLI::App& app, Action& action) {
  const auto options = std::make_shared<PlanOptions>();
  CLI::App* command = app.add_subcommand("plan",
                                         "Predict the figures of a schedule: slots, air use, ranges per "
                                         "second, and the load of each link, for a site "
                                         "plan's file or for numbers of tags and anchors.");
  CLI::Option* file =
      command->add_option("PLAN", options->plan, "The site plan, a YAML file")->type_name("FILE");
  const auto number = [&](const char* name, auto& value, const char* text, unsigned first, unsigned last) {
    return command->add_option(name, value, text)
        ->check(CLI::Range(first, last))
        ->excludes(file)
        ->capture_default_str()
        ->type_name("N");
  };
  number("--tags", options->tags, "Tags", 1, 16);
  number("--anchors", options->anchors, "Anchors", 1, 64);
  number("--backups", options->backups, "Anchors that back up the master", 0, 7);
  number("--responses", options->site.responses, "Anchors that a tag polls at once; 0: all, up to 16", 0, 16);
  number("--turn-round", options->site.turn_round_us,
         "Turnaround: end of a frame to the preamble of the answer, us", mac::kLeastTurnaround_us,
         mac::kMostTurnaround_us)
      ->type_name("US");
  command
      ->add_option("--gap", options->site.response_gap_us,
                   fmt::format("Time between answers, us (default: {}, with a MIC {}, with --arm-ahead {})",
                               mac::usual_gap_us(false, false), mac::usual_gap_us(false, true),
                               mac::usual_gap_us(true, false)))
      ->check(CLI::Range(mac::kLeastGap_us, mac::kMostGap_us))
      ->excludes(file)
      ->type_name("US");
  number("--guard", options->site.guard_us, "A receiver turns on this long before a frame is due, us",
         mac::kLeastGuard_us, mac::kMostGuard_us)
      ->type_name("US");
  command->add_option("--preamble", options->site.preamble_symbols, "Length of the preamble, symbols")
      ->check(CLI::IsMember({64U, 128U, 256U}))
      ->excludes(file)
      ->capture_default_str()
      ->type_name("N");
  command->add_option("--method", options->method, "Frame that completes an exchange: FINAL or the next POLL")
      ->check(CLI::IsMember({"final", "next-poll"}))
      ->excludes(file)
      ->capture_default_str()
      ->type_name("NAME");
  command
      ->add_option("--link", options->link,
                   "Link over which tags report, and whose load is shown. Default: uart, and the load of all")
      ->check(CLI::IsMember({"uart", "can", "can-fd"}))
      ->excludes(file)
      ->type_name("NAME");
  command
      ->add_flag("--raw-stamps", options->site.report_raw_stamps,
                 "Report each range with its four time intervals")
      ->excludes(file);
  command
      ->add_flag("--arm-ahead", options->site.arm_ahead,
                 "Tags arm the receiver for the next answer before they read the last one")
      ->excludes(file);
  command->add_flag("--authenticated", options->authenticated, "With a MIC in each frame")->excludes(file);
  command->add_option("--loss", options->loss, "Share of the frames that are not received")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str()
      ->type_name("SHARE");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
