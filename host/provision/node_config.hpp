// Derives a node's configuration from the settings common to its site.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "firmware/core/mac/superframe.hpp"
#include "groma.pb.h"
#include "host/model/types.hpp"

namespace groma::provision {

// Of AES-128.
using NetworkKey = std::array<std::uint8_t, 16>;

// The common settings of a site's nodes. For the bounds see node::fault_of().
struct SiteSettings {
  std::uint16_t network_id = 0;
  unsigned preamble_symbols = 128;  // 64, 128 or 256
  std::uint32_t epoch = 1;
  model::NodeId master_id = 0;
  std::vector<model::NodeId>
      backup_ids;                      // anchors that relay the beacon and take over from the master, by rank
  std::vector<model::NodeId> tag_ids;  // one slot each, in this order, unless tag_slots is given
  std::vector<std::uint8_t> tag_slots;    // the slot of each of tag_ids; empty: in order
  std::vector<model::NodeId> anchor_ids;  // tried first by a tag, in this order
  std::uint32_t slots = 0;                // in one superframe; 0: one a tag
  std::uint32_t responses = 0;            // anchors that a POLL names at most; 0: all, up to 16
  groma_RangingMethod method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  std::uint32_t turn_round_us = mac::kUsualTurnaround_us;
  std::uint32_t response_gap_us = 0;  // 0: mac::usual_gap_us()
  std::uint32_t guard_us = mac::kUsualGuard_us;
  bool arm_ahead = false;  // tags arm the receiver for the next RESPONSE before reading the last one
  std::uint32_t transmit_antenna_delay_dtu = 0;  // 0: the chip's own; likewise the next
  std::uint32_t receive_antenna_delay_dtu = 0;
  std::uint32_t transmit_power = 0;  // TX_POWER register; 0: the firmware's default
  bool report_raw_stamps = false;
  bool correct_temperature = false;  // correct ranges for both chips' temperature and supply
  bool correct_power_bias = false;   // correct ranges for receive power
  groma_Link link = groma_Link_LINK_UART;
  std::uint32_t can_nominal_bit_per_s = 0;  // 0: the firmware's default; likewise the next
  std::uint32_t can_data_bit_per_s = 0;
  std::optional<NetworkKey> network_key;  // if given, each frame carries a MIC
};

// The default back-ups: the first anchors except the master.
inline constexpr std::size_t kDefaultBackups = 2;
[[nodiscard]] std::vector<model::NodeId> first_backups(const SiteSettings& site,
                                                       std::size_t count = kDefaultBackups);

// The configuration of one node. Ids beyond the capacity of a schedule are left out. node::fault_of() checks
// whether a node would accept the result.
[[nodiscard]] groma_Config config_of(const SiteSettings& site, groma_Role role, model::NodeId id);

// Where two configurations differ: "network_id: 1, not 2; schedule.epoch: 3, not 4", values of `is` first;
// empty if all fields are equal.
[[nodiscard]] std::string differences(const groma_Config& is, const groma_Config& should_be);

}  // namespace groma::provision
