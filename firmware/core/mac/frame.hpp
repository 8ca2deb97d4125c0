// The frames on the air: IEEE 802.15.4 data frames with short addresses, one type byte and a body,
// little-endian. docs/reference/air.md specifies their bytes. BEACON, JOIN and DATA fit the control slots
// (kMaxControlBytes). The type byte's top bit says that a MIC follows the body: see frame_authenticator.hpp.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <variant>

#include "firmware/core/radio/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

inline constexpr std::uint16_t kNobody = 0;
inline constexpr std::uint16_t kBroadcast = 0xFFFF;
inline constexpr std::size_t kMaxAnchors = 16;  // in one POLL
inline constexpr std::size_t kMaxTags = 16;     // slots in one superframe
inline constexpr std::size_t kMaxDataBytes = 48;

enum class FrameType : std::uint8_t { kBeacon = 1, kPoll, kResponse, kFinal, kJoin, kData };
inline constexpr std::uint8_t kSecuredFlag = 0x80;  // of the type byte

// Response to the challenge in a JOIN: repeats the nonce, which proves to its sender that this frame is no
// replay.
struct ChallengeResponse {
  std::uint16_t id = kNobody;
  std::uint64_t nonce = 0;
  friend bool operator==(const ChallengeResponse&, const ChallengeResponse&) = default;
};

// Sent by the master at the start of a superframe, and relayed by the back-ups.
struct Beacon {
  std::uint32_t superframe = 0;
  std::uint64_t session = 0;  // unique: starter's id and boot count, and a count within the boot
  std::uint32_t epoch = 0;
  std::uint32_t schedule_hash = 0;
  std::uint16_t master = kNobody;  // the acting master
  std::uint8_t hop = 0;            // 0: the master's own
  std::uint8_t age = 0;            // superframes since the master sent this information; saturates at 255
  // Offset of the RMARKER from its nominal place in the superframe, in ticks of network time. It results from
  // rounding to the transmit grid, so it is -511 to 0.
  std::int16_t tx_offset_dtu = 0;
  // The master gives up this session: its nodes search for another one.
  bool dissolving = false;
  bool shared = false;  // sent in the shared slot, not in the beacon slot
  // From the master: its nodes stop transmitting for the rest of this superframe and listen for other
  // networks. From a relay in the shared slot: requests such a superframe from the master.
  bool quiet = false;
  // With `shared`: a merge request, sent in the shared slot of another session, whose nodes should join this
  // one. `place` is the RMARKER's place in this session's superframe, in ticks of network time.
  bool merge_request = false;
  Ticks place{};  // 0 to 2^40 - 1
  std::uint8_t slots = 0;
  std::array<std::uint16_t, kMaxTags> owners{};  // of each slot; kNobody: free
  std::optional<ChallengeResponse> challenge_response{};
  friend bool operator==(const Beacon&, const Beacon&) = default;
};

// The superframe in which the master sent the content of a beacon, direct or relayed.
[[nodiscard]] constexpr std::uint32_t origin_of(const Beacon& beacon) noexcept {
  return beacon.superframe - beacon.age;
}
// The number of superframes from `b` to `a`; correct across the number's wrap.
[[nodiscard]] constexpr std::int32_t since(std::uint32_t a, std::uint32_t b) noexcept {
  return static_cast<std::int32_t>(a - b);
}

// Sent by a tag, or by an anchor that surveys, to all anchors that it names.
struct Poll {
  std::uint16_t exchange = 0;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;  // 0 to 127
  bool lent = false;      // the sender is not the slot's owner, who lent it the slot
  std::uint8_t count = 0;
  std::array<std::uint16_t, kMaxAnchors> anchors{};
  friend bool operator==(const Poll&, const Poll&) = default;
};

// The readings of a node's SAR converter, rounded to degrees C and 1/64 V.
struct Health {
  std::int8_t temperature_c = kUnknown;
  std::uint8_t supply_64ths_v = 0;  // 0: not known
  static constexpr std::int8_t kUnknown = -128;
  friend bool operator==(const Health&, const Health&) = default;
};

// Sent by an anchor to the tag that polled it.
struct Response {
  std::uint16_t exchange = 0;
  Ticks reply{};  // A2 - A1 of this exchange, known before the frame is sent; 0 to 2^32 - 1
  // A3 - A2 of the previous exchange with this tag, if the anchor has all of its timestamps; 0 to 2^40 - 1.
  bool closing_valid = false;
  std::uint16_t closed_exchange = 0;
  Ticks closing{};
  Health health{};
  friend bool operator==(const Response&, const Response&) = default;
};

// Sent by a tag to the anchors that it polled.
struct Final {
  std::uint16_t exchange = 0;
  friend bool operator==(const Final&, const Final&) = default;
};

// Sent in a shared slot by a new node: announces it, and requests a slot or a ChallengeResponse.
struct Join {
  std::uint16_t origin = 0;  // the joining node; differs from the frame's source if relayed
  std::uint64_t nonce = 0;   // never used before
  bool tag = false;
  bool wants_slot = false;
  bool wants_challenge_response = false;
  bool leaving = false;  // gives up its slot
  friend bool operator==(const Join&, const Join&) = default;
};

// Sent in a shared slot: a fragment of a message of the host link's protocol, or an acknowledgement.
struct Data {
  std::uint16_t origin = 0;
  std::uint16_t target = 0;
  std::uint8_t message = 0;   // counts the origin's messages
  std::uint8_t fragment = 0;  // of `fragments`
  std::uint8_t fragments = 0;
  bool acknowledgement = false;
  bool to_host = false;
  bool asks = false;           // requests an acknowledgement now
  std::uint8_t hops_left = 0;  // remaining relay hops, 0 to 3
  std::uint8_t round = 0;      // counts transmissions modulo 8, so that a relay recognizes each
  std::uint8_t size = 0;
  std::array<std::uint8_t, kMaxDataBytes> payload{};
  friend bool operator==(const Data&, const Data&) = default;
};

using Body = std::variant<Beacon, Poll, Response, Final, Join, Data>;

// The JOIN that is a challenge, or null.
[[nodiscard]] inline const Join* challenge_of(const Body& body) noexcept {
  const auto* join = std::get_if<Join>(&body);
  return join != nullptr && join->wants_challenge_response ? join : nullptr;
}

struct Frame {
  std::uint8_t sequence = 0;
  std::uint16_t network = 0;
  std::uint16_t destination = 0;
  std::uint16_t source = 0;
  bool secured = false;  // a MIC follows the body
  Body body{};
  friend bool operator==(const Frame&, const Frame&) = default;
};

enum class ParseError : std::uint8_t {
  kForeign,    // not a data frame of this kind: another system's
  kMalformed,  // this protocol's header, but a wrong type, length or content
};

// Parses into `frame`, which must be default-constructed; skips the MIC of a secured frame without checking
// it. Returns nothing on success; on an error `frame` is unspecified.
[[nodiscard]] std::optional<ParseError> parse(std::span<const std::uint8_t> bytes, Frame& frame) noexcept;

// Checks the type byte only, for callers without time to parse.
[[nodiscard]] bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept;

// A frame's bytes, without the frame check.
class FrameBytes {
 public:
  [[nodiscard]] std::span<const std::uint8_t> bytes() const noexcept { return std::span(data_).first(size_); }
  // The MIC of a secured frame, its last kCodeBytes; serialize() sets it to zeros.
  [[nodiscard]] std::span<std::uint8_t> code() noexcept;

 private:
  friend void serialize(const Frame& frame, FrameBytes& out) noexcept;
  std::array<std::uint8_t, radio::kMaxFrameBytes - radio::kFrameCheckBytes> data_{};
  std::size_t size_ = 0;
};

// A POLL's count must be at most kMaxAnchors, a DATA's size at most kMaxDataBytes, and intervals within their
// bounds.
void serialize(const Frame& frame, FrameBytes& out) noexcept;

// Bytes on the air, including the frame check but not the MIC of a secured frame.
inline constexpr std::size_t kCodeBytes = 8;
inline constexpr std::size_t kHeaderBytes = 10;
[[nodiscard]] constexpr std::size_t beacon_bytes(std::size_t slots, bool challenge_response) noexcept {
  return kHeaderBytes + 28 + 2 * slots + (challenge_response ? 10 : 0) + radio::kFrameCheckBytes;
}
// The largest frame in a beacon slot or a shared slot.
inline constexpr std::size_t kMaxControlBytes = beacon_bytes(kMaxTags, true);
inline constexpr std::size_t kResponseBytes = kHeaderBytes + 16 + radio::kFrameCheckBytes;
inline constexpr std::size_t kFinalBytes = kHeaderBytes + 2 + radio::kFrameCheckBytes;
inline constexpr std::size_t kJoinBytes = kHeaderBytes + 11 + radio::kFrameCheckBytes;
[[nodiscard]] constexpr std::size_t data_bytes(std::size_t payload) noexcept {
  return kHeaderBytes + 8 + payload + radio::kFrameCheckBytes;
}
static_assert(data_bytes(kMaxDataBytes) <= kMaxControlBytes);
[[nodiscard]] constexpr std::size_t poll_bytes(std::size_t anchors) noexcept {
  return kHeaderBytes + 8 + 2 * anchors + radio::kFrameCheckBytes;
}

}  // namespace groma::mac
