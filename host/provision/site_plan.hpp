// The site plan: a YAML file that says which nodes a site has, how they range, and by what each is reached.
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
  std::string port;       // for link::open_link(): where commands go; empty: not given
  model::NodeId via = 0;  // the node of the plan that passes commands on to it over the air; 0: none
  std::string via_port;   // that one's; empty: there is none
  std::string can_link;   // for link::open_link(): where it reports if it works on CAN; empty: it does not
  std::optional<std::uint8_t> slot;  // a tag's, where the plan names it
  std::string probe;                 // serial number of the debug probe that it hangs on; empty: not given
  groma_Config config = groma_Config_init_zero;  // without fault
};

struct SitePlan {
  std::filesystem::path path;
  unsigned baud = 1'000'000;       // bits per second of serial ports
  std::vector<PlannedNode> nodes;  // in the order of the file

  [[nodiscard]] const PlannedNode* find(model::NodeId id) const;
};

// Throws io::ConfigError with line and column, and what io::read_file() throws. Relative ports are taken from
// the plan's folder.
[[nodiscard]] SitePlan read_site_plan(const std::filesystem::path& path);

}  // namespace groma::provision
