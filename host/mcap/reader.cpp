#include "host/mcap/reader.hpp"

#include <fmt/format.h>
#include <lz4frame.h>
#include <zstd.h>

#include <algorithm>
#include <cstring>
#include <memory>
#include <span>
#include <utility>

#include "host/io/error.hpp"
#include "host/mcap/format.hpp"

namespace groma::mcap {

namespace {

// By hand: a chunk has about 1 MiB, or one message if that is longer.
constexpr std::uint64_t kMaxUncompressedBytes = std::uint64_t{512} << 20U;
// The same for any record, with the other fields of a chunk.
constexpr std::uint64_t kMaxRecordBytes = kMaxUncompressedBytes + (1U << 16U);
// By hand: what is beyond this ratio is damage. It bounds the memory that a few bytes can ask for.
constexpr std::uint64_t kMaxRatio = 1000;
constexpr std::uint64_t kSmallBytes = 1 << 20;

bool is_plausible(std::uint64_t size, std::uint64_t compressed_size) {
  return size <= kMaxUncompressedBytes && size <= kSmallBytes + kMaxRatio * compressed_size;
}

// Fields of a record, one after the other. Beyond the record's end they are empty and ok() is false.
class Fields {
 public:
  explicit Fields(std::string_view bytes) : rest_(bytes) {}

  template <typename Number>
  Number number() {
    Number value{};
    const std::string_view bytes = take(sizeof value);
    if (bytes.size() == sizeof value) std::memcpy(&value, bytes.data(), sizeof value);
    return value;
  }
  std::string_view take(std::uint64_t count) {
    if (count > rest_.size()) {
      ok_ = false;
      rest_ = {};
      return {};
    }
    const std::string_view bytes = rest_.substr(0, count);
    rest_.remove_prefix(count);
    return bytes;
  }
  std::string_view text() { return take(number<std::uint32_t>()); }
  [[nodiscard]] std::string_view rest() const { return rest_; }
  [[nodiscard]] bool ok() const { return ok_; }

 private:
  std::string_view rest_;
  bool ok_ = true;
};

std::optional<std::string> decompress_lz4(std::string_view bytes, std::uint64_t size) {
  LZ4F_dctx* raw = nullptr;
  if (LZ4F_isError(LZ4F_createDecompressionContext(&raw, LZ4F_VERSION)) != 0U) return std::nullopt;
  const std::unique_ptr<LZ4F_dctx, decltype(&LZ4F_freeDecompressionContext)> context(
      raw, &LZ4F_freeDecompressionContext);
  std::string out(size, '\0');
  std::size_t written = 0;
  while (!bytes.empty()) {
    std::size_t produced = out.size() - written;
    std::size_t consumed = bytes.size();
    const std::size_t more =
        LZ4F_decompress(context.get(), out.data() + written, &produced, bytes.data(), &consumed, nullptr);
    if (LZ4F_isError(more) != 0U || (produced == 0 && consumed == 0)) return std::nullopt;
    written += produced;
    bytes.remove_prefix(consumed);
    if (more == 0) break;
  }
  if (written != size || !bytes.empty()) return std::nullopt;
  return out;
}

std::optional<std::string> decompress_zstd(std::string_view bytes, std::uint64_t size) {
  std::string out(size, '\0');
  if (ZSTD_decompress(out.data(), out.size(), bytes.data(), bytes.size()) != size) return std::nullopt;
  return out;
}

class Reader {
 public:
  explicit Reader(const TakeMessage& take) : take_(take) {}

  void read(std::istream& file) {
    file.seekg(0, std::ios::end);
    const auto end = static_cast<std::uint64_t>(file.tellg());
    read_definitions_of_summary(file, end);
    file.clear();
    file.seekg(static_cast<std::streamoff>(kMagic.size()));
    std::string head(kRecordHeadBytes, '\0');
    std::string body;
    for (std::uint64_t at = kMagic.size();;) {
      content_.end = at;
      if (!file.read(head.data(), static_cast<std::streamsize>(head.size()))) return;
      Fields fields(head);
      const auto opcode = fields.number<Opcode>();
      const auto size = fields.number<std::uint64_t>();
      if (opcode == Opcode::kDataEnd || opcode == Opcode::kFooter) {
        content_.is_complete = true;
        return;
      }
      if (opcode == Opcode::kNone) return;  // zeros, which a loss of power leaves
      const std::uint64_t left = end - at - head.size();
      if (size > left && opcode != Opcode::kChunk) return;
      if (!is_read(opcode)) {
        file.seekg(static_cast<std::streamoff>(size), std::ios::cur);
      } else if (std::min(size, left) > kMaxRecordBytes) {
        add_damage(opcode, at, "it is longer than 512 MiB");
        if (size > left) return;
        file.seekg(static_cast<std::streamoff>(size), std::ios::cur);
      } else {
        body.resize(std::min(size, left));
        if (!file.read(body.data(), static_cast<std::streamsize>(body.size()))) return;
        if (size > left) return take_torn_chunk(body);
        const std::string problem = opcode == Opcode::kChunk ? take_chunk(body) : take_record(opcode, body);
        if (!problem.empty()) add_damage(opcode, at, problem);
      }
      at += head.size() + size;
    }
  }

  Content content() { return std::move(content_); }

 private:
  static constexpr std::string_view kTooShort = "it is too short";

  static bool is_read(Opcode opcode) {
    return opcode == Opcode::kSchema || opcode == Opcode::kChannel || opcode == Opcode::kMessage ||
           opcode == Opcode::kChunk;
  }

  void add_damage(Opcode opcode, std::uint64_t at, std::string_view problem) {
    if (content_.damaged++ == 0)
      content_.first_damage =
          fmt::format("the {} at byte {}: {}", opcode == Opcode::kChunk ? "chunk" : "record", at, problem);
  }

  // The end of the file leads to the summary, which repeats the schemas and channels.
  void read_definitions_of_summary(std::istream& file, std::uint64_t end) {
    constexpr std::size_t kFooterBytes = 8 + 8 + 4;
    const std::size_t tail_bytes = kRecordHeadBytes + kFooterBytes + kMagic.size();
    if (end < kMagic.size() + tail_bytes) return;
    const std::uint64_t footer_at = end - tail_bytes;
    const std::string tail = bytes_at(file, footer_at, tail_bytes);
    Fields fields(tail);
    const auto opcode = fields.number<Opcode>();
    const auto size = fields.number<std::uint64_t>();
    const auto summary_at = fields.number<std::uint64_t>();
    fields.number<std::uint64_t>();  // summary_offset_start
    const auto crc = fields.number<std::uint32_t>();
    if (!fields.ok() || opcode != Opcode::kFooter || size != kFooterBytes || fields.rest() != kMagic) return;
    if (summary_at < kMagic.size() || summary_at > footer_at || footer_at - summary_at > kMaxRecordBytes)
      return;
    const std::string summary = bytes_at(file, summary_at, footer_at - summary_at);
    const std::size_t covered_bytes = kRecordHeadBytes + 8 + 8;  // of the footer
    if (crc != 0 && crc != crc_of(summary + tail.substr(0, covered_bytes))) return;
    for (Fields rest(summary); !rest.rest().empty();) {
      const auto of = rest.number<Opcode>();
      const std::string_view record = rest.take(rest.number<std::uint64_t>());
      if (!rest.ok()) return;
      if (of == Opcode::kSchema || of == Opcode::kChannel) static_cast<void>(take_record(of, record));
    }
  }

  static std::string bytes_at(std::istream& file, std::uint64_t at, std::uint64_t size) {
    std::string bytes(size, '\0');
    file.seekg(static_cast<std::streamoff>(at));
    if (!file.read(bytes.data(), static_cast<std::streamsize>(size))) return {};
    return bytes;
  }

  // These return the problem; empty: none.
  std::string take_record(Opcode opcode, std::string_view body) {
    Fields fields(body);
    if (opcode == Opcode::kSchema) return take_schema(fields);
    if (opcode == Opcode::kChannel) return take_channel(fields);
    if (opcode == Opcode::kMessage) return take_message(fields);
    return {};  // indices, attachments, metadata
  }

  std::string take_schema(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    ChannelSchema schema;
    schema.name = fields.text();
    schema.encoding = fields.text();
    schema.data = fields.text();
    if (!fields.ok()) return std::string(kTooShort);
    if (!schemas_.contains(id)) schemas_[id] = std::make_shared<const ChannelSchema>(std::move(schema));
    return {};
  }

  std::string take_channel(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    const auto schema = schemas_.find(fields.number<std::uint16_t>());
    Channel channel;
    channel.schema = schema == schemas_.end() ? std::make_shared<const ChannelSchema>() : schema->second;
    channel.topic = fields.text();
    channel.message_encoding = fields.text();
    if (!fields.ok()) return std::string(kTooShort);
    content_.channels.try_emplace(id, std::move(channel));
    return {};
  }

  std::string take_message(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    fields.number<std::uint32_t>();  // sequence
    const auto log_time_ns = fields.number<std::uint64_t>();
    fields.number<std::uint64_t>();  // publish_time
    if (!fields.ok()) return std::string(kTooShort);
    const auto channel = content_.channels.find(id);
    if (channel == content_.channels.end()) return fmt::format("its channel {} is not defined", id);
    ++channel->second.messages;
    take_(id, log_time_ns, fields.rest());
    return {};
  }

  std::string take_chunk(std::string_view body) {
    Fields fields(body);
    fields.take(8 + 8);  // start and end time
    const auto size = fields.number<std::uint64_t>();
    const auto crc = fields.number<std::uint32_t>();
    const std::string_view compression = fields.text();
    const std::string_view compressed = fields.take(fields.number<std::uint64_t>());
    if (!fields.ok()) return std::string(kTooShort);
    if (!is_plausible(size, compressed.size()))
      return fmt::format("{} bytes cannot contain {} bytes", compressed.size(), size);
    std::optional<std::string> decompressed;
    if (compression == "zstd") {
      decompressed = decompress_zstd(compressed, size);
    } else if (compression == "lz4") {
      decompressed = decompress_lz4(compressed, size);
    } else if (!compression.empty()) {
      return fmt::format("its compression {} is neither zstd nor lz4", io::shown(compression));
    }
    if (!compression.empty() && !decompressed)
      return fmt::format("it cannot be decompressed ({})", compression);
    const std::string_view records = decompressed ? std::string_view(*decompressed) : compressed;
    if (records.size() != size) return fmt::format("it has {} bytes, not {}", records.size(), size);
    if (crc != 0 && crc != crc_of(records)) return "its checksum is wrong";
    return take_records(records);
  }

  // The file ends within the chunk. If it is not compressed, its records before that can be read.
  void take_torn_chunk(std::string_view body) {
    Fields fields(body);
    fields.take(8 + 8 + 8 + 4);  // times, size, checksum
    const bool is_compressed = !fields.text().empty();
    fields.number<std::uint64_t>();
    if (fields.ok() && !is_compressed) static_cast<void>(take_records(fields.rest()));
  }

  // The problem of the first record that has one. Records after one that is too short cannot be found.
  std::string take_records(std::string_view records) {
    std::string first;
    for (Fields rest(records); !rest.rest().empty();) {
      const std::size_t at = records.size() - rest.rest().size();
      const auto opcode = rest.number<Opcode>();
      const std::string_view record = rest.take(rest.number<std::uint64_t>());
      const std::string problem = rest.ok() ? take_record(opcode, record) : "it is longer than the chunk";
      if (!problem.empty() && first.empty()) first = fmt::format("its record at byte {}: {}", at, problem);
      if (!rest.ok()) break;
    }
    return first;
  }

  const TakeMessage& take_;
  std::map<std::uint16_t, std::shared_ptr<const ChannelSchema>> schemas_;
  Content content_;
};

}  // namespace

std::optional<std::string> decompress_zstd(std::string_view frame) {
  const unsigned long long size = ZSTD_getFrameContentSize(frame.data(), frame.size());
  if (!is_plausible(size, frame.size())) return std::nullopt;  // also unknown, or no frame
  return decompress_zstd(frame, size);
}

std::optional<Content> read(std::istream& file, const TakeMessage& take) {
  std::string magic(kMagic.size(), '\0');
  if (!file.read(magic.data(), static_cast<std::streamsize>(magic.size())) || magic != kMagic)
    return std::nullopt;
  Reader reader(take);
  reader.read(file);
  return reader.content();
}

}  // namespace groma::mcap
