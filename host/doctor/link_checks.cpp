// Checks of the nodes and their links.
#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <map>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/doctor/can_state.hpp"
#include "host/doctor/doctor.hpp"
#include "host/link/can_path.hpp"

namespace groma::doctor {
namespace {

using Json = nlohmann::json;
using link::LinkFault;

constexpr double kLongRoundTrip_s = 0.05;
constexpr double kBadShare = 0.01;  // of damaged frames

std::string text_at(const Json& object, const char* key) {
  const auto found = object.find(key);
  return found != object.end() && found->is_string() ? found->get<std::string>() : std::string();
}

template <typename Number>
std::optional<Number> number_at(const Json& object, const char* key) {
  const auto found = object.find(key);
  if (found == object.end() || !found->is_number()) return std::nullopt;
  return found->get<Number>();
}

// What gromad reported of its link i while it was open.
LinkFacts live_facts(const Observation& live, std::size_t i) {
  const Json& link = live.statuses.back().at("links").at(i);
  const auto growth = [&](const char* key) {
    return static_cast<std::uint64_t>(std::max(0.0, live.growth(fmt::format("/links/{}/{}", i, key))));
  };
  LinkFacts facts{.frames = growth("frames"),
                  .bad = growth("frames_dropped") + growth("bytes_discarded"),
                  .ranges = growth("ranges"),
                  .listened_s = live.duration_s(),
                  .round_trip_s = number_at<double>(link, "round_trip_s")};
  const Json node = link.value("node", Json::object());
  facts.node = {.id = number_at<model::NodeId>(node, "id"),
                .role = text_at(node, "role"),
                .network_id = number_at<std::uint32_t>(node, "network_id"),
                .version = text_at(node, "version"),
                .radio_error = text_at(node, "radio_error"),
                .sync = text_at(node, "sync")};
  return facts;
}

// The network that most nodes report; nothing if none does.
std::optional<std::uint32_t> common_network(const std::vector<LinkFacts>& all) {
  std::map<std::uint32_t, int> votes;
  for (const LinkFacts& facts : all) {
    if (facts.node.network_id) ++votes[*facts.node.network_id];
  }
  const auto most = std::max_element(votes.begin(), votes.end(),
                                     [](const auto& a, const auto& b) { return a.second < b.second; });
  return most == votes.end() ? std::nullopt : std::optional(most->first);
}

void judge_opening(const daemon::NodeLink& node, const link::LinkError& error, Check& check) {
  check.facts.push_back(error.message);
  const auto can = link::parse_can_path(node.path.string());
  switch (error.fault) {
    case LinkFault::kPermission:
      return check.fail(
          Verdict::kBad, "no-permission",
          "let gromad's user open it: as a service, 'sudo usermod -aG dialout groma'; then start "
          "gromad again");
    case LinkFault::kBusy:
      return check.fail(Verdict::kBad, "busy", "stop the other program that has it open");
    case LinkFault::kUnsuitable:
      return check.fail(Verdict::kBad, "unsuitable", "name the node's port in 'nodes'");
    default:
      return check.fail(
          Verdict::kBad, can ? "can-down" : "no-port",
          can ? "bring the CAN interface up" : "plug the node in, or correct its path in 'nodes'");
  }
}

void judge_bytes(const daemon::NodeLink& node, const LinkFacts& facts, Check& check) {
  const auto frames = static_cast<double>(facts.frames);
  const auto bad = static_cast<double>(facts.bad);
  check.facts.push_back(fmt::format("{:.1f} frames/s, {} damaged or discarded in {:.1f} s",
                                    frames / std::max(facts.listened_s, 0.1), facts.bad, facts.listened_s));
  if (facts.frames == 0 && facts.bad > 0) {
    check.fail(
        Verdict::kBad, "wrong-speed",
        facts.works_at > 0
            ? fmt::format("set 'baud: {}' for this node: with that, frames come", facts.works_at)
            : fmt::format("bytes come, but no frame: {} is not the node's bit rate (usual: 1000000), or "
                          "the device is no node of Groma",
                          node.baud));
  } else if (bad > 2.0 && bad > kBadShare * frames) {
    check.fail(Verdict::kWarning, "noisy-line", "check cable, connectors and USB hub of this node");
  }
}

// Whether none of the anchors that this tag ranges to is in the calibration.
bool has_foreign_anchors(const Subject& subject, model::NodeId tag) {
  if (subject.live == nullptr || subject.anchors.empty() || subject.config.calibration.learn) return false;
  bool any = false;
  for (const Json& pair : subject.live->statuses.back().value("pairs", Json::array())) {
    if (pair.at("tag") != tag) continue;
    if (subject.anchors.contains(pair.at("anchor").get<model::NodeId>())) return false;
    any = true;
  }
  return any;
}

void describe_node(const NodeFacts& node, Check& check) {
  if (node.id) {
    check.facts.push_back(fmt::format("{} {}{}{}{}", node.role.empty() ? "node" : node.role, *node.id,
                                      node.network_id ? fmt::format(" of network {}", *node.network_id) : "",
                                      node.version.empty() ? "" : ", version ", node.version));
  }
  if (!node.sync.empty()) check.facts.push_back(fmt::format("radio network: {}", node.sync));
}

void judge_node(const std::string& path, const LinkFacts& facts, const Subject& subject, Check& check) {
  const NodeFacts& node = facts.node;
  describe_node(node, check);
  check.facts.push_back(
      fmt::format("{:.1f} ranges/s", static_cast<double>(facts.ranges) / std::max(facts.listened_s, 0.1)));
  if (facts.frames == 0) {
    return check.fail(Verdict::kBad, "silent-node",
                      fmt::format("nothing comes from the node: check its power, its cable, and with 'groma "
                                  "identify {}' (gromad stopped) whether it answers",
                                  path));
  }
  if (!node.radio_error.empty()) {
    check.facts.push_back(fmt::format("radio: {}", node.radio_error));
    check.fail(Verdict::kBad, "no-radio", "replace the module, or check its wiring");
  }
  if (node.role == "unconfigured") {
    check.fail(Verdict::kBad, "not-configured", "configure it by the site's plan: 'groma configure'");
  }
  const auto is_known = [&](const model::Tag& tag) { return tag.id == node.id; };
  const bool is_tag = std::any_of(subject.config.tags.begin(), subject.config.tags.end(), is_known);
  if (node.id && !is_tag) {
    check.fail(Verdict::kBad, "other-site",
               fmt::format("'tags' has no {}: this node belongs to another site or robot; exchange it, or "
                           "configure it by this site's plan",
                           *node.id));
  }
  if (node.id && has_foreign_anchors(subject, *node.id)) {
    check.fail(Verdict::kBad, "other-site",
               "it ranges to anchors that the calibration lacks: the node is of another site, or the "
               "calibration is");
  }
  if (node.sync == "searching") {
    check.fail(Verdict::kBad, "no-network", "check that the master anchor is on and in reach");
  } else if (facts.ranges == 0) {
    check.fail(Verdict::kBad, "no-ranges", "check that anchors are on and in reach of this tag");
  }
}

}  // namespace

std::vector<Check> judge_link(const daemon::NodeLink& node, const LinkFacts& facts, const Subject& subject) {
  const std::string path = node.path.string();
  Check link{.kind = "link", .name = path};
  if (facts.error.fault != LinkFault::kNone) {
    judge_opening(node, facts.error, link);
    return {link};
  }
  if (facts.listened_s <= 0.0) {
    link.facts.emplace_back("gromad has it closed, but it can be opened: gromad opens it within 3 s");
    link.fail(Verdict::kWarning, "closed", "run doctor again in some seconds");
    return {link};
  }
  judge_bytes(node, facts, link);
  if (link.verdict == Verdict::kBad) return {link};
  Check checked{.kind = "node", .name = path};
  judge_node(path, facts, subject, checked);
  std::vector<Check> checks{link, checked};
  if (subject.live == nullptr || facts.frames == 0) return checks;
  Check clock{.kind = "clock", .name = path};
  clock.facts.push_back(facts.round_trip_s
                            ? fmt::format("round trip of its link {:.2f} ms", 1e3 * *facts.round_trip_s)
                            : std::string("round trip of its link not measured yet"));
  if (facts.round_trip_s.value_or(0.0) > kLongRoundTrip_s) {
    clock.fail(Verdict::kWarning, "slow-link",
               "the times of its ranges may be off by half of it: use a wire");
  }
  checks.push_back(clock);
  return checks;
}

std::vector<Check> check_links(const Subject& subject) {
  std::vector<LinkFacts> all;
  for (std::size_t i = 0; i < subject.config.nodes.size(); ++i) {
    bool is_open = false;
    if (subject.live != nullptr) {
      const Json links = subject.live->statuses.back().value("links", Json::array());
      is_open = i < links.size() && links.at(i).value("open", false);
    }
    all.push_back(is_open ? live_facts(*subject.live, i)
                          : probe_link(subject.config.nodes.at(i), subject.live == nullptr));
  }
  const auto network = common_network(all);
  std::vector<Check> checks;
  for (std::size_t i = 0; i < all.size(); ++i) {
    std::vector<Check> own = judge_link(subject.config.nodes.at(i), all.at(i), subject);
    const auto& id = all.at(i).node.network_id;
    if (id && id != network && own.size() > 1) {
      own.at(1).fail(Verdict::kBad, "other-site",
                     fmt::format("the other nodes are of network {}: exchange it, or configure it by this "
                                 "site's plan",
                                 *network));
    }
    std::move(own.begin(), own.end(), std::back_inserter(checks));
  }
  return checks;
}

}  // namespace groma::doctor
