#include "host/mcap/reader.hpp"

#include <lz4frame.h>
#include <zstd.h>

#include <algorithm>
#include <cstring>
#include <memory>
#include <span>
#include <utility>

#include "host/mcap/format.hpp"

namespace groma::mcap {

namespace {

// By hand: a chunk has about 1 MiB, or one message if that is longer.
constexpr std::uint64_t kMaxUncompressedBytes = std::uint64_t{512} << 20U;
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
    const std::streamoff end = file.tellg();
    file.seekg(static_cast<std::streamoff>(kMagic.size()));
    std::string head(kRecordHeadBytes, '\0');
    std::string body;
    while (file.read(head.data(), static_cast<std::streamsize>(head.size()))) {
      Fields fields(head);
      const auto opcode = fields.number<Opcode>();
      const auto size = fields.number<std::uint64_t>();
      const auto left = static_cast<std::uint64_t>(end - file.tellg());
      if (size > left && opcode != Opcode::kChunk) return;
      body.resize(std::min(size, left));
      if (!file.read(body.data(), static_cast<std::streamsize>(body.size()))) return;
      if (size > left) return take_torn_chunk(body);
      if (opcode == Opcode::kDataEnd || opcode == Opcode::kFooter) {
        content_.is_complete = true;
        return;
      }
      if (!(opcode == Opcode::kChunk ? take_chunk(body) : take_record(opcode, body))) ++content_.damaged;
    }
  }

  Content content() { return std::move(content_); }

 private:
  bool take_record(Opcode opcode, std::string_view body) {
    Fields fields(body);
    if (opcode == Opcode::kSchema) return take_schema(fields);
    if (opcode == Opcode::kChannel) return take_channel(fields);
    if (opcode == Opcode::kMessage) return take_message(fields);
    return true;  // indices, attachments, metadata
  }

  bool take_schema(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    Channel schema;
    schema.schema_name = fields.text();
    schema.schema_encoding = fields.text();
    schema.schema_data = fields.text();
    if (fields.ok()) schemas_.try_emplace(id, std::move(schema));
    return fields.ok();
  }

  bool take_channel(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    const auto schema = schemas_.find(fields.number<std::uint16_t>());
    Channel channel = schema == schemas_.end() ? Channel{} : schema->second;
    channel.topic = fields.text();
    channel.message_encoding = fields.text();
    if (fields.ok()) content_.channels.try_emplace(id, std::move(channel));
    return fields.ok();
  }

  bool take_message(Fields fields) {
    const auto id = fields.number<std::uint16_t>();
    fields.number<std::uint32_t>();  // sequence
    const auto log_time_ns = fields.number<std::uint64_t>();
    fields.number<std::uint64_t>();  // publish_time
    const auto channel = content_.channels.find(id);
    if (!fields.ok() || channel == content_.channels.end()) return false;
    ++channel->second.messages;
    take_(id, log_time_ns, fields.rest());
    return true;
  }

  bool take_chunk(std::string_view body) {
    Fields fields(body);
    fields.take(8 + 8);  // start and end time
    const auto size = fields.number<std::uint64_t>();
    const auto crc = fields.number<std::uint32_t>();
    const std::string_view compression = fields.text();
    const std::string_view compressed = fields.take(fields.number<std::uint64_t>());
    if (!fields.ok() || !is_plausible(size, compressed.size())) return false;
    std::optional<std::string> decompressed;
    if (compression == "zstd") {
      decompressed = decompress_zstd(compressed, size);
    } else if (compression == "lz4") {
      decompressed = decompress_lz4(compressed, size);
    }
    if (!compression.empty() && !decompressed) return false;
    const std::string_view records = decompressed ? std::string_view(*decompressed) : compressed;
    if (records.size() != size || (crc != 0 && crc != crc_of(records))) return false;
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

  // False: a record is damaged; those after it are not read.
  bool take_records(std::string_view records) {
    for (Fields rest(records); !rest.rest().empty();) {
      const auto opcode = rest.number<Opcode>();
      const std::string_view record = rest.take(rest.number<std::uint64_t>());
      if (!rest.ok() || !take_record(opcode, record)) return false;
    }
    return true;
  }

  const TakeMessage& take_;
  std::map<std::uint16_t, Channel> schemas_;  // their schema_... alone
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
