// A node's configuration from what is the same at each node of its site.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "groma.pb.h"
#include "host/model/types.hpp"

namespace groma::provision {

// Of AES-128.
using NetworkKey = std::array<std::uint8_t, 16>;

// What a site's nodes have in common. Bounds are the firmware's: see node::fault_of().
struct SiteSettings {
  std::uint16_t network_id = 0;
  unsigned preamble_symbols = 128;  // 64, 128 or 256
  std::uint32_t epoch = 1;
  model::NodeId master_id = 0;
  std::vector<model::NodeId>
      backup_ids;                      // anchors that relay the beacon and take over from the master, by rank
  std::vector<model::NodeId> tag_ids;  // one slot each, in this order, unless tag_slots says otherwise
  std::vector<std::uint8_t> tag_slots;    // of each of tag_ids; empty: in order
  std::vector<model::NodeId> anchor_ids;  // the ones that a tag tries first, in this order
  std::uint32_t slots = 0;                // in one superframe; 0: one a tag
  std::uint32_t responses = 0;            // anchors that a POLL names at most; 0: all, up to 16
  groma_RangingMethod method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  std::uint32_t turn_round_us = 300;
  std::uint32_t response_gap_us = 160;
  std::uint32_t guard_us = 30;
  std::uint32_t transmit_antenna_delay_dtu = 0;  // 0: the chip's own; so the next
  std::uint32_t receive_antenna_delay_dtu = 0;
  std::uint32_t transmit_power = 0;  // TX_POWER register; 0: the firmware's default
  bool report_raw_stamps = false;
  bool correct_temperature = false;  // ranges: by both chips' temperature and supply
  bool correct_power_bias = false;   // and by receive power
  groma_Link link = groma_Link_LINK_UART;
  std::uint32_t can_nominal_bit_per_s = 0;  // 0: the firmware's default; so the next
  std::uint32_t can_data_bit_per_s = 0;
  std::optional<NetworkKey> network_key;  // each frame carries a code
};

// Back-ups of a site that names none: the first of its anchors but for the master.
inline constexpr std::size_t kDefaultBackups = 2;
[[nodiscard]] std::vector<model::NodeId> first_backups(const SiteSettings& site,
                                                       std::size_t count = kDefaultBackups);

// The configuration of one of them. Of more ids than a schedule holds the rest is left out; whether a node
// would work by the result, node::fault_of() tells.
[[nodiscard]] groma_Config config_of(const SiteSettings& site, groma_Role role, model::NodeId id);

// Where two configurations differ: "network_id: 1, not 2; schedule.epoch: 3, not 4", the first's values
// first; empty where they are the same in every field.
[[nodiscard]] std::string differences(const groma_Config& is, const groma_Config& should_be);

}  // namespace groma::provision
