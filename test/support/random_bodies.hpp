// Random frame bodies, from a seed, with any content that can be sent.
#pragma once

#include <cstddef>
#include <cstdint>
#include <random>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "test/support/frames.hpp"

namespace groma::mac {

class RandomBodies {
 public:
  explicit RandomBodies(std::uint64_t seed) : random_(seed) {}
  RandomBodies(const RandomBodies&) = delete;
  RandomBodies& operator=(const RandomBodies&) = delete;
  virtual ~RandomBodies() = default;

  std::size_t below(std::size_t bound) { return static_cast<std::size_t>(random_() % bound); }
  bool coin() { return random_() % 2 == 0; }
  template <class T>
  T word() {
    return static_cast<T>(random_());
  }
  // Draws every id in the bodies.
  virtual std::uint16_t somebody() { return word<std::uint16_t>(); }

  Beacon beacon() {
    Beacon body{.superframe = word<std::uint32_t>(),
                .session = random_(),
                .epoch = word<std::uint32_t>(),
                .schedule_hash = word<std::uint32_t>(),
                .master = somebody(),
                .hop = word<std::uint8_t>(),
                .age = word<std::uint8_t>(),
                .tx_offset_dtu = static_cast<std::int16_t>(word<std::uint16_t>()),
                .dissolving = coin(),
                .shared = coin(),
                .quiet = coin(),
                .merge_request = coin(),
                .slots = static_cast<std::uint8_t>(below(kMaxTags + 1))};
    if (body.merge_request) body.place = ranging::Ticks(static_cast<std::int64_t>(random_() >> 24));
    for (std::size_t i = 0; i < body.slots; ++i) body.owners[i] = somebody();
    if (coin()) body.challenge_response = ChallengeResponse{.id = somebody(), .nonce = random_()};
    return body;
  }
  Poll poll() {
    Poll body{.exchange = word<std::uint16_t>(),
              .superframe = word<std::uint32_t>(),
              .slot = static_cast<std::uint8_t>(below(0x80)),  // the top bit is `lent`
              .lent = coin(),
              .count = static_cast<std::uint8_t>(below(kMaxAnchors + 1))};
    for (std::size_t i = 0; i < body.count; ++i) body.anchors[i] = somebody();
    return body;
  }
  Response response() {
    return {.exchange = word<std::uint16_t>(),
            .reply = ranging::Ticks(word<std::uint32_t>()),
            .closing_valid = coin(),
            .closed_exchange = word<std::uint16_t>(),
            .closing = ranging::Ticks(static_cast<std::int64_t>(random_() >> 24)),
            .health = {.temperature_c = static_cast<std::int8_t>(word<std::uint8_t>()),
                       .supply_64ths_v = word<std::uint8_t>()}};
  }
  Final final() { return {.exchange = word<std::uint16_t>()}; }
  Join join() {
    return {.origin = somebody(),
            .nonce = random_(),
            .tag = coin(),
            .wants_slot = coin(),
            .wants_challenge_response = coin(),
            .leaving = coin()};
  }
  Data data() {
    const auto fragments = static_cast<std::uint8_t>(1 + below(255));
    Data body{.origin = somebody(),
              .target = somebody(),
              .message = word<std::uint8_t>(),
              .fragment = static_cast<std::uint8_t>(below(fragments)),
              .fragments = fragments,
              .acknowledgement = coin(),
              .to_host = coin(),
              .asks = coin(),
              .hops_left = static_cast<std::uint8_t>(below(4)),
              .round = static_cast<std::uint8_t>(below(8)),
              .size = static_cast<std::uint8_t>(below(kMaxDataBytes + 1))};
    for (std::size_t i = 0; i < body.size; ++i) body.payload[i] = word<std::uint8_t>();
    return body;
  }

 private:
  std::mt19937_64 random_;
};

}  // namespace groma::mac
