// Reads MCAP files (version 0 of the format) from begin to end: a file whose end is missing gives the
// messages before it, and damage costs the records that it hit. Of the summary only the definitions of
// channels are used, in case that those among the messages are damaged. Chunks may be compressed by zstd or
// lz4.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <istream>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

namespace groma::mcap {

struct ChannelSchema {
  std::string name;
  std::string encoding;
  std::string data;
};

struct Channel {
  std::string topic;
  std::string message_encoding;
  // Shared, because many channels may have one long schema; all texts are empty if there is none. Never null.
  std::shared_ptr<const ChannelSchema> schema;
  std::uint64_t messages = 0;
};

struct Content {
  std::map<std::uint16_t, Channel> channels;
  std::size_t damaged = 0;   // chunks and records that were skipped
  std::string first_damage;  // such as "the chunk at byte 1234: its checksum is wrong"; empty: none
  bool is_complete = false;  // false: the file ends before its end record
  std::uint64_t end = 0;     // byte after the last record that is there, if the file is not complete
};

// The view is valid during the call.
using TakeMessage =
    std::function<void(std::uint16_t channel, std::uint64_t log_time_ns, std::string_view data)>;

// None: the file is no MCAP file. `file` is read from its current position.
[[nodiscard]] std::optional<Content> read(std::istream& file, const TakeMessage& take);

// The content of one zstd frame that states its size; none if it is damaged or longer than 512 MiB.
[[nodiscard]] std::optional<std::string> decompress_zstd(std::string_view frame);

}  // namespace groma::mcap
