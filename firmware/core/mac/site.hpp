#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/radio/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "groma.pb.h"

namespace groma::mac {

class SignedPlaces;

// A node's identity, schedule and network key.
struct Site {
  std::uint16_t id = 0;
  // During a survey: the tag that lends its slot to this node. kNobody: this node polls in its own slot.
  std::uint16_t lender = 0;
  // Until when this tag lends its slot, on the node's clock; nothing: it polls. The node keeps it, so that a
  // radio recovery does not end the loan; outlives its users. Null: it never lends.
  const std::optional<std::uint64_t>* lent_until_us = nullptr;
  std::uint16_t network_id = 0;
  radio::Phy phy;  // the same at all nodes of the network, except for what the air does not show
  const groma_Schedule* schedule = nullptr;  // fault_of() is empty; outlives its users
  ranging::Ticks transmit_antenna_delay{};
  std::uint32_t boot_count = 0;  // number of this boot; with `sessions` it makes a session id unique
  bool on_trial = false;         // the schedule came over the air and is on trial
  // Sessions that this node has started in this boot; outlives its users. Null: none before, and in a network
  // with a key it starts none.
  std::uint16_t* sessions = nullptr;
  // In a network with a key: the 16 bytes of the key, the cipher, the number of nonces made in this boot, and
  // where it signed frames; all outlive their users. An empty key: an open network.
  std::span<const std::uint8_t> network_key{};
  security::BlockCipher* cipher = nullptr;
  std::uint32_t* nonces = nullptr;
  SignedPlaces* signed_places = nullptr;
};

}  // namespace groma::mac
