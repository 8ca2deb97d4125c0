#include "host/io/log_event.hpp"

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>

#include "log.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::io {
namespace {

template <class... Handlers>
struct Overloaded : Handlers... {
  using Handlers::operator()...;
};
template <class... Handlers>
Overloaded(Handlers...) -> Overloaded<Handlers...>;

void append(const groma_LogRecord& record, std::string& out) {
  std::array<std::uint8_t, groma_LogRecord_size> payload{};
  std::array<std::uint8_t, wire::max_encoded_size(groma_LogRecord_size)> frame{};
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_LogRecord_fields, &record)) return;  // cannot happen: the buffer fits
  const std::size_t size = wire::encode_frame(std::span(payload).first(stream.bytes_written), frame);
  out.append(reinterpret_cast<const char*>(frame.data()), size);
}

// Appends a record for each fragment; `of` is the one of `record` that they share.
template <class Fragment>
void append_fragments(std::string_view content, groma_LogRecord& record, Fragment& of, std::string& out) {
  constexpr std::size_t kSize = sizeof(of.content.bytes);
  do {
    const std::size_t size = std::min(kSize, content.size());
    std::copy_n(content.data(), size, of.content.bytes);
    of.content.size = static_cast<pb_size_t>(size);
    content.remove_prefix(size);
    of.more = !content.empty();
    append(record, out);
    ++of.fragment;
  } while (!content.empty());
}

std::string_view text_of(std::span<const std::uint8_t> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

// Joins the fragments of states and bytes.
class EventReader {
 public:
  explicit EventReader(const std::function<void(const LogEvent&)>& take) : take_(take) {}

  // False if the record is invalid.
  bool read(const groma_LogRecord& record) {
    const auto& body = record.body;
    switch (record.which_body) {
      case groma_LogRecord_start_tag:
        take_(SectionStart{body.start.program_version, body.start.unix_time_ns, body.start.continues});
        return true;
      case groma_LogRecord_state_tag:
        if (body.state.kind > static_cast<std::uint32_t>(LoopState::Kind::kAdoption)) return false;
        if (join(body.state)) take_(LoopState{static_cast<LoopState::Kind>(body.state.kind), joined_});
        return true;
      case groma_LogRecord_bytes_tag:
        if (!std::isfinite(body.bytes.now_s)) return false;
        if (join(body.bytes)) {
          const auto* data = reinterpret_cast<const std::uint8_t*>(joined_.data());
          take_(LinkBytes{body.bytes.link, {data, joined_.size()}, body.bytes.now_s});
        }
        return true;
      case groma_LogRecord_reopened_tag:
        take_(LinkReopened{body.reopened.link});
        return true;
      case groma_LogRecord_tick_tag:
        if (std::isfinite(body.tick.now_s)) take_(LoopTick{body.tick.now_s});
        return std::isfinite(body.tick.now_s);
      case groma_LogRecord_flush_tag:
        take_(LoopFlush{});
        return true;
      case groma_LogRecord_digest_tag:
        take_(PoseDigest{body.digest.now_s, body.digest.poses, body.digest.fnv1a});
        return true;
      default:
        return true;
    }
  }

 private:
  static constexpr std::uint32_t kNone = std::numeric_limits<std::uint32_t>::max();

  // True with the last fragment, if none was lost.
  template <class Fragment>
  bool join(const Fragment& of) {
    if (of.fragment == 0) {
      joined_.clear();
      next_ = 0;
    }
    if (of.fragment != next_) {
      next_ = kNone;
      return false;
    }
    ++next_;
    joined_.append(reinterpret_cast<const char*>(of.content.bytes), of.content.size);
    return !of.more;
  }

  const std::function<void(const LogEvent&)>& take_;
  std::string joined_;
  std::uint32_t next_ = kNone;  // fragment
};

}  // namespace

void append_event(const LogEvent& event, std::string& out) {
  groma_LogRecord record = groma_LogRecord_init_zero;
  auto& body = record.body;
  std::visit(Overloaded{
                 [&](const SectionStart& start) {
                   record.which_body = groma_LogRecord_start_tag;
                   start.program_version.copy(body.start.program_version,
                                              sizeof(body.start.program_version) - 1);
                   body.start.unix_time_ns = start.unix_time_ns;
                   body.start.continues = start.continues;
                   append(record, out);
                 },
                 [&](const LinkBytes& bytes) {
                   record.which_body = groma_LogRecord_bytes_tag;
                   body.bytes.link = static_cast<std::uint32_t>(bytes.link);
                   body.bytes.now_s = bytes.now_s;
                   append_fragments(text_of(bytes.bytes), record, body.bytes, out);
                 },
                 [&](const LinkReopened& reopened) {
                   record.which_body = groma_LogRecord_reopened_tag;
                   body.reopened.link = static_cast<std::uint32_t>(reopened.link);
                   append(record, out);
                 },
                 [&](const LoopTick& tick) {
                   record.which_body = groma_LogRecord_tick_tag;
                   body.tick.now_s = tick.now_s;
                   append(record, out);
                 },
                 [&](const LoopFlush&) {
                   record.which_body = groma_LogRecord_flush_tag;
                   append(record, out);
                 },
                 [&](const LoopState& state) {
                   record.which_body = groma_LogRecord_state_tag;
                   body.state.kind = static_cast<std::uint32_t>(state.kind);
                   append_fragments(state.content, record, body.state, out);
                 },
                 [&](const PoseDigest& digest) {
                   record.which_body = groma_LogRecord_digest_tag;
                   body.digest.now_s = digest.now_s;
                   body.digest.poses = digest.poses;
                   body.digest.fnv1a = digest.fnv1a;
                   append(record, out);
                 },
             },
             event);
}

std::size_t read_log_events(std::string_view bytes, const std::function<void(const LogEvent&)>& take) {
  const auto decoder = std::make_unique<wire::FrameDecoder>();
  EventReader reader(take);
  groma_LogRecord record = groma_LogRecord_init_zero;
  std::size_t damaged_bytes = 0;
  for (const char byte : bytes) {
    if (!decoder->push(static_cast<std::uint8_t>(byte))) continue;
    const std::span<const std::uint8_t> payload = decoder->payload();
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    record = groma_LogRecord_init_zero;
    const bool understood = pb_decode(&stream, groma_LogRecord_fields, &record);
    if (!understood || !reader.read(record)) damaged_bytes += decoder->encoded_size();
  }
  decoder->reset();
  return damaged_bytes + decoder->counters().bytes_discarded;
}

}  // namespace groma::io
