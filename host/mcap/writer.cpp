#include "host/mcap/writer.hpp"

#include <algorithm>
#include <functional>
#include <span>

#include "host/mcap/bytes.hpp"
#include "host/mcap/format.hpp"

namespace groma::mcap {

namespace {

// As the other writers have it.
constexpr std::size_t kChunkBytes = 1 << 20;

void append_text(std::string& out, std::string_view text) {
  append(out, static_cast<std::uint32_t>(text.size()));
  out += text;
}

void append_head(std::string& out, Opcode opcode, std::size_t size) {
  append(out, static_cast<std::uint8_t>(opcode));
  append(out, std::uint64_t{size});
}

void append_record(std::string& out, Opcode opcode, std::string_view body) {
  append_head(out, opcode, body.size());
  out += body;
}

}  // namespace

void Writer::TimeSpan::add(std::uint64_t time_ns, bool is_first) noexcept {
  start_ns = is_first ? time_ns : std::min(start_ns, time_ns);
  end_ns = is_first ? time_ns : std::max(end_ns, time_ns);
}

Writer::Writer(std::string_view profile, std::string_view library) : file_(kMagic) {
  std::string header;
  append_text(header, profile);
  append_text(header, library);
  append_record(file_, Opcode::kHeader, header);
}

std::uint16_t Writer::add_channel(std::string_view topic, std::string_view message_encoding,
                                  const Schema& schema, const Metadata& metadata) {
  const auto next = static_cast<std::uint16_t>(schema_ids_.size() + 1);  // 0 means none
  const auto [known, is_new] = schema_ids_.try_emplace(std::string(schema.name), next);
  if (is_new) {
    std::string body;
    append(body, known->second);
    append_text(body, schema.name);
    append_text(body, schema.encoding);
    append_text(body, schema.data);
    append_record(schema_group_.records, Opcode::kSchema, body);
    append_record(file_, Opcode::kSchema, body);
    ++schema_group_.count;
  }
  std::string pairs;
  for (const auto& [key, value] : metadata) {
    append_text(pairs, key);
    append_text(pairs, value);
  }
  const auto id = static_cast<std::uint16_t>(channels_.size());
  std::string body;
  append(body, id);
  append(body, known->second);
  append_text(body, topic);
  append_text(body, message_encoding);
  append_text(body, pairs);
  append_record(channel_group_.records, Opcode::kChannel, body);
  append_record(file_, Opcode::kChannel, body);
  ++channel_group_.count;
  channels_.emplace_back();
  return id;
}

void Writer::write(std::uint16_t channel, std::uint64_t time_ns, std::string_view message) {
  Channel& of = channels_[channel];
  of.chunk_index.emplace_back(time_ns, chunk_.size());
  chunk_times_.add(time_ns, chunk_.empty());
  times_.add(time_ns, messages_ == 0);
  constexpr std::size_t kFieldBytes = 2 + 4 + 8 + 8;
  append_head(chunk_, Opcode::kMessage, kFieldBytes + message.size());
  append(chunk_, channel);
  append(chunk_, static_cast<std::uint32_t>(of.messages));  // sequence
  append(chunk_, time_ns);
  append(chunk_, time_ns);
  chunk_ += message;
  ++of.messages;
  ++messages_;
  if (chunk_.size() >= kChunkBytes) close_chunk();
}

void Writer::close_chunk() {
  if (chunk_.empty()) return;
  constexpr std::string_view kUncompressed{};
  std::string head;
  append(head, chunk_times_.start_ns);
  append(head, chunk_times_.end_ns);
  append(head, std::uint64_t{chunk_.size()});
  append(head, crc_of(chunk_));
  append_text(head, kUncompressed);
  append(head, std::uint64_t{chunk_.size()});
  const std::uint64_t chunk_start = file_.size();
  append_head(file_, Opcode::kChunk, head.size() + chunk_.size());
  file_ += head;
  file_ += chunk_;
  const std::uint64_t index_start = file_.size();

  std::string index_offsets;
  for (std::size_t id = 0; id < channels_.size(); ++id) {
    auto& entries = channels_[id].chunk_index;
    if (entries.empty()) continue;
    append(index_offsets, static_cast<std::uint16_t>(id));
    append(index_offsets, std::uint64_t{file_.size()});
    std::string pairs;
    for (const auto& [time_ns, offset] : entries) {
      append(pairs, time_ns);
      append(pairs, offset);
    }
    std::string body;
    append(body, static_cast<std::uint16_t>(id));
    append_text(body, pairs);
    append_record(file_, Opcode::kMessageIndex, body);
    entries.clear();
  }

  std::string body;
  append(body, chunk_times_.start_ns);
  append(body, chunk_times_.end_ns);
  append(body, chunk_start);
  append(body, index_start - chunk_start);
  append_text(body, index_offsets);
  append(body, file_.size() - index_start);
  append_text(body, kUncompressed);
  append(body, std::uint64_t{chunk_.size()});
  append(body, std::uint64_t{chunk_.size()});
  append_record(chunk_index_group_.records, Opcode::kChunkIndex, body);
  ++chunk_index_group_.count;
  chunk_.clear();
}

std::string Writer::statistics() const {
  std::string counts;
  for (std::size_t id = 0; id < channels_.size(); ++id) {
    append(counts, static_cast<std::uint16_t>(id));
    append(counts, channels_[id].messages);
  }
  constexpr std::uint32_t kNone = 0;
  std::string body;
  append(body, messages_);
  append(body, static_cast<std::uint16_t>(schema_group_.count));
  append(body, channel_group_.count);
  append(body, kNone);  // attachments
  append(body, kNone);  // metadata records
  append(body, chunk_index_group_.count);
  append(body, times_.start_ns);
  append(body, times_.end_ns);
  append_text(body, counts);
  std::string record;
  append_record(record, Opcode::kStatistics, body);
  return record;
}

std::string Writer::finish() {
  close_chunk();
  std::string data_end;
  append(data_end, crc_of(file_));
  append_record(file_, Opcode::kDataEnd, data_end);

  const std::uint64_t summary_start = file_.size();
  std::string offsets;
  const auto append_group = [&](Opcode opcode, std::string_view records) {
    if (records.empty()) return;
    std::string body;
    append(body, static_cast<std::uint8_t>(opcode));
    append(body, std::uint64_t{file_.size()});
    append(body, std::uint64_t{records.size()});
    append_record(offsets, Opcode::kSummaryOffset, body);
    file_ += records;
  };
  append_group(Opcode::kSchema, schema_group_.records);
  append_group(Opcode::kChannel, channel_group_.records);
  append_group(Opcode::kStatistics, statistics());
  append_group(Opcode::kChunkIndex, chunk_index_group_.records);
  const std::uint64_t summary_offset_start = file_.size();
  file_ += offsets;

  constexpr std::size_t kFooterBytes = 8 + 8 + 4;
  append_head(file_, Opcode::kFooter, kFooterBytes);
  append(file_, summary_start);
  append(file_, summary_offset_start);
  append(file_, crc_of(std::string_view(file_).substr(summary_start)));
  file_ += kMagic;
  return std::move(file_);
}

}  // namespace groma::mcap
