// From a plan's configuration to a node that works by it. What has been done already is read from the node:
// whoever is interrupted repeats the whole, and what is done is left alone.
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
  kNoPort,         // nothing there
  kNotInPlan,      // the plan names no port for it
  kPermission,     // for this user
  kBusy,           // another program has it
  kUnsuitable,     // no link, or not at that bit rate
  kNoAnswer,       // also one that was unplugged meanwhile
  kOtherProtocol,  // firmware of another release
  kOtherBuild,     // not the one that was expected
  kWrongNode,      // it is configured as another node
  kRefused,        // by the node, with its text
  kStorage,        // the node could not store, or reads back something else
  kNotInForce,     // applied, yet its hello tells otherwise
  kRadio,          // the DW1000 did not come up
  kLink,           // the CAN controller did not come up
  kHeldBack,       // written, but not applied, for others could not be
};

struct NodeOutcome {
  NodeFault fault = NodeFault::kNone;
  std::string message;               // of the fault: names node, port, cause and remedy
  bool changed = false;              // false: it worked by that very configuration already
  std::string port;                  // where it answered
  std::optional<groma_Hello> hello;  // the last that came
};

using LinkOpener = std::function<link::OpenedLink(const std::string& path, unsigned baud)>;

// As an image and a hello tell it.
struct Build {
  std::string version;
  std::uint32_t git_hash = 0;
};

struct ConfigureOptions {
  LinkOpener open = link::open_link;
  std::optional<Build> build;  // that the node has to run, if given
  bool reassign = false;       // also a node that is configured as another
  // Told before each step: "asks", "reads", "writes", "applies". May be empty.
  std::function<void(const char* step)> progress;
};

// It has no port of its own, but one that passes commands on to it.
[[nodiscard]] bool is_reached_by_air(const PlannedNode& node);

[[nodiscard]] NodeOutcome configure_node(const PlannedNode& node, unsigned baud,
                                         const ConfigureOptions& options = {});

// All of them, one after the other. Where some are reached over the air each is written first, and then all
// go over, those over the air before the wired ones that pass it on: a schedule that changes cannot be told
// to a network that follows it already. If one could not be written nobody goes over to another schedule.
// `done`: told of each as soon as its outcome is known; may be empty. Outcomes are in the order of `nodes`.
[[nodiscard]] std::vector<NodeOutcome> configure_nodes(
    const std::vector<const PlannedNode*>& nodes, unsigned baud, const ConfigureOptions& options = {},
    const std::function<void(std::size_t, const NodeOutcome&)>& done = {});

// Lets the node at `port` blink for so many seconds, 0 to 3600; 0 ends it. `target`: another one, to which
// that one passes it on over the air; 0: itself.
[[nodiscard]] NodeOutcome identify_node(const std::string& port, unsigned baud, std::uint32_t duration_s,
                                        const LinkOpener& open = link::open_link, model::NodeId target = 0);

// Lets the tag at `port`, or another one as of identify_node(), give its slot back and poll no more until it
// is configured anew or starts again.
[[nodiscard]] NodeOutcome let_leave(const std::string& port, unsigned baud, model::NodeId target = 0,
                                    const LinkOpener& open = link::open_link);

// What a place in a tag's POLL is worth for an anchor: 100 as for those that are not named, 0: only where
// there is room.
struct AnchorHint {
  model::NodeId anchor = 0;
  std::uint8_t weight = 100;
};
inline constexpr std::size_t kMaxAnchorHints = std::extent_v<decltype(groma_AnchorPreference::ids)>;
// Gives a tag, as of let_leave(), at most kMaxAnchorHints in the place of those that it had.
[[nodiscard]] NodeOutcome hint_anchors(const std::string& port, unsigned baud,
                                       const std::vector<AnchorHint>& hints, model::NodeId target = 0,
                                       const LinkOpener& open = link::open_link);

// What the node tells of itself: its hello, and what it has counted.
struct NodeReport {
  NodeOutcome outcome;
  std::optional<groma_Counters> counters;
};
[[nodiscard]] NodeReport ask_node(const std::string& port, unsigned baud, model::NodeId target = 0,
                                  const LinkOpener& open = link::open_link);

// One anchor's ranges to others.
struct SurveyedPair {
  model::NodeId from = 0;
  model::NodeId to = 0;
  double range_m = 0.0;  // mean; antenna delays applied once, pair bias not
  double sigma_m = 0.0;  // standard deviation of one
  std::uint32_t count = 0;
};
struct SurveyOutcome {
  NodeOutcome outcome;
  std::vector<SurveyedPair> pairs;
};
// Lets `anchor` range to the anchors around it in the slot of the tag at `port`, 1 to 200 times.
[[nodiscard]] SurveyOutcome survey_from(const std::string& port, unsigned baud, model::NodeId anchor,
                                        std::uint16_t exchanges, const LinkOpener& open = link::open_link);

// "tag", "anchor" or "unconfigured".
[[nodiscard]] const char* role_word(groma_Role role);

}  // namespace groma::provision
