// Reads MCAP files (version 0 of the format) from begin to end, without their summary: a file whose end is
// missing gives the messages before it. Chunks may be compressed by zstd or lz4.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <istream>
#include <map>
#include <optional>
#include <string>
#include <string_view>

namespace groma::mcap {

struct Channel {
  std::string topic;
  std::string message_encoding;
  std::string schema_name;  // empty, as the other two, if the channel has no schema
  std::string schema_encoding;
  std::string schema_data;
  std::uint64_t messages = 0;
};

struct Content {
  std::map<std::uint16_t, Channel> channels;
  std::size_t damaged = 0;   // chunks and records that were skipped: wrong checksum, length or compression
  bool is_complete = false;  // false: the file ends before its end record
};

// The view is valid during the call.
using TakeMessage =
    std::function<void(std::uint16_t channel, std::uint64_t log_time_ns, std::string_view data)>;

// None: the file is no MCAP file. `file` is read from its current position.
[[nodiscard]] std::optional<Content> read(std::istream& file, const TakeMessage& take);

// The content of one zstd frame that states its size; none if it is damaged or longer than 512 MiB.
[[nodiscard]] std::optional<std::string> decompress_zstd(std::string_view frame);

}  // namespace groma::mcap
