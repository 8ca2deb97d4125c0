// Opens a node's link without gromad, and listens for a moment.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "host/daemon/config.hpp"
#include "host/link/byte_link.hpp"
#include "host/model/types.hpp"

namespace groma::doctor {

// What a node reported of itself.
struct NodeFacts {
  std::optional<model::NodeId> id{};
  std::string role{};  // "tag", "anchor", "unconfigured"; empty: not known
  std::optional<std::uint32_t> network_id{};
  std::string version{};
  std::string radio_error{};
  std::string sync{};  // "locked", "coasting", "searching"; empty: not known
};

struct LinkFacts {
  link::LinkError error{};   // why it is not open
  std::uint64_t frames = 0;  // intact ones
  std::uint64_t bad = 0;     // damaged frames, and bytes that belong to none
  std::uint64_t ranges = 0;
  double listened_s = 0.0;  // 0: the link was only opened
  unsigned works_at = 0;    // another bit rate at which frames came; 0: none
  std::optional<double> round_trip_s{};
  NodeFacts node{};
};

// `listens`: else it is only opened. Requests the node's hello, and tries other bit rates if bytes come but
// no frame.
[[nodiscard]] LinkFacts probe_link(const daemon::NodeLink& node, bool listens);

}  // namespace groma::doctor
