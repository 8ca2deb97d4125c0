// What the reader and the writer share: the specification's constants.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string_view>

#include "proto/crc32.hpp"

namespace groma::mcap {

inline constexpr std::string_view kMagic{"\x89MCAP0\r\n", 8};

enum class Opcode : std::uint8_t {
  kNone = 0x00,  // of no record
  kHeader = 0x01,
  kFooter = 0x02,
  kSchema = 0x03,
  kChannel = 0x04,
  kMessage = 0x05,
  kChunk = 0x06,
  kMessageIndex = 0x07,
  kChunkIndex = 0x08,
  kStatistics = 0x0B,
  kMetadata = 0x0C,
  kSummaryOffset = 0x0E,
  kDataEnd = 0x0F,
};

// Opcode and length.
inline constexpr std::size_t kRecordHeadBytes = 1 + 8;

inline std::uint32_t crc_of(std::string_view bytes) {
  return wire::crc32({reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()});
}

}  // namespace groma::mcap
