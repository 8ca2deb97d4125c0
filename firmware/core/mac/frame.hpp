// What goes over the air: IEEE 802.15.4 data frames with short addresses, one type byte, and a body of fixed
// layout, little-endian. The frame check is the chip's.
//
//   FCF 0x8841 (2)  sequence (1)  network (2)  destination (2)  source (2)  type (1)  body
//
//   BEACON    superframe (4)  epoch (4)  schedule hash (4)
//   POLL      exchange (2)  superframe (4)  slot (1)  count (1)  anchor ids in the order of answers (2 each)
//   RESPONSE  exchange (2)  reply interval (4)  flags (1)  closed exchange (2)  closing interval (5)
//   FINAL     exchange (2)
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

inline constexpr std::uint16_t kBroadcast = 0xFFFF;
inline constexpr std::size_t kMaxAnchors = 16;  // in one POLL
inline constexpr std::size_t kMaxTags = 16;     // in one superframe

// The master's, at the start of a superframe.
struct Beacon {
  std::uint32_t superframe = 0;
  std::uint32_t epoch = 0;
  std::uint32_t schedule_hash = 0;
};

// A tag's, to all anchors that it names.
struct Poll {
  std::uint16_t exchange = 0;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;
  std::uint8_t count = 0;
  std::array<std::uint16_t, kMaxAnchors> anchors{};
};

// An anchor's, to the tag that polled it.
struct Response {
  std::uint16_t exchange = 0;
  ranging::Ticks reply{};  // A2 - A1 of this exchange, known before the frame is sent; 0 to 2^32 - 1
  // A3 - A2 of the exchange before with this tag, where the anchor holds all that it takes; 0 to 2^40 - 1.
  bool closing_valid = false;
  std::uint16_t closed_exchange = 0;
  ranging::Ticks closing{};
};

// A tag's, to the anchors that it polled.
struct Final {
  std::uint16_t exchange = 0;
};

using Body = std::variant<Beacon, Poll, Response, Final>;

struct Frame {
  std::uint8_t sequence = 0;
  std::uint16_t network = 0;
  std::uint16_t destination = 0;
  std::uint16_t source = 0;
  Body body{};
};

enum class ParseError : std::uint8_t {
  kForeign,    // no data frame of this kind: another system's
  kMalformed,  // ours by its header, but not by its type, length or content
};

struct ParseResult {
  std::optional<Frame> frame{};
  ParseError error = ParseError::kForeign;  // where there is no frame
};

[[nodiscard]] ParseResult parse(std::span<const std::uint8_t> bytes) noexcept;

// A frame's bytes, without the frame check.
class FrameBytes {
 public:
  [[nodiscard]] std::span<const std::uint8_t> bytes() const noexcept { return std::span(data_).first(size_); }

 private:
  friend class FrameWriter;
  std::array<std::uint8_t, dw1000::kMaxFrameBytes - dw1000::kFrameCheckBytes> data_{};
  std::size_t size_ = 0;
};

// A POLL's count is at most kMaxAnchors and intervals are within their bounds.
[[nodiscard]] FrameBytes serialize(const Frame& frame) noexcept;

// Bytes on the air, frame check included.
inline constexpr std::size_t kHeaderBytes = 10;
inline constexpr std::size_t kBeaconBytes = kHeaderBytes + 12 + dw1000::kFrameCheckBytes;
inline constexpr std::size_t kResponseBytes = kHeaderBytes + 14 + dw1000::kFrameCheckBytes;
inline constexpr std::size_t kFinalBytes = kHeaderBytes + 2 + dw1000::kFrameCheckBytes;
[[nodiscard]] constexpr std::size_t poll_bytes(std::size_t anchors) noexcept {
  return kHeaderBytes + 8 + 2 * anchors + dw1000::kFrameCheckBytes;
}

}  // namespace groma::mac
