// Writes MCAP files (version 0 of the format): chunked, indexed, with checksums, not compressed. The names of
// records and fields are those of the specification, github.com/foxglove/mcap, website/docs/spec.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace groma::mcap {

struct Schema {
  std::string_view name;
  std::string_view encoding;  // such as "protobuf" or "ros2msg"
  std::string_view data;
};

using Metadata = std::vector<std::pair<std::string_view, std::string_view>>;

// The file grows in memory; finish() returns it.
class Writer {
 public:
  // profile: a well-known one, such as "ros2", or empty. library: name and version of this program.
  Writer(std::string_view profile, std::string_view library);

  // Returns the channel's id. Schemas of the same name have to be equal; they are stored once.
  [[nodiscard]] std::uint16_t add_channel(std::string_view topic, std::string_view message_encoding,
                                          const Schema& schema, const Metadata& metadata = {});
  // channel: from add_channel(). time_ns: both log_time and publish_time; readers are faster if it ascends.
  void write(std::uint16_t channel, std::uint64_t time_ns, std::string_view message);
  // Closes the file and returns its bytes. Call it once, as the last function.
  [[nodiscard]] std::string finish();

  [[nodiscard]] std::size_t channels() const noexcept { return channels_.size(); }
  [[nodiscard]] std::uint64_t messages() const noexcept { return messages_; }

 private:
  struct Channel {
    std::uint64_t messages = 0;
    std::vector<std::pair<std::uint64_t, std::uint64_t>> chunk_index;  // log_time, offset in the chunk
  };
  // Earliest and latest log_time; zero without messages.
  struct TimeSpan {
    void add(std::uint64_t time_ns, bool is_first) noexcept;
    std::uint64_t start_ns = 0;
    std::uint64_t end_ns = 0;
  };
  // Records of one kind for the summary.
  struct Group {
    std::string records;
    std::uint32_t count = 0;
  };

  void close_chunk();
  [[nodiscard]] std::string statistics() const;

  std::string file_;
  std::string chunk_;  // records of the open chunk
  TimeSpan chunk_times_;
  TimeSpan times_;
  std::uint64_t messages_ = 0;
  std::map<std::string, std::uint16_t, std::less<>> schema_ids_;  // by name
  std::vector<Channel> channels_;                                 // by id
  Group schema_group_;
  Group channel_group_;
  Group chunk_index_group_;
};

}  // namespace groma::mcap
