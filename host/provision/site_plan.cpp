#include "host/provision/site_plan.hpp"

#include <fmt/format.h>
#include <sys/stat.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstdint>
#include <limits>
#include <map>
#include <set>
#include <string_view>
#include <system_error>

#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/link/can_path.hpp"

namespace groma::provision {

namespace {

using io::YamlValue;

constexpr std::int64_t kMaxId = 65'534;
constexpr std::int64_t kMaxNetworkId = 65'534;
constexpr std::int64_t kMaxEpoch = std::numeric_limits<std::uint32_t>::max();
constexpr std::int64_t kMaxAntennaDelay_dtu = 65'535;
// The capacity of a schedule: tags, anchors, slots, back-ups of the master.
constexpr std::array<std::size_t, 2> kMaxNodesPerRole{16, 64};
constexpr std::int64_t kMaxSlots = 16;
constexpr std::size_t kMaxBackups = 7;

// Reads an integer from `first` to `last`, if the key exists.
void read_integer(const YamlValue& map, std::string_view key, std::int64_t first, std::int64_t last,
                  std::uint32_t& out) {
  if (const auto value = map.find(key)) out = static_cast<std::uint32_t>(value->integer(first, last));
}

// False if the key is absent.
bool is_true(const YamlValue& map, std::string_view key) {
  const auto value = map.find(key);
  return value && value->one_of(std::array<std::string_view, 2>{"false", "true"}) == 1;
}

// Decimal, or hexadecimal with 0x, as manuals write registers.
std::uint32_t parse_register(const YamlValue& value) {
  const std::string text = value.text();
  const bool hexadecimal = text.starts_with("0x");
  const char* first = text.data() + (hexadecimal ? 2 : 0);
  std::uint32_t number = 0;
  const auto [last, error] = std::from_chars(first, text.data() + text.size(), number, hexadecimal ? 16 : 10);
  if (error != std::errc() || last != text.data() + text.size()) {
    value.fail(fmt::format("is not a register value of 32 bits: {}", io::shown(text)),
               "write it as 0x85858585");
  }
  return number;
}

// Checks that each is an anchor, named once and not the master.
std::vector<model::NodeId> parse_backups(const YamlValue& list, const SiteSettings& site) {
  std::vector<model::NodeId> backups;
  for (const YamlValue& entry : list.list()) {
    const auto id = static_cast<model::NodeId>(entry.integer(1, kMaxId));
    const auto is = [id](model::NodeId other) { return other == id; };
    if (std::none_of(site.anchor_ids.begin(), site.anchor_ids.end(), is)) {
      entry.fail(fmt::format("is {}", id), "name one of the anchors");
    }
    if (id == site.master_id || std::any_of(backups.begin(), backups.end(), is)) {
      entry.fail(fmt::format("{} has its rank already", id), "name each anchor once, and not the master");
    }
    if (backups.size() == kMaxBackups) {
      entry.fail("is one too many", fmt::format("a schedule holds {} back-ups", kMaxBackups));
    }
    backups.push_back(id);
  }
  return backups;
}

void parse_schedule(const YamlValue& map, SiteSettings& site) {
  map.expect_keys({{},
                   {"epoch", "master_id", "backup_ids", "method", "preamble", "slots", "responses",
                    "turn_round_us", "response_gap_us", "guard_us", "arm_ahead"}});
  read_integer(map, "slots", 1, kMaxSlots, site.slots);
  read_integer(map, "responses", 1, 16, site.responses);
  read_integer(map, "epoch", 0, kMaxEpoch, site.epoch);
  if (const auto master = map.find("master_id")) {
    site.master_id = static_cast<model::NodeId>(master->integer(1, kMaxId));
    if (std::find(site.anchor_ids.begin(), site.anchor_ids.end(), site.master_id) == site.anchor_ids.end()) {
      master->fail(fmt::format("is {}", site.master_id), "name one of the anchors");
    }
  }
  const auto backups = map.find("backup_ids");
  site.backup_ids = backups ? parse_backups(*backups, site) : first_backups(site);
  if (const auto method = map.find("method")) {
    site.method = method->one_of(std::array<std::string_view, 2>{"final", "next-poll"}) == 0
                      ? groma_RangingMethod_METHOD_DS_FINAL
                      : groma_RangingMethod_METHOD_DS_NEXT_POLL;
  }
  if (const auto preamble = map.find("preamble")) {
    site.preamble_symbols =
        std::array{64U, 128U, 256U}.at(preamble->one_of(std::array<std::string_view, 3>{"64", "128", "256"}));
  }
  read_integer(map, "turn_round_us", mac::kLeastTurnaround_us, mac::kMostTurnaround_us, site.turn_round_us);
  read_integer(map, "response_gap_us", mac::kLeastGap_us, mac::kMostGap_us, site.response_gap_us);
  read_integer(map, "guard_us", mac::kLeastGuard_us, mac::kMostGuard_us, site.guard_us);
  site.arm_ahead = is_true(map, "arm_ahead");
}

// Keys that a node may have; the site's values are the default.
constexpr std::string_view kTransmitDelayKey = "transmit_antenna_delay_dtu";
constexpr std::string_view kReceiveDelayKey = "receive_antenna_delay_dtu";
constexpr std::string_view kTransmitPowerKey = "transmit_power";
constexpr std::string_view kSlotKey = "slot";

template <typename Settings>  // SiteSettings or groma_Config
void parse_radio_keys(const YamlValue& map, Settings& settings) {
  read_integer(map, kTransmitDelayKey, 0, kMaxAntennaDelay_dtu, settings.transmit_antenna_delay_dtu);
  read_integer(map, kReceiveDelayKey, 0, kMaxAntennaDelay_dtu, settings.receive_antenna_delay_dtu);
  if (const auto power = map.find(kTransmitPowerKey)) settings.transmit_power = parse_register(*power);
}

struct LinkSettings {
  unsigned baud = 1'000'000;
  std::string can_scheme;  // of link::open_link(); empty: nodes report over their UART
  std::string can_interface;
};

LinkSettings parse_link(const YamlValue& map, SiteSettings& site) {
  map.expect_keys({{}, {"type", "baud", "can_interface", "nominal_bit_per_s", "data_bit_per_s"}});
  LinkSettings link;
  std::size_t type = 0;
  if (const auto named = map.find("type")) {
    type = named->one_of(std::array<std::string_view, 3>{"uart", "can", "can-fd"});
  }
  site.link = std::array{groma_Link_LINK_UART, groma_Link_LINK_CAN, groma_Link_LINK_CAN_FD}.at(type);
  link.can_scheme = std::array{"", "can", "canfd"}.at(type);
  if (const auto baud = map.find("baud")) link.baud = static_cast<unsigned>(baud->integer(1'200, 4'000'000));
  for (const std::string_view key : {"can_interface", "nominal_bit_per_s", "data_bit_per_s"}) {
    const auto value = map.find(key);
    const bool fd_only = key == "data_bit_per_s";
    if (value && (type == 0 || (fd_only && type != 2))) {
      value->fail(fd_only ? "requires 'type: can-fd'" : "requires 'type: can' or 'type: can-fd'",
                  "remove it, or change the type");
    }
  }
  read_integer(map, "nominal_bit_per_s", 10'000, 1'000'000, site.can_nominal_bit_per_s);
  read_integer(map, "data_bit_per_s", 10'000, 8'000'000, site.can_data_bit_per_s);
  if (type != 0) {
    if (!map.find("can_interface")) map.fail("lacks the key can_interface", "name it, such as can0");
    link.can_interface = map.at("can_interface").text();
    if (link.can_interface.empty()) map.at("can_interface").fail("is empty", "name it, such as can0");
  }
  return link;
}

void expect_private(const std::filesystem::path& path) {
  constexpr mode_t kOthers = 077;
  struct stat status {};
  if (::stat(path.c_str(), &status) != 0 || (status.st_mode & kOthers) == 0) return;
  throw io::PermissionError(
      {path}, "others may read or change this key",
      fmt::format("'chmod 600 {}'; if they may have read it, make a new one", path.string()));
}

// The file must hold 32 hexadecimal digits and nothing else except white space around them.
NetworkKey read_key(const YamlValue& value, const std::filesystem::path& folder) {
  const std::filesystem::path path = folder / value.text();
  std::string text = io::read_file(path);
  expect_private(path);
  constexpr std::string_view kSpace = " \t\r\n";
  text.erase(0, std::min(text.find_first_not_of(kSpace), text.size()));
  text.erase(text.find_last_not_of(kSpace) + 1);
  NetworkKey key{};
  constexpr std::size_t kDigitsPerByte = 2;
  bool good = text.size() == kDigitsPerByte * key.size();
  for (std::size_t i = 0; good && i < key.size(); ++i) {
    const char* first = text.data() + kDigitsPerByte * i;
    const auto [last, error] = std::from_chars(first, first + kDigitsPerByte, key.at(i), 16);
    good = error == std::errc() && last == first + kDigitsPerByte;
  }
  if (!good) {
    // The message must not show the file's content.
    value.fail(fmt::format("names {}, which holds no key", path.string()),
               "write 32 hexadecimal digits into it, such as 'openssl rand -hex 16' prints");
  }
  return key;
}

std::vector<PlannedNode> parse_nodes(const YamlValue& list, const std::filesystem::path& folder) {
  std::vector<PlannedNode> nodes;
  std::set<model::NodeId> ids;
  std::set<std::string> ports;
  std::set<std::string> probes;
  std::array<std::size_t, 2> counts{};
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys(
        {{"id", "role"},
         {"port", "via", "probe", kSlotKey, kTransmitDelayKey, kReceiveDelayKey, kTransmitPowerKey}});
    PlannedNode node;
    node.id = static_cast<model::NodeId>(entry.at("id").integer(1, kMaxId));
    if (!ids.insert(node.id).second) {
      entry.at("id").fail(fmt::format("{} is taken", node.id), "give each tag and anchor its own id");
    }
    const std::size_t role = entry.at("role").one_of(std::array<std::string_view, 2>{"tag", "anchor"});
    node.role = role == 0 ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR;
    if (++counts.at(role) > kMaxNodesPerRole.at(role)) {
      entry.fail(fmt::format("is one {} too many", role == 0 ? "tag" : "anchor"),
                 fmt::format("a schedule holds {}", kMaxNodesPerRole.at(role)));
    }
    if (const auto slot = entry.find(kSlotKey)) {
      if (role != 0)
        slot->fail("is a tag's", "remove it; anchors answer in the slots of the tags that poll them");
      node.slot = static_cast<std::uint8_t>(slot->integer(0, kMaxSlots - 1));
    }
    if (const auto port = entry.find("port")) {
      const std::string text = port->text();
      if (text.empty()) port->fail("is empty", "name a port, such as /dev/ttyACM0, or remove it");
      const bool can = link::is_can_path(text);
      if (can && !link::parse_can_path(text)) {
        port->fail("names no node on a CAN bus", std::string(link::kCanPathAdvice));
      }
      node.port = can ? text : (folder / text).string();
      if (!ports.insert(node.port).second) port->fail("is given twice", "give each node its own port");
    }
    if (const auto via = entry.find("via")) {
      if (entry.find("port")) via->fail("cannot be combined with 'port:'", "remove one of them");
      node.via = static_cast<model::NodeId>(via->integer(1, kMaxId));
    }
    if (const auto probe = entry.find("probe")) {
      node.probe = probe->text();
      if (node.probe.empty()) probe->fail("is empty", "'groma flash --list' shows the serial numbers");
      if (!probes.insert(node.probe).second) probe->fail("is given twice", "give each node its own probe");
    }
    nodes.push_back(std::move(node));
  }
  if (counts[0] == 0) list.fail("has no tag", "a site needs one or more");
  if (counts[1] == 0) list.fail("has no anchor", "a site needs one or more");
  return nodes;
}

void resolve_via(const std::vector<YamlValue>& entries, SitePlan& plan) {
  for (std::size_t i = 0; i < plan.nodes.size(); ++i) {
    PlannedNode& node = plan.nodes[i];
    if (node.via == 0) continue;
    const PlannedNode* wired = plan.find(node.via);
    if (wired == nullptr || wired->port.empty()) {
      entries[i].at("via").fail(fmt::format("{} is not a node with a port", node.via),
                                "name one of the nodes that have a 'port:'");
    }
    node.via_port = wired->port;
  }
}

}  // namespace

const PlannedNode* SitePlan::find(model::NodeId id) const {
  const auto found =
      std::find_if(nodes.begin(), nodes.end(), [&](const auto& node) { return node.id == id; });
  return found == nodes.end() ? nullptr : &*found;
}

SitePlan read_site_plan(const std::filesystem::path& path) {
  const YamlValue root = YamlValue::parse(path, io::read_configuration(path));
  root.expect_keys({{"schema", "network_id", "nodes"},
                    {"schedule", "radio", "link", "report_raw_stamps", "correct_temperature",
                     "correct_power_bias", "network_key_file"}});
  if (root.at("schema").integer(0, std::numeric_limits<std::int64_t>::max()) != 1) {
    root.at("schema").fail("is not 1", "this program reads schema 1 only");
  }
  SitePlan plan;
  plan.path = path;
  SiteSettings site;
  site.network_id = static_cast<std::uint16_t>(root.at("network_id").integer(0, kMaxNetworkId));
  plan.nodes = parse_nodes(root.at("nodes"), path.parent_path());
  std::map<model::NodeId, std::optional<std::uint8_t>> tags;
  for (const PlannedNode& node : plan.nodes) {
    if (node.role == groma_Role_ROLE_TAG) {
      tags[node.id] = node.slot;
    } else {
      site.anchor_ids.push_back(node.id);
    }
  }
  const bool slots_named =
      std::any_of(tags.begin(), tags.end(), [](const auto& tag) { return tag.second.has_value(); });
  for (const auto& [id, slot] : tags) {
    site.tag_ids.push_back(id);
    if (!slots_named) continue;
    if (!slot) {
      root.at("nodes").fail(fmt::format("names slots, but none for tag {}", id),
                            "name one for each tag, or for none");
    }
    site.tag_slots.push_back(*slot);
    site.slots = std::max<std::uint32_t>(site.slots, *slot + 1U);
  }
  std::sort(site.anchor_ids.begin(), site.anchor_ids.end());
  site.master_id = site.anchor_ids.front();
  site.backup_ids = first_backups(site);
  if (const auto schedule = root.find("schedule")) parse_schedule(*schedule, site);
  if (const auto radio = root.find("radio")) {
    radio->expect_keys({{}, {kTransmitDelayKey, kReceiveDelayKey, kTransmitPowerKey}});
    parse_radio_keys(*radio, site);
  }
  LinkSettings link;
  if (const auto settings = root.find("link")) link = parse_link(*settings, site);
  plan.baud = link.baud;
  site.report_raw_stamps = is_true(root, "report_raw_stamps");
  site.correct_temperature = is_true(root, "correct_temperature");
  site.correct_power_bias = is_true(root, "correct_power_bias");
  if (const auto key = root.find("network_key_file")) site.network_key = read_key(*key, path.parent_path());
  const std::vector<YamlValue> entries = root.at("nodes").list();
  resolve_via(entries, plan);
  for (std::size_t i = 0; i < plan.nodes.size(); ++i) {
    PlannedNode& node = plan.nodes[i];
    node.config = config_of(site, node.role, node.id);
    parse_radio_keys(entries[i], node.config);
    if (!link.can_scheme.empty()) {
      node.can_link = fmt::format("{}:{}/{}", link.can_scheme, link.can_interface, node.id);
    }
    if (const char* fault = node::fault_of(node.config); *fault != '\0') {
      entries[i].fail(fmt::format("would be refused by the node ({})", fault), "correct that value");
    }
  }
  return plan;
}

}  // namespace groma::provision
