#pragma once

#include <cstdint>
#include <span>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "groma.pb.h"

namespace groma::mac {

// A node's place in its site.
struct Site {
  std::uint16_t id = 0;
  std::uint16_t network_id = 0;
  dw1000::Preamble preamble = dw1000::Preamble::k128;
  const groma_Schedule* schedule = nullptr;  // one that check() has passed; outlives who goes by it
  ranging::Ticks transmit_antenna_delay{};
  std::uint32_t boot_count = 0;  // of this boot: together with `sessions` it makes a session's name unique
  bool on_trial = false;         // its schedule, which came over the air
  // Sessions that this node has founded in this boot; outlives who goes by it. Nothing: none before.
  std::uint16_t* sessions = nullptr;
  // Of a network with a key: 16 bytes, the cipher that they are for, and the nonces made in this boot; all
  // outlive who goes by it. No bytes: an open network.
  std::span<const std::uint8_t> network_key{};
  security::BlockCipher* cipher = nullptr;
  std::uint32_t* nonces = nullptr;
};

}  // namespace groma::mac
