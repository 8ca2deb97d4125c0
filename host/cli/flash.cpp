// groma flash: writes the image into nodes by a debug probe, and with a plan configures them.
#include "host/provision/flash.hpp"

#include <fmt/format.h>

#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/nodes.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/exit_code.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/debug_probe.hpp"
#include "host/provision/image.hpp"
#include "host/provision/process.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

namespace {

using provision::DebugProbe;
using provision::FlashFault;
using provision::FlashOutcome;

struct FlashOptions {
  std::filesystem::path image = provision::default_image_path();
  std::string board = provision::kDefaultBoard;
  std::string openocd = "openocd";
  std::string adapter;
  std::string probe;
  std::filesystem::path plan;
  std::string nodes;
  bool all = false;
  bool recover = false;
  bool reassign = false;
  bool list = false;
  bool udev_rules = false;
  bool verbose = false;
  bool json = false;
};

const char* word(FlashFault fault) {
  switch (fault) {
    case FlashFault::kNone:
      return "";
    case FlashFault::kNoOpenocd:
      return "no-openocd";
    case FlashFault::kNoProbe:
      return "no-probe";
    case FlashFault::kManyProbes:
      return "many-probes";
    case FlashFault::kOtherSerial:
      return "other-serial";
    case FlashFault::kPermission:
      return "permission";
    case FlashFault::kBusy:
      return "busy";
    case FlashFault::kNoTarget:
      return "no-target";
    case FlashFault::kOtherTarget:
      return "other-target";
    case FlashFault::kLocked:
      return "locked";
    case FlashFault::kNotUnlocked:
      return "not-unlocked";
    case FlashFault::kWriting:
      return "writing";
    case FlashFault::kVerify:
      return "verify";
    case FlashFault::kProbeLost:
      return "probe-lost";
    case FlashFault::kOther:
      return "other";
  }
  return "";
}

int exit_code_of(FlashFault fault) {
  switch (fault) {
    case FlashFault::kNone:
      return io::kGood;
    case FlashFault::kManyProbes:
      return io::kUsage;
    case FlashFault::kPermission:
      return io::kNoPermission;
    default:
      return io::kUnavailable;
  }
}

const char* result_word(const FlashOutcome& outcome) {
  if (outcome.fault != FlashFault::kNone) return "failed";
  return outcome.changed ? "flashed" : "unchanged";
}

Json to_json(const FlashOutcome& outcome) {
  const bool failed = outcome.fault != FlashFault::kNone;
  return {{"result", result_word(outcome)},
          {"fault", failed ? Json(word(outcome.fault)) : Json(nullptr)},
          {"message", failed ? Json(outcome.message) : Json(nullptr)},
          {"unlocked", outcome.recovered}};
}

int list_probes(bool json) {
  const std::vector<DebugProbe> probes = provision::find_debug_probes();
  if (json) {
    Json entries = Json::array();
    for (const DebugProbe& probe : probes) {
      Json ports = Json::array();
      for (const std::filesystem::path& port : probe.serial_ports) ports.push_back(port.string());
      entries.push_back({{"adapter", provision::word(probe.adapter)},
                         {"serial", probe.serial},
                         {"product", probe.product},
                         {"usb_id", probe.usb_id},
                         {"device", probe.device.string()},
                         {"accessible", probe.accessible},
                         {"ports", ports}});
    }
    say_json({{"probes", entries}});
    return io::kGood;
  }
  if (probes.empty()) {
    complain("no debug probe (J-Link or CMSIS-DAP) on USB; plug it in, the DWM1001-DEV has one on board");
    return io::kGood;
  }
  Table table({"probe", "adapter", "product", "ports"});
  for (const DebugProbe& probe : probes) {
    std::string ports;
    for (const std::filesystem::path& port : probe.serial_ports)
      ports += (ports.empty() ? "" : " ") + port.string();
    table.add({probe.serial, provision::word(probe.adapter), probe.product, ports});
    if (!probe.accessible) {
      complain(fmt::format("{}: this user may not use the probe {}; {}", probe.device.string(), probe.serial,
                           provision::permission_remedy()));
    }
  }
  say(table.format(true));
  return io::kGood;
}

class Flashing {
 public:
  Flashing(const FlashOptions& options, Warnings& warnings)
      : options_(options), image_(provision::read_node_image(options.image)) {
    provision::require_board(image_, options.board);
    if (image_.board.empty()) {
      warnings.add(fmt::format("{}: the image names no board; make sure that it is of the board {}",
                               image_.path.string(), options.board));
    }
    own_interface_ = !options.adapter.empty() && !provision::adapter_from_word(options.adapter);
    if (own_interface_ && !std::filesystem::is_regular_file(options.adapter)) {
      throw CLI::ValidationError(
          "--adapter",
          fmt::format("'{}' is neither jlink nor cmsis-dap nor a file of OpenOCD", options.adapter));
    }
    openocd_ = provision::find_program(options.openocd);
    if (!own_interface_) probes_ = provision::find_debug_probes();
  }

  [[nodiscard]] const provision::NodeImage& image() const { return image_; }
  [[nodiscard]] const std::vector<DebugProbe>& probes() const { return probes_; }

  // `prefix`: of the messages; sets `port` if the probe has a serial port.
  FlashOutcome flash(const std::string& prefix, const std::string& serial,
                     std::string* port = nullptr) const {
    FlashOutcome outcome = try_flash(prefix, serial, port);
    if (outcome.fault != FlashFault::kNone) {
      outcome.message = prefix + outcome.message;
      complain(outcome.message);
    }
    return outcome;
  }

 private:
  FlashOutcome try_flash(const std::string& prefix, const std::string& serial, std::string* port) const {
    FlashOutcome outcome;
    if (!openocd_) {
      outcome.fault = FlashFault::kNoOpenocd;
      outcome.message =
          options_.openocd + ": not installed; 'sudo apt-get install openocd', or name it with --openocd";
      return outcome;
    }
    provision::FlashRequest request;
    request.image = image_;
    request.openocd = *openocd_;
    request.serial = serial;
    request.recover = options_.recover;
    request.own_interface = own_interface_;
    if (own_interface_) {
      request.interface = std::filesystem::absolute(options_.adapter).string();
    } else {
      const provision::ChosenProbe chosen =
          provision::choose_probe(probes_, provision::adapter_from_word(options_.adapter), serial);
      if (chosen.probe == nullptr) {
        outcome.fault = chosen.fault;
        outcome.message = chosen.message;
        return outcome;
      }
      request.interface = fmt::format("interface/{}.cfg", provision::word(chosen.probe->adapter));
      request.serial = chosen.probe->serial;
      if (port != nullptr && !chosen.probe->serial_ports.empty())
        *port = chosen.probe->serial_ports.front().string();
    }
    outcome = provision::flash(request, [&](const char* phase) { show_progress(prefix + phase); });
    if (options_.verbose) fmt::print(stderr, "{}", outcome.output);
    return outcome;
  }

  const FlashOptions& options_;
  provision::NodeImage image_;
  bool own_interface_ = false;
  std::optional<std::filesystem::path> openocd_;
  std::vector<DebugProbe> probes_;
};

Json to_json(const provision::NodeImage& image) {
  return {{"path", image.path.string()},
          {"version", image.version},
          {"git_hash", fmt::format("{:08x}", image.git_hash)},
          {"board", image.board.empty() ? Json(nullptr) : Json(image.board)},
          {"bytes", image.bytes}};
}

// Flashes by one probe, or with --all by every connected one.
int flash_probes(const FlashOptions& options) {
  Warnings warnings;
  const Flashing flashing(options, warnings);
  std::vector<std::string> serials{options.probe};
  if (options.all) {
    serials.clear();
    for (const DebugProbe& probe : flashing.probes()) serials.push_back(probe.serial);
    if (serials.empty()) serials.emplace_back();  // fails with "no probe"
  }
  Table table({"probe", "result", "image"});
  Json json{{"image", to_json(flashing.image())}, {"probes", Json::array()}};
  int first_failure = io::kGood;
  for (const std::string& serial : serials) {
    const FlashOutcome outcome =
        flashing.flash(serial.empty() ? "" : fmt::format("probe {}: ", serial), serial);
    if (first_failure == io::kGood) first_failure = exit_code_of(outcome.fault);
    table.add({serial.empty() ? "-" : serial, result_word(outcome), flashing.image().version});
    Json entry{{"probe", serial.empty() ? Json(nullptr) : Json(serial)}};
    entry.update(to_json(outcome));
    json["probes"].push_back(std::move(entry));
  }
  if (options.json) {
    say_json(json);
  } else {
    say(table.format(true));
  }
  return first_failure != io::kGood ? first_failure : warnings.exit_code();
}

// Flashes a plan's nodes, each by its own probe, and configures each over its port.
int flash_plan(const FlashOptions& options) {
  const provision::SitePlan plan = provision::read_site_plan(options.plan);
  const std::vector<const provision::PlannedNode*> nodes = select_nodes(plan, options.nodes);
  if (nodes.size() > 1) {
    if (!options.probe.empty()) throw CLI::ValidationError("--probe", "requires one --node");
    for (const provision::PlannedNode* node : nodes) {
      if (node->probe.empty()) {
        complain(fmt::format(
            "{}: names no probe for node {}; add 'probe:' to it ('groma flash --list'), or flash the "
            "nodes one by one with --node",
            plan.path.string(), node->id));
        return io::kBadConfiguration;
      }
    }
  }
  Warnings warnings;
  const Flashing flashing(options, warnings);
  provision::ConfigureOptions configuring;
  configuring.reassign = options.reassign;
  configuring.build = provision::Build{flashing.image().version, flashing.image().git_hash};

  Table table({"node", "role", "probe", "flash", "port", "configuration"});
  Json json{{"plan", plan.path.string()}, {"image", to_json(flashing.image())}, {"nodes", Json::array()}};
  int first_failure = io::kGood;
  for (const provision::PlannedNode* planned : nodes) {
    provision::PlannedNode node = *planned;
    const std::string serial = options.probe.empty() ? node.probe : options.probe;
    std::string probe_port;
    const std::string prefix = fmt::format("node {}: ", node.id);
    const FlashOutcome flashed = flashing.flash(prefix, serial, &probe_port);
    if (first_failure == io::kGood) first_failure = exit_code_of(flashed.fault);
    if (node.port.empty()) node.port = probe_port;
    const bool reachable = !node.port.empty() || !node.can_link.empty();
    std::optional<provision::NodeOutcome> configured;
    if (flashed.fault == FlashFault::kNone && reachable) {
      show_progress(prefix + "configuring");
      configured = provision::configure_node(node, plan.baud, configuring);
      if (const int code = report_outcome(*configured, warnings); first_failure == io::kGood)
        first_failure = code;
    } else if (flashed.fault == FlashFault::kNone) {
      warnings.add(
          fmt::format("node {} is flashed but not configured: the plan names no port for it", node.id));
    }
    table.add({fmt::format("{}", node.id), link::role_word(node.role), serial.empty() ? "-" : serial,
               result_word(flashed), configured ? configured->port : "-",
               configured ? cli::result_word(*configured) : "-"});
    Json entry{{"id", node.id}, {"role", link::role_word(node.role)}, {"probe", serial}};
    entry["flash"] = to_json(flashed);
    entry["configure"] = configured ? cli::to_json(*configured) : Json(nullptr);
    json["nodes"].push_back(std::move(entry));
  }
  if (options.json) {
    say_json(json);
  } else {
    say(table.format(true));
  }
  return first_failure != io::kGood ? first_failure : warnings.exit_code();
}

int run(const FlashOptions& options) {
  if (options.udev_rules) {
    say(provision::udev_rules());
    return io::kGood;
  }
  if (options.list) return list_probes(options.json);
  if (options.all && (!options.plan.empty() || !options.probe.empty())) {
    throw CLI::ValidationError("--all", "cannot be combined with --plan or --probe");
  }
  if (!options.plan.empty()) return flash_plan(options);
  if (!options.nodes.empty()) throw CLI::ValidationError("--node", "requires --plan");
  return flash_probes(options);
}

}  // namespace

void add_flash(CLI::App& app, Action& action) {
  const auto options = std::make_shared<FlashOptions>();
  CLI::App* command =
      app.add_subcommand("flash",
                         "Write the firmware into nodes by a debug probe, with OpenOCD, and verify it; with "
                         "a plan also configure them. "
                         "A node that already has it is skipped: after an interruption repeat the command.");
  command
      ->add_option("--image", options->image,
                   "Intel HEX file. Default: the one that the preset dwm1001 builds")
      ->type_name("FILE");
  command->add_option("--board", options->board, "The nodes' board; an image of another one is refused")
      ->capture_default_str()
      ->type_name("NAME");
  command->add_option("--probe", options->probe, "Serial number of the probe")->type_name("SERIAL");
  command
      ->add_option("--adapter", options->adapter,
                   "jlink, cmsis-dap, or OpenOCD's configuration file of another. Default: the connected one")
      ->type_name("NAME");
  command->add_option("--openocd", options->openocd, "OpenOCD, version 0.12 or later")
      ->capture_default_str()
      ->type_name("PROGRAM");
  command->add_option("--plan", options->plan, "The site plan: all its nodes, each by its own probe")
      ->type_name("FILE");
  command->add_option("--node", options->nodes, "Only these nodes of the plan, such as 1,5")
      ->type_name("IDS");
  command->add_flag("--all", options->all, "Flash by every connected probe");
  command->add_flag("--recover", options->recover, "Unlock a locked part, which erases its whole flash");
  command->add_flag("--reassign", options->reassign,
                    "Also configure nodes that are configured under another id");
  command->add_flag("--list", options->list, "Show the connected probes, and end");
  command->add_flag("--udev-rules", options->udev_rules,
                    "Print the udev rules for probes and ports, and end");
  command->add_flag("--verbose", options->verbose, "Show OpenOCD's output");
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
