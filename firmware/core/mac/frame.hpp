// What goes over the air: IEEE 802.15.4 data frames with short addresses, one type byte, and a body,
// little-endian. The frame check is the chip's.
//
//   FCF 0x8841 (2)  sequence (1)  network (2)  destination (2)  source (2)  type (1)  body  [code (8)]
//
//   BEACON    superframe (4)  session (8)  epoch (4)  schedule hash (4)  master (2)  hop (1)  age (1)
//             lateness (2)  flags (1)  slots (1)  holders (2 each)  [welcomed (2)  nonce (8)]
//   POLL      exchange (2)  superframe (4)  slot (1)  count (1)  anchor ids in the order of answers (2 each)
//   RESPONSE  exchange (2)  reply interval (4)  flags (1)  closed exchange (2)  closing interval (5)
//             temperature (1)  supply (1)
//   FINAL     exchange (2)
//   JOIN      origin (2)  nonce (8)  flags (1)
//   DATA      origin (2)  target (2)  message (1)  fragment (1)  fragments (1)  flags (1)  payload
//
// BEACON, JOIN and DATA fit the control slots (kMaxControlBytes). The type byte's top bit says that a code
// follows the body: see security.hpp.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <variant>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

inline constexpr std::uint16_t kNobody = 0;
inline constexpr std::uint16_t kBroadcast = 0xFFFF;
inline constexpr std::size_t kMaxAnchors = 16;  // in one POLL
inline constexpr std::size_t kMaxTags = 16;     // slots in one superframe
inline constexpr std::size_t kMaxDataBytes = 48;

enum class FrameType : std::uint8_t {
  kBeacon = 1,
  kPoll = 2,
  kResponse = 3,
  kFinal = 4,
  kJoin = 5,
  kData = 6
};
inline constexpr std::uint8_t kSecuredFlag = 0x80;  // of the type byte

// In answer to a JOIN: whoever sent that nonce knows now that this frame is fresh.
struct Welcome {
  std::uint16_t id = kNobody;
  std::uint64_t nonce = 0;
  friend bool operator==(const Welcome&, const Welcome&) = default;
};

// The master's, at the start of a superframe, and the ranked back-ups' that relay it.
struct Beacon {
  std::uint32_t superframe = 0;
  std::uint64_t session =
      0;  // unique to each time that a master began to count: its id, its boots, its starts
  std::uint32_t epoch = 0;
  std::uint32_t schedule_hash = 0;
  std::uint16_t master = kNobody;  // who leads now
  std::uint8_t hop = 0;            // 0: the master's own
  std::uint8_t age = 0;            // superframes since what this tells left the master; saturates
  // How much later than its place in the superframe the RMARKER leaves the antenna, ticks of the network's
  // time: the transmit grid's and the relay's rounding.
  std::int16_t lateness_dtu = 0;
  // The network dissolves: its nodes look for another one.
  bool dissolving = false;
  bool shared = false;  // sent in the shared slot: its place is there, not in the beacon's
  // The master's: its nodes are to be quiet for the rest of this superframe, and to listen for others. A
  // relay's, in the shared slot: asks the master for such a superframe.
  bool quiet = false;
  // With `shared`: sent in the shared slot of another session, whose nodes are to come over. `place` tells
  // where in its own superframe that is, ticks of the network's time.
  bool invitation = false;
  ranging::Ticks place{};  // 0 to 2^40 - 1
  std::uint8_t slots = 0;
  std::array<std::uint16_t, kMaxTags> holders{};  // who may poll in each slot; kNobody: free
  std::optional<Welcome> welcome{};
  friend bool operator==(const Beacon&, const Beacon&) = default;
};

// A tag's, to all anchors that it names.
struct Poll {
  std::uint16_t exchange = 0;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;
  std::uint8_t count = 0;
  std::array<std::uint16_t, kMaxAnchors> anchors{};
  friend bool operator==(const Poll&, const Poll&) = default;
};

// Of a node's chip: what its SAR converter shows, as signed degrees C and in 1/64 V. Nothing: not known.
struct Health {
  std::int8_t temperature_c = kUnknown;
  std::uint8_t supply_64ths_v = 0;  // 0: not known
  static constexpr std::int8_t kUnknown = -128;
  friend bool operator==(const Health&, const Health&) = default;
};

// An anchor's, to the tag that polled it.
struct Response {
  std::uint16_t exchange = 0;
  ranging::Ticks reply{};  // A2 - A1 of this exchange, known before the frame is sent; 0 to 2^32 - 1
  // A3 - A2 of the exchange before with this tag, where the anchor holds all that it takes; 0 to 2^40 - 1.
  bool closing_valid = false;
  std::uint16_t closed_exchange = 0;
  ranging::Ticks closing{};
  Health health{};
  friend bool operator==(const Response&, const Response&) = default;
};

// A tag's, to the anchors that it polled.
struct Final {
  std::uint16_t exchange = 0;
  friend bool operator==(const Final&, const Final&) = default;
};

// In a shared slot: a node that is new makes itself known, and asks for a slot or for a Welcome.
struct Join {
  std::uint16_t origin = 0;  // who joins; another than the frame's source where it was passed on
  std::uint64_t nonce = 0;   // unlike all before
  bool tag = false;
  bool wants_slot = false;
  bool wants_welcome = false;
  bool leaving = false;  // gives its slot back
  friend bool operator==(const Join&, const Join&) = default;
};

// In a shared slot: a piece of a message of the host link's protocol, or the word that one has come.
struct Data {
  std::uint16_t origin = 0;
  std::uint16_t target = 0;
  std::uint8_t message = 0;   // counts the origin's messages
  std::uint8_t fragment = 0;  // of `fragments`
  std::uint8_t fragments = 0;
  bool acknowledgement = false;
  bool to_host = false;
  bool asks = false;           // for an acknowledgement now
  std::uint8_t hops_left = 0;  // how often it may still be passed on, 0 to 3
  std::uint8_t round = 0;      // counts how often this was sent, modulo 8: each is passed on once
  std::uint8_t size = 0;
  std::array<std::uint8_t, kMaxDataBytes> payload{};
  friend bool operator==(const Data&, const Data&) = default;
};

using Body = std::variant<Beacon, Poll, Response, Final, Join, Data>;

struct Frame {
  std::uint8_t sequence = 0;
  std::uint16_t network = 0;
  std::uint16_t destination = 0;
  std::uint16_t source = 0;
  bool secured = false;  // the body was or will be followed by a code
  Body body{};
  friend bool operator==(const Frame&, const Frame&) = default;
};

enum class ParseError : std::uint8_t {
  kForeign,    // no data frame of this kind: another system's
  kMalformed,  // ours by its header, but not by its type, length or content
};

struct ParseResult {
  std::optional<Frame> frame{};
  ParseError error = ParseError::kForeign;  // where there is no frame
};

// Of a secured frame the code is skipped, not checked.
[[nodiscard]] ParseResult parse(std::span<const std::uint8_t> bytes) noexcept;
// The same without a copy; nothing: `frame`, a new one, holds it. Otherwise it holds anything.
[[nodiscard]] std::optional<ParseError> parse(std::span<const std::uint8_t> bytes, Frame& frame) noexcept;

// As far as its type byte tells: for who has no time to parse.
[[nodiscard]] bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept;

// A frame's bytes, without the frame check.
class FrameBytes {
 public:
  [[nodiscard]] std::span<const std::uint8_t> bytes() const noexcept { return std::span(data_).first(size_); }
  // The last kCodeBytes of a secured frame, zeros after serialize().
  [[nodiscard]] std::span<std::uint8_t> code() noexcept;

 private:
  friend class FrameWriter;
  std::array<std::uint8_t, dw1000::kMaxFrameBytes - dw1000::kFrameCheckBytes> data_{};
  std::size_t size_ = 0;
};

// A POLL's count is at most kMaxAnchors, a DATA's size at most kMaxDataBytes, and intervals are within their
// bounds.
[[nodiscard]] FrameBytes serialize(const Frame& frame) noexcept;
// The same without a copy.
void serialize(const Frame& frame, FrameBytes& out) noexcept;

// Bytes on the air, frame check included; a code of a secured frame comes on top.
inline constexpr std::size_t kCodeBytes = 8;
inline constexpr std::size_t kHeaderBytes = 10;
[[nodiscard]] constexpr std::size_t beacon_bytes(std::size_t slots, bool welcome) noexcept {
  return kHeaderBytes + 28 + 2 * slots + (welcome ? 10 : 0) + dw1000::kFrameCheckBytes;
}
// The largest of what is sent in a beacon's or a shared slot.
inline constexpr std::size_t kMaxControlBytes = beacon_bytes(kMaxTags, true);
inline constexpr std::size_t kResponseBytes = kHeaderBytes + 16 + dw1000::kFrameCheckBytes;
inline constexpr std::size_t kFinalBytes = kHeaderBytes + 2 + dw1000::kFrameCheckBytes;
inline constexpr std::size_t kJoinBytes = kHeaderBytes + 11 + dw1000::kFrameCheckBytes;
[[nodiscard]] constexpr std::size_t data_bytes(std::size_t payload) noexcept {
  return kHeaderBytes + 8 + payload + dw1000::kFrameCheckBytes;
}
static_assert(data_bytes(kMaxDataBytes) <= kMaxControlBytes);
[[nodiscard]] constexpr std::size_t poll_bytes(std::size_t anchors) noexcept {
  return kHeaderBytes + 8 + 2 * anchors + dw1000::kFrameCheckBytes;
}

}  // namespace groma::mac
