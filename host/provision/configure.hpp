// From a plan's configuration to a node that works by it. What has been done already is read from the node:
// whoever is interrupted repeats the whole, and what is done is left alone.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

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

[[nodiscard]] NodeOutcome configure_node(const PlannedNode& node, unsigned baud,
                                         const ConfigureOptions& options = {});

// Lets the node at `port` blink for so many seconds, 0 to 3600; 0 ends it.
[[nodiscard]] NodeOutcome identify_node(const std::string& port, unsigned baud, std::uint32_t duration_s,
                                        const LinkOpener& open = link::open_link);

// "tag", "anchor" or "unconfigured".
[[nodiscard]] const char* role_word(groma_Role role);

}  // namespace groma::provision
