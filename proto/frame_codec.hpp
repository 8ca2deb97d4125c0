// The frame that carries one NodeToHost or HostToNode message over UART, pty, socket or log file.
//
//   0x00  COBS( version | payload | CRC-32 of version and payload, little-endian )  0x00
//
// COBS (Cheshire and Baker, 1999) leaves no zero inside a frame. A zero therefore always ends a frame, and a
// decoder resynchronizes at the next zero, whatever came before. A frame also begins with a zero. That zero
// ends any garbage in front of the frame, such as the end of an interrupted frame or noise from plugging in a
// cable, so the garbage does not damage the frame.
//
// The CRC is that of crc32.hpp. Freestanding: no heap, no exceptions, no library calls.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "proto/crc32.hpp"

namespace groma::wire {

inline constexpr std::uint8_t kFrameVersion = 1;

// Holds the largest message of the schema (groma_NodeToHost_size), with reserve.
inline constexpr std::size_t kMaxPayload = 1472;

// Version and CRC.
inline constexpr std::size_t kFrameOverhead = 5;

// The most bytes on the wire for a payload of n bytes: COBS adds one byte for each 254 begun.
[[nodiscard]] constexpr std::size_t max_encoded_size(std::size_t n) noexcept {
  const std::size_t plain = n + kFrameOverhead;
  return 1 + plain + plain / 254 + 1 + 1;
}

// Writes one whole frame to the start of `out` and returns its length. Returns 0 if the payload is longer
// than kMaxPayload or `out` is shorter than max_encoded_size(payload.size()).
[[nodiscard]] std::size_t encode_frame(std::span<const std::uint8_t> payload,
                                       std::span<std::uint8_t> out) noexcept;

// Encodes a frame in steps, for callers that cannot spend the time at once.
class FrameWriter {
 public:
  // `out` must hold max_encoded_size() of all bytes that will be put.
  explicit FrameWriter(std::span<std::uint8_t> out) noexcept;
  void put(std::span<const std::uint8_t> payload) noexcept;
  // Returns the frame's length.
  [[nodiscard]] std::size_t finish() noexcept;

 private:
  void add(std::uint8_t byte) noexcept;

  std::uint8_t* out_;
  Crc32 crc_;
  std::size_t block_ = 1;  // where the open COBS block's code goes
  std::size_t end_ = 2;
};

// What a decoder has received since its construction. Bytes between two zeros that are not a frame count
// under one of the errors and under bytes_discarded.
struct FrameCounters {
  std::uint32_t frames = 0;
  std::uint32_t bytes_discarded = 0;
  std::uint32_t crc_errors = 0;
  std::uint32_t version_errors = 0;  // intact, but of an unsupported version
  std::uint32_t oversize = 0;        // longer than a frame can be
  std::uint32_t cobs_errors = 0;     // ended inside a COBS block
  std::uint32_t truncated = 0;       // shorter than a frame can be
};

// Finds frames in a byte stream, one byte at a time, in one buffer of kMaxPayload + 5 bytes.
class FrameDecoder {
 public:
  // Returns true if this byte completed a frame; payload() is then valid until the next call.
  bool push(std::uint8_t byte) noexcept;

  [[nodiscard]] std::span<const std::uint8_t> payload() const noexcept {
    return std::span<const std::uint8_t>(buffer_).subspan(1, payload_size_);
  }

  // Size on the wire of the last frame, including its opening and closing zeros; gives its transmission time.
  [[nodiscard]] std::size_t encoded_size() const noexcept { return encoded_size_; }

  [[nodiscard]] const FrameCounters& counters() const noexcept { return counters_; }

  // Discards an incomplete frame, as after reopening the link, and counts its bytes as discarded.
  void reset() noexcept;

 private:
  bool finish() noexcept;
  void store(std::uint8_t byte) noexcept;
  void begin() noexcept;

  std::array<std::uint8_t, kMaxPayload + kFrameOverhead> buffer_{};
  std::size_t size_ = 0;          // decoded so far
  std::size_t received_ = 0;      // encoded bytes since the last zero
  std::size_t payload_size_ = 0;  // of the last frame
  std::size_t encoded_size_ = 0;  // of the last frame
  std::uint8_t left_in_block_ = 0;
  bool zero_due_ = false;  // the previous block ends with a zero, unless the frame ends there
  bool overflow_ = false;
  FrameCounters counters_;
};

}  // namespace groma::wire
