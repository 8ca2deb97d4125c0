// Configures nodes as a site plan says. The state is read from each node, so after an interruption the
// whole can be repeated; completed steps are skipped.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <type_traits>
#include <vector>

#include "groma.pb.h"
#include "host/link/byte_link.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::provision {

enum class NodeFault {
  kNone,
  kNoPort,         // the port does not exist
  kNotInPlan,      // the plan names no port for the node
  kPermission,     // this user may not open the port
  kBusy,           // another program uses the port
  kUnsuitable,     // not a link, or not at that bit rate
  kNoAnswer,       // no answer, or unplugged meanwhile
  kOtherProtocol,  // firmware of another release
  kOtherBuild,     // not the expected build
  kWrongNode,      // configured as another node
  kRefused,        // the node refused, with its text
  kStorage,        // the node could not store the configuration, or reads back another one
  kNotInForce,     // applied, but the node's hello reports another configuration
  kRadio,          // the DW1000 did not come up
  kLink,           // the CAN controller did not come up, or the node does not answer on the bus
  kHeldBack,       // written but not applied, as not all nodes could change their schedule
};

struct NodeOutcome {
  NodeFault fault = NodeFault::kNone;
  std::string message;   // of the fault: names node, port, cause and remedy
  bool changed = false;  // false: the configuration was in force already
  std::string advice;    // what the site has to do, if the plan changes its timing; empty: nothing
  std::string port;      // the port used for commands
  std::optional<groma_Hello> hello;  // the last one received
};

using LinkOpener = std::function<link::OpenedLink(const std::string& path, unsigned baud)>;

// Identifies a build, as in an image and in a hello.
struct Build {
  std::string version;
  std::uint32_t git_hash = 0;
};

struct ConfigureOptions {
  LinkOpener open = link::open_link;
  std::optional<Build> build;  // if given, the node must run this build
  bool reassign = false;       // accept a node that is configured as another one
  // Called before each step with "asks", "reads", "writes" or "applies". May be empty.
  std::function<void(const char* step)> progress;
};

// Whether the node has no port and another node passes commands on to it.
[[nodiscard]] bool is_reached_by_air(const PlannedNode& node);

[[nodiscard]] NodeOutcome configure_node(const PlannedNode& node, unsigned baud,
                                         const ConfigureOptions& options = {});

// Configures nodes one after the other. If some are reached over the air, all are written first and then
// applied, those over the air before the wired ones that pass commands on: once these follow the new
// schedule they cannot reach nodes of the old one. If a node could not be written, no node changes its
// schedule. `done`: called with each index and outcome as soon as it is known; may be empty. Outcomes are
// in the order of `nodes`.
[[nodiscard]] std::vector<NodeOutcome> configure_nodes(
    const std::vector<const PlannedNode*>& nodes, unsigned baud, const ConfigureOptions& options = {},
    const std::function<void(std::size_t, const NodeOutcome&)>& done = {});

// Lets the node at `port` blink for duration_s, 0 to 3600 s; 0 stops it. `target`: the id of another node, to
// which the node at the port passes the command on over the air; 0: itself.
[[nodiscard]] NodeOutcome identify_node(const std::string& port, unsigned baud, std::uint32_t duration_s,
                                        const LinkOpener& open = link::open_link, model::NodeId target = 0);

// Makes the tag at `port` (or `target`, as for identify_node()) return its slot and stop polling until it is
// configured again or restarts.
[[nodiscard]] NodeOutcome let_leave(const std::string& port, unsigned baud, model::NodeId target = 0,
                                    const LinkOpener& open = link::open_link);

// The weight of an anchor for the places in a tag's POLL: 100 is the default; 0: only a place that is free.
struct AnchorHint {
  model::NodeId anchor = 0;
  std::uint8_t weight = 100;
};
inline constexpr std::size_t kMaxAnchorHints = std::extent_v<decltype(groma_AnchorPreference::ids)>;
// Replaces the hints of a tag (`port` and `target` as for let_leave()). Throws std::length_error above
// kMaxAnchorHints.
[[nodiscard]] NodeOutcome hint_anchors(const std::string& port, unsigned baud,
                                       const std::vector<AnchorHint>& hints, model::NodeId target = 0,
                                       const LinkOpener& open = link::open_link);

// A node's hello, counters and slack.
struct NodeReport {
  NodeOutcome outcome;
  std::optional<groma_Counters> counters;
  std::optional<groma_Slack> slack;  // nothing: the node's firmware does not measure it
};
[[nodiscard]] NodeReport ask_node(const std::string& port, unsigned baud, model::NodeId target = 0,
                                  const LinkOpener& open = link::open_link);

// One anchor's ranges to others.
struct SurveyedPair {
  model::NodeId from = 0;
  model::NodeId to = 0;
  double range_m = 0.0;  // mean; antenna delays are applied, the pair bias is not
  double sigma_m = 0.0;  // standard deviation of a single range
  std::uint32_t count = 0;
};
struct SurveyOutcome {
  NodeOutcome outcome;
  std::vector<SurveyedPair> pairs;
};
// Makes `anchor` range to the anchors around it, in the slot of the tag at `port`. exchanges: 1 to 200.
[[nodiscard]] SurveyOutcome survey_from(const std::string& port, unsigned baud, model::NodeId anchor,
                                        std::uint16_t exchanges, const LinkOpener& open = link::open_link);

}  // namespace groma::provision
