// The byte stream of frame_codec.hpp over classic CAN and CAN FD: the ids of the CAN frames, and how the
// stream is divided into payloads.
//
// All ids are 29 bits:
//
//   28..24  0b10110, marks this protocol
//   23..17  0
//   16      0: from the node to its host, 1: from the host to the node
//   15..0   the node's id
//
// A payload holds the next bytes of the stream and nothing else: at most 8 on classic CAN, at most 64 on CAN
// FD. On CAN FD a payload is padded with zeros to the next valid length. A zero ends a frame of
// frame_codec.hpp and further zeros are ignored, so padding is allowed directly after the end of a frame and
// nowhere else. CAN keeps the order of payloads with one id. A lost payload damages its frame, which the
// frame's CRC detects.
//
// Freestanding: no heap, no exceptions, no library calls.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

namespace groma::wire {

enum class CanFormat : std::uint8_t { kClassic, kFd };
enum class CanDirection : std::uint8_t { kToHost, kToNode };

inline constexpr std::size_t kMaxClassicPayload = 8;
inline constexpr std::size_t kMaxFdPayload = 64;

// A data frame with an id of 29 bits.
struct CanFrame {
  std::uint32_t id = 0;
  CanFormat format = CanFormat::kClassic;
  bool bit_rate_switch = false;  // FD: the data phase at the data bit rate
  std::uint8_t size = 0;         // of the payload, in bytes; a valid length of the format
  std::array<std::uint8_t, kMaxFdPayload> data{};

  [[nodiscard]] std::span<const std::uint8_t> payload() const noexcept {
    return std::span<const std::uint8_t>(data).first(size);
  }
};

struct CanAddress {
  CanDirection direction = CanDirection::kToHost;
  std::uint16_t node = 0;
  friend constexpr bool operator==(const CanAddress&, const CanAddress&) noexcept = default;
};

// The fixed bits of an id. A receive filter compares these and the bits of the address.
inline constexpr std::uint32_t kCanIdBits = 0x1FFF'FFFF;
inline constexpr std::uint32_t kCanProtocol = 0b10110U << 24;
inline constexpr std::uint32_t kCanToNode = 1U << 16;

[[nodiscard]] constexpr std::uint32_t can_id(CanAddress address) noexcept {
  return kCanProtocol | (address.direction == CanDirection::kToNode ? kCanToNode : 0U) | address.node;
}

// Returns nothing if the id does not belong to this protocol.
[[nodiscard]] constexpr std::optional<CanAddress> can_address(std::uint32_t id) noexcept {
  if ((id & ~(kCanToNode | 0xFFFFU)) != kCanProtocol) return std::nullopt;
  return CanAddress{(id & kCanToNode) != 0 ? CanDirection::kToNode : CanDirection::kToHost,
                    static_cast<std::uint16_t>(id & 0xFFFFU)};
}

[[nodiscard]] constexpr std::size_t max_can_payload(CanFormat format) noexcept {
  return format == CanFormat::kFd ? kMaxFdPayload : kMaxClassicPayload;
}

// Payload lengths by data length code (ISO 11898-1, table 5); classic CAN has the first nine.
inline constexpr std::array<std::uint8_t, 16> kCanLengths{0, 1,  2,  3,  4,  5,  6,  7,
                                                          8, 12, 16, 20, 24, 32, 48, 64};

// The code of the shortest payload that holds `size` bytes, at most 64.
[[nodiscard]] constexpr std::uint8_t can_length_code(std::size_t size) noexcept {
  std::uint8_t code = 0;
  while (code < 15 && kCanLengths[code] < size) ++code;
  return code;
}

// Moves the next payload, as long as the format allows, from the start of `stream` to `out`. Returns how many
// bytes of the stream it took; 0 if the stream is empty. `stream` must end with a frame or have at least
// max_can_payload(format) bytes, because padding follows its last byte.
std::size_t cut_can_payload(std::span<const std::uint8_t> stream, CanFormat format, CanFrame& out) noexcept;

// The stream's bytes in a CAN frame: its payload if the frame's id is that of `address`, otherwise nothing.
[[nodiscard]] inline std::span<const std::uint8_t> stream_in(const CanFrame& frame,
                                                             CanAddress address) noexcept {
  if (frame.id != can_id(address)) return {};
  return frame.payload();
}

}  // namespace groma::wire
