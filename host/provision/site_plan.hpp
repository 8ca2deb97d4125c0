// The site plan: a YAML file with the nodes of a site, their ranging schedule and the port of each.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "groma.pb.h"
#include "host/model/types.hpp"
#include "host/provision/node_config.hpp"

namespace groma::provision {

struct PlannedNode {
  model::NodeId id = 0;
  groma_Role role = groma_Role_ROLE_UNCONFIGURED;
  std::string port;                  // path for link::open_link(), for commands; empty: not given
  model::NodeId via = 0;             // the node that passes commands on to this one over the air; 0: none
  std::string via_port;              // port of `via`; empty: none
  std::string can_link;              // path for link::open_link(), for reports on CAN; empty: not on CAN
  std::optional<std::uint8_t> slot;  // a tag's, if the plan names it
  std::string probe;                 // serial number of its debug probe; empty: not given
  groma_Config config = groma_Config_init_zero;  // passes node::fault_of()
};

struct SitePlan {
  std::filesystem::path path;
  unsigned baud = 1'000'000;       // bit rate of serial ports, in bit/s
  std::vector<PlannedNode> nodes;  // in the order of the file

  [[nodiscard]] const PlannedNode* find(model::NodeId id) const;
};

// Relative ports are resolved from the plan's folder. Throws io::ConfigError with line and column, and as
// io::read_configuration() does.
[[nodiscard]] SitePlan read_site_plan(const std::filesystem::path& path);

}  // namespace groma::provision
