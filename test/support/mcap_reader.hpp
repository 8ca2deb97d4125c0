// Reads an MCAP file by its specification, without code of host/mcap, and requires what the specification
// lets a writer leave out: all messages in chunks, each index, the summary and its offsets, each checksum.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace groma::test {

struct McapSchema {
  std::string name;
  std::string encoding;
  std::string data;
  bool operator==(const McapSchema&) const = default;
};

struct McapChannel {
  std::uint16_t schema = 0;
  std::string topic;
  std::string encoding;
  std::map<std::string, std::string> metadata;
  bool operator==(const McapChannel&) const = default;
};

struct McapMessage {
  std::uint16_t channel = 0;
  std::uint32_t sequence = 0;
  std::uint64_t log_time_ns = 0;
  std::uint64_t publish_time_ns = 0;
  std::string data;
};

struct McapFile {
  std::string profile;
  std::string library;
  std::map<std::uint16_t, McapSchema> schemas;
  std::map<std::uint16_t, McapChannel> channels;
  std::vector<McapMessage> messages;  // in the order of the file
  std::size_t chunks = 0;

  [[nodiscard]] std::vector<McapMessage> of(const std::string& topic) const {
    std::vector<McapMessage> out;
    for (const McapMessage& message : messages)
      if (channels.at(message.channel).topic == topic) out.push_back(message);
    return out;
  }
};

// Fields of a record, one after the other; throws beyond its end.
class McapFields {
 public:
  explicit McapFields(std::string_view bytes) : bytes_(bytes) {}
  template <typename Number>
  Number get() {
    Number value{};
    std::memcpy(&value, take(sizeof value).data(), sizeof value);
    return value;
  }
  std::string_view take(std::size_t count) {
    if (count > bytes_.size() - at_) throw std::runtime_error("a field is longer than its record");
    at_ += count;
    return bytes_.substr(at_ - count, count);
  }
  std::string_view text() { return take(get<std::uint32_t>()); }
  [[nodiscard]] bool empty() const { return at_ == bytes_.size(); }
  [[nodiscard]] std::size_t at() const { return at_; }

 private:
  std::string_view bytes_;
  std::size_t at_ = 0;
};

// The CRC-32 of IEEE 802.3, bit by bit.
inline std::uint32_t mcap_crc(std::string_view bytes) {
  std::uint32_t crc = 0xFFFFFFFFU;
  for (const char byte : bytes) {
    crc ^= static_cast<std::uint8_t>(byte);
    for (int bit = 0; bit < 8; ++bit) crc = crc >> 1U ^ ((crc & 1U) != 0 ? 0xEDB88320U : 0U);
  }
  return ~crc;
}

class McapReader {
 public:
  // Throws if anything is wrong.
  static McapFile read(std::string_view bytes) {
    McapReader reader(bytes);
    reader.read_all();
    return std::move(reader.file_);
  }

 private:
  struct Record {
    std::uint8_t opcode = 0;
    std::size_t start = 0;
    std::size_t end = 0;
    std::string_view body;
  };
  struct Chunk {
    std::uint64_t start_ns = 0;
    std::uint64_t end_ns = 0;
    std::size_t start = 0;
    std::size_t end = 0;
    std::size_t size = 0;                                                                    // of its records
    std::map<std::uint16_t, std::vector<std::pair<std::uint64_t, std::uint64_t>>> messages;  // time, offset
    std::map<std::uint16_t, std::uint64_t> indices;  // offsets of their records
    std::size_t indices_end = 0;
  };

  explicit McapReader(std::string_view bytes) : bytes_(bytes) {}

  static void expect(bool holds, const char* fault) {
    if (!holds) throw std::runtime_error(fault);
  }

  static Record record_at(std::string_view bytes, std::size_t at) {
    McapFields fields(bytes.substr(at));
    Record record{.opcode = fields.get<std::uint8_t>(), .start = at, .end = 0, .body = {}};
    record.body = fields.take(fields.get<std::uint64_t>());
    record.end = at + fields.at();
    return record;
  }

  void read_all() {
    constexpr std::string_view kMagic{"\x89MCAP0\r\n", 8};
    expect(bytes_.starts_with(kMagic) && bytes_.ends_with(kMagic) && bytes_.size() > 2 * kMagic.size(),
           "magic");
    const std::size_t end = bytes_.size() - kMagic.size();
    std::size_t at = read_data(kMagic.size());
    const std::size_t summary_start = at;
    std::map<std::uint8_t, std::pair<std::uint64_t, std::uint64_t>> groups;  // start, length, by opcode
    Record record = record_at(bytes_, at);
    for (; record.opcode != 0x0E && record.opcode != 0x02; record = record_at(bytes_, at)) {
      const auto [group, is_new] = groups.try_emplace(record.opcode, at, 0);
      expect(is_new || group->second.first + group->second.second == at, "summary records are not grouped");
      group->second.second += record.end - record.start;
      read_summary(record);
      at = record.end;
    }
    const std::size_t offsets_start = at;
    for (; record.opcode == 0x0E; record = record_at(bytes_, at)) {
      McapFields fields(record.body);
      const auto opcode = fields.get<std::uint8_t>();
      const auto start = fields.get<std::uint64_t>();
      expect(groups.contains(opcode) && groups[opcode] == std::pair(start, fields.get<std::uint64_t>()),
             "summary offset");
      groups.erase(opcode);
      at = record.end;
    }
    expect(groups.empty(), "a group has no summary offset");
    expect(record.opcode == 0x02 && record.end == end && record.body.size() == 20, "footer");
    McapFields footer(record.body);
    expect(footer.get<std::uint64_t>() == summary_start, "summary start");
    expect(footer.get<std::uint64_t>() == offsets_start, "summary offset start");
    const std::size_t covered = record.end - 4 - summary_start;
    expect(footer.get<std::uint32_t>() == mcap_crc(bytes_.substr(summary_start, covered)), "summary CRC");
    expect(summary_schemas_ == file_.schemas && summary_channels_ == file_.channels,
           "summary: schemas and channels");
    expect(has_statistics_ && indexed_chunks_ == chunks_.size(), "summary: statistics and chunk indices");
  }

  // Returns the end of the data section.
  std::size_t read_data(std::size_t at) {
    Record record = record_at(bytes_, at);
    expect(record.opcode == 0x01, "header");
    McapFields header(record.body);
    file_.profile = header.text();
    file_.library = header.text();
    for (at = record.end;; at = record.end) {
      record = record_at(bytes_, at);
      if (record.opcode == 0x0F) break;
      if (record.opcode == 0x06) {
        read_chunk(record);
      } else if (record.opcode == 0x07) {
        read_message_index(record);
      } else {
        expect(record.opcode == 0x03 || record.opcode == 0x04,
               "a record that may not be in the data section");
        read_definition(record, file_.schemas, file_.channels);
      }
    }
    expect(McapFields(record.body).get<std::uint32_t>() == mcap_crc(bytes_.substr(0, at)), "data CRC");
    file_.chunks = chunks_.size();
    return record.end;
  }

  static void read_definition(const Record& record, std::map<std::uint16_t, McapSchema>& schemas,
                              std::map<std::uint16_t, McapChannel>& channels) {
    McapFields fields(record.body);
    const auto id = fields.get<std::uint16_t>();
    if (record.opcode == 0x03) {
      McapSchema schema;
      schema.name = fields.text();
      schema.encoding = fields.text();
      schema.data = fields.text();
      expect(id != 0 && schemas.try_emplace(id, schema).first->second == schema, "schema");
      return;
    }
    McapChannel channel;
    channel.schema = fields.get<std::uint16_t>();
    channel.topic = fields.text();
    channel.encoding = fields.text();
    for (McapFields pairs(fields.text()); !pairs.empty();) {
      const std::string key(pairs.text());
      channel.metadata[key] = pairs.text();
    }
    expect(schemas.contains(channel.schema), "the schema of a channel");
    expect(channels.try_emplace(id, channel).first->second == channel, "channel");
  }

  void read_chunk(const Record& record) {
    McapFields fields(record.body);
    Chunk& chunk = chunks_.emplace_back();
    chunk.start_ns = fields.get<std::uint64_t>();
    chunk.end_ns = fields.get<std::uint64_t>();
    chunk.start = record.start;
    chunk.end = chunk.indices_end = record.end;
    chunk.size = fields.get<std::uint64_t>();
    const auto crc = fields.get<std::uint32_t>();
    expect(fields.text().empty(), "compression");
    const std::string_view records = fields.take(fields.get<std::uint64_t>());
    expect(fields.empty() && records.size() == chunk.size && crc == mcap_crc(records), "chunk");
    std::uint64_t earliest_ns = ~std::uint64_t{0};
    std::uint64_t latest_ns = 0;
    for (std::size_t at = 0; at < records.size();) {
      const Record inner = record_at(records, at);
      expect(inner.opcode == 0x05, "a record that may not be in a chunk");
      McapFields of(inner.body);
      McapMessage& message = file_.messages.emplace_back();
      message.channel = of.get<std::uint16_t>();
      message.sequence = of.get<std::uint32_t>();
      message.log_time_ns = of.get<std::uint64_t>();
      message.publish_time_ns = of.get<std::uint64_t>();
      message.data = inner.body.substr(of.at());
      expect(file_.channels.contains(message.channel), "the channel of a message");
      chunk.messages[message.channel].emplace_back(message.log_time_ns, at);
      earliest_ns = std::min(earliest_ns, message.log_time_ns);
      latest_ns = std::max(latest_ns, message.log_time_ns);
      at = inner.end;
    }
    expect(chunk.start_ns == earliest_ns && chunk.end_ns == latest_ns, "times of a chunk");
  }

  void read_message_index(const Record& record) {
    expect(!chunks_.empty() && chunks_.back().indices_end == record.start, "message index after its chunk");
    Chunk& chunk = chunks_.back();
    McapFields fields(record.body);
    const auto channel = fields.get<std::uint16_t>();
    std::vector<std::pair<std::uint64_t, std::uint64_t>> entries;
    for (McapFields pairs(fields.text()); !pairs.empty();) {
      const auto time_ns = pairs.get<std::uint64_t>();
      entries.emplace_back(time_ns, pairs.get<std::uint64_t>());
    }
    expect(chunk.messages[channel] == entries, "message index");
    expect(chunk.indices.try_emplace(channel, record.start).second, "a second message index");
    chunk.indices_end = record.end;
  }

  void read_summary(const Record& record) {
    if (record.opcode == 0x08) return read_chunk_index(record);
    if (record.opcode == 0x0B) return read_statistics(record);
    expect(record.opcode == 0x03 || record.opcode == 0x04, "a record that may not be in the summary");
    read_definition(record, summary_schemas_, summary_channels_);
  }

  void read_chunk_index(const Record& record) {
    expect(indexed_chunks_ < chunks_.size(), "more chunk indices than chunks");
    const Chunk& chunk = chunks_[indexed_chunks_++];
    McapFields fields(record.body);
    expect(fields.get<std::uint64_t>() == chunk.start_ns && fields.get<std::uint64_t>() == chunk.end_ns,
           "chunk index: times");
    expect(fields.get<std::uint64_t>() == chunk.start, "chunk index: start");
    expect(fields.get<std::uint64_t>() == chunk.end - chunk.start, "chunk index: length");
    std::map<std::uint16_t, std::uint64_t> indices;
    for (McapFields pairs(fields.text()); !pairs.empty();) {
      const auto channel = pairs.get<std::uint16_t>();
      indices[channel] = pairs.get<std::uint64_t>();
    }
    expect(indices == chunk.indices && indices.size() == chunk.messages.size(),
           "chunk index: message indices");
    expect(fields.get<std::uint64_t>() == chunk.indices_end - chunk.end,
           "chunk index: length of message indices");
    expect(fields.text().empty(), "chunk index: compression");
    expect(fields.get<std::uint64_t>() == chunk.size && fields.get<std::uint64_t>() == chunk.size,
           "chunk index: sizes");
  }

  void read_statistics(const Record& record) {
    expect(!has_statistics_, "statistics twice");
    has_statistics_ = true;
    std::map<std::uint16_t, std::uint64_t> counts;
    for (const auto& [id, channel] : file_.channels) counts[id] = 0;
    std::uint64_t earliest_ns = file_.messages.empty() ? 0 : ~std::uint64_t{0};
    std::uint64_t latest_ns = 0;
    for (const McapMessage& message : file_.messages) {
      ++counts[message.channel];
      earliest_ns = std::min(earliest_ns, message.log_time_ns);
      latest_ns = std::max(latest_ns, message.log_time_ns);
    }
    McapFields fields(record.body);
    expect(fields.get<std::uint64_t>() == file_.messages.size(), "statistics: messages");
    expect(fields.get<std::uint16_t>() == file_.schemas.size(), "statistics: schemas");
    expect(fields.get<std::uint32_t>() == file_.channels.size(), "statistics: channels");
    expect(fields.get<std::uint32_t>() == 0 && fields.get<std::uint32_t>() == 0,
           "statistics: attachments, metadata");
    expect(fields.get<std::uint32_t>() == chunks_.size(), "statistics: chunks");
    expect(fields.get<std::uint64_t>() == earliest_ns && fields.get<std::uint64_t>() == latest_ns,
           "statistics: times");
    for (McapFields pairs(fields.text()); !pairs.empty();) {
      const auto channel = pairs.get<std::uint16_t>();
      expect(counts[channel] == pairs.get<std::uint64_t>(), "statistics: counts");
    }
  }

  std::string_view bytes_;
  McapFile file_;
  std::vector<Chunk> chunks_;
  std::map<std::uint16_t, McapSchema> summary_schemas_;
  std::map<std::uint16_t, McapChannel> summary_channels_;
  std::size_t indexed_chunks_ = 0;
  bool has_statistics_ = false;
};

}  // namespace groma::test
