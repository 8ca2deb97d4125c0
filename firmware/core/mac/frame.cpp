#include "firmware/core/mac/frame.hpp"

#include <algorithm>
#include <utility>

namespace groma::mac {
namespace {

// Data frame, PAN id compressed, short addresses (IEEE 802.15.4-2011, 5.2.1.1).
constexpr std::uint16_t kFrameControl = 0x8841;

// Flags.
constexpr std::uint8_t kDissolving = 0x01;  // BEACON
constexpr std::uint8_t kChallengeResponse = 0x02;
constexpr std::uint8_t kShared = 0x04;
constexpr std::uint8_t kMergeRequest = 0x08;
constexpr std::uint8_t kQuiet = 0x10;
constexpr std::uint8_t kLent = 0x80;          // POLL, with the slot
constexpr std::uint8_t kClosingValid = 0x01;  // RESPONSE
constexpr std::uint8_t kTag = 0x01;           // JOIN
constexpr std::uint8_t kWantsSlot = 0x02;
constexpr std::uint8_t kWantsChallengeResponse = 0x04;
constexpr std::uint8_t kLeaving = 0x08;
constexpr std::uint8_t kAcknowledgement = 0x01;  // DATA
constexpr std::uint8_t kToHost = 0x02;
constexpr std::uint8_t kAsks = 0x04;
constexpr unsigned kHopsShift = 3;   // two bits
constexpr unsigned kRoundShift = 5;  // three

using Type = FrameType;

constexpr std::uint8_t flag_if(bool set, std::uint8_t flag) noexcept {
  return set ? flag : std::uint8_t{0};
}

class Reader {
 public:
  explicit Reader(std::span<const std::uint8_t> bytes) noexcept : rest_(bytes) {}

  // Returns 0 and clears good() if the bytes have run out.
  std::uint64_t take(std::size_t count) noexcept {
    if (rest_.size() < count) {
      good_ = false;
      rest_ = {};
      return 0;
    }
    std::uint64_t value = 0;
    for (std::size_t i = 0; i < count; ++i) value |= std::uint64_t{rest_[i]} << (8 * i);
    rest_ = rest_.subspan(count);
    return value;
  }
  std::uint8_t take8() noexcept { return static_cast<std::uint8_t>(take(1)); }
  std::uint16_t take16() noexcept { return static_cast<std::uint16_t>(take(2)); }
  std::uint32_t take32() noexcept { return static_cast<std::uint32_t>(take(4)); }
  ranging::Ticks take_ticks(std::size_t count) noexcept {
    return ranging::Ticks(static_cast<std::int64_t>(take(count)));
  }

  std::uint64_t take64() noexcept { return take(8); }
  // Clears good() if an unknown flag is set.
  std::uint8_t take_flags(std::uint8_t known) noexcept {
    const std::uint8_t flags = take8();
    if ((flags & ~known) != 0) good_ = false;
    return flags;
  }
  bool drop_last(std::size_t count) noexcept {
    if (rest_.size() < count) return false;
    rest_ = rest_.first(rest_.size() - count);
    return true;
  }
  std::span<const std::uint8_t> take_rest() noexcept { return std::exchange(rest_, {}); }

  [[nodiscard]] bool good() const noexcept { return good_; }
  [[nodiscard]] bool at_end() const noexcept { return good_ && rest_.empty(); }

 private:
  std::span<const std::uint8_t> rest_;
  bool good_ = true;
};

bool read(Reader& in, Beacon& beacon) noexcept {
  beacon.superframe = in.take32();
  beacon.session = in.take64();
  beacon.epoch = in.take32();
  beacon.schedule_hash = in.take32();
  beacon.master = in.take16();
  beacon.hop = in.take8();
  beacon.age = in.take8();
  beacon.tx_offset_dtu = static_cast<std::int16_t>(in.take16());
  const std::uint8_t flags =
      in.take_flags(kDissolving | kChallengeResponse | kShared | kMergeRequest | kQuiet);
  beacon.dissolving = (flags & kDissolving) != 0;
  beacon.shared = (flags & kShared) != 0;
  beacon.merge_request = (flags & kMergeRequest) != 0;
  beacon.quiet = (flags & kQuiet) != 0;
  beacon.slots = in.take8();
  if (beacon.slots > kMaxTags) return false;
  for (std::size_t i = 0; i < beacon.slots; ++i) beacon.owners[i] = in.take16();
  if ((flags & kChallengeResponse) != 0) {
    const std::uint16_t id = in.take16();
    beacon.challenge_response = ChallengeResponse{.id = id, .nonce = in.take64()};
  }
  if (beacon.merge_request) beacon.place = in.take_ticks(5);
  return true;
}

bool read(Reader& in, Poll& poll) noexcept {
  poll.exchange = in.take16();
  poll.superframe = in.take32();
  const std::uint8_t slot = in.take8();
  poll.slot = static_cast<std::uint8_t>(slot & ~kLent);
  poll.lent = (slot & kLent) != 0;
  poll.count = in.take8();
  if (poll.count > kMaxAnchors) return false;
  for (std::size_t i = 0; i < poll.count; ++i) poll.anchors[i] = in.take16();
  return true;
}

bool read(Reader& in, Response& response) noexcept {
  response.exchange = in.take16();
  response.reply = in.take_ticks(4);
  response.closing_valid = (in.take_flags(kClosingValid) & kClosingValid) != 0;
  response.closed_exchange = in.take16();
  response.closing = in.take_ticks(5);
  response.health.temperature_c = static_cast<std::int8_t>(in.take8());
  response.health.supply_64ths_v = in.take8();
  return true;
}

bool read(Reader& in, Final& final) noexcept {
  final.exchange = in.take16();
  return true;
}

bool read(Reader& in, Join& join) noexcept {
  join.origin = in.take16();
  join.nonce = in.take64();
  const std::uint8_t flags = in.take_flags(kTag | kWantsSlot | kWantsChallengeResponse | kLeaving);
  join.tag = (flags & kTag) != 0;
  join.wants_slot = (flags & kWantsSlot) != 0;
  join.wants_challenge_response = (flags & kWantsChallengeResponse) != 0;
  join.leaving = (flags & kLeaving) != 0;
  return true;
}

bool read(Reader& in, Data& data) noexcept {
  data.origin = in.take16();
  data.target = in.take16();
  data.message = in.take8();
  data.fragment = in.take8();
  data.fragments = in.take8();
  const std::uint8_t flags = in.take8();
  data.acknowledgement = (flags & kAcknowledgement) != 0;
  data.to_host = (flags & kToHost) != 0;
  data.asks = (flags & kAsks) != 0;
  data.hops_left = static_cast<std::uint8_t>((flags >> kHopsShift) & 3U);
  data.round = static_cast<std::uint8_t>(flags >> kRoundShift);
  const auto payload = in.take_rest();
  if (payload.size() > kMaxDataBytes || data.fragment >= data.fragments) return false;
  data.size = static_cast<std::uint8_t>(payload.size());
  std::copy(payload.begin(), payload.end(), data.payload.begin());
  return true;
}

// Reads in place: a body is large, and is read between two frames.
template <class T>
bool read_body(Reader& in, Body& body) noexcept {
  body = Body(T{});  // assigning a T could throw, as far as the compiler knows
  T* const place = std::get_if<T>(&body);
  return place != nullptr && read(in, *place);
}

bool read_body(Type type, Reader& in, Body& body) noexcept {
  switch (type) {
    case Type::kBeacon:
      return read_body<Beacon>(in, body);
    case Type::kPoll:
      return read_body<Poll>(in, body);
    case Type::kResponse:
      return read_body<Response>(in, body);
    case Type::kFinal:
      return read_body<Final>(in, body);
    case Type::kJoin:
      return read_body<Join>(in, body);
    case Type::kData:
      return read_body<Data>(in, body);
  }
  return false;
}

}  // namespace

bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept {
  return bytes.size() >= kHeaderBytes &&
         (bytes[kHeaderBytes - 1] & ~unsigned{kSecuredFlag}) == static_cast<unsigned>(Type::kPoll);
}

ParseResult parse(std::span<const std::uint8_t> bytes) noexcept {
  Frame frame;
  if (const auto error = parse(bytes, frame)) return {std::nullopt, *error};
  return {frame, ParseError::kForeign};
}

std::optional<ParseError> parse(std::span<const std::uint8_t> bytes, Frame& frame) noexcept {
  Reader in(bytes);
  const std::uint16_t frame_control = in.take16();
  frame.sequence = in.take8();
  frame.network = in.take16();
  frame.destination = in.take16();
  frame.source = in.take16();
  const std::uint8_t type = in.take8();
  if (!in.good() || frame_control != kFrameControl) return ParseError::kForeign;
  frame.secured = (type & kSecuredFlag) != 0;
  if (frame.secured && !in.drop_last(kCodeBytes)) return ParseError::kMalformed;
  const bool read = read_body(static_cast<Type>(type & ~kSecuredFlag), in, frame.body);
  return read && in.at_end() ? std::nullopt : std::optional(ParseError::kMalformed);
}

class FrameWriter {
 public:
  FrameWriter(const Frame& frame, Type type, FrameBytes& out) noexcept : secured_(frame.secured), out_(out) {
    out_.size_ = 0;
    put(kFrameControl, 2);
    put(frame.sequence, 1);
    put(frame.network, 2);
    put(frame.destination, 2);
    put(frame.source, 2);
    put(static_cast<std::uint8_t>(type) | flag_if(secured_, kSecuredFlag), 1);
  }
  void put(std::uint64_t value, std::size_t count) noexcept {
    for (std::size_t i = 0; i < count; ++i) {
      out_.data_[out_.size_++] = static_cast<std::uint8_t>(value >> (8 * i));
    }
  }
  void put(ranging::Ticks ticks, std::size_t count) noexcept {
    put(static_cast<std::uint64_t>(ticks.count()), count);
  }
  void put(std::span<const std::uint8_t> bytes) noexcept {
    std::copy(bytes.begin(), bytes.end(), out_.data_.begin() + static_cast<std::ptrdiff_t>(out_.size_));
    out_.size_ += bytes.size();
  }
  void end() noexcept {
    if (secured_) put(std::uint64_t{0}, kCodeBytes);
  }

 private:
  bool secured_;
  FrameBytes& out_;
};

std::span<std::uint8_t> FrameBytes::code() noexcept {
  return std::span(data_).first(size_).last(size_ < kCodeBytes ? 0 : kCodeBytes);
}

namespace {

void write(const Beacon& beacon, FrameWriter& out) noexcept {
  out.put(beacon.superframe, 4);
  out.put(beacon.session, 8);
  out.put(beacon.epoch, 4);
  out.put(beacon.schedule_hash, 4);
  out.put(beacon.master, 2);
  out.put(beacon.hop, 1);
  out.put(beacon.age, 1);
  out.put(static_cast<std::uint16_t>(beacon.tx_offset_dtu), 2);
  out.put(flag_if(beacon.dissolving, kDissolving) |
              flag_if(beacon.challenge_response.has_value(), kChallengeResponse) |
              flag_if(beacon.shared, kShared) | flag_if(beacon.merge_request, kMergeRequest) |
              flag_if(beacon.quiet, kQuiet),
          1);
  const std::size_t slots = std::min<std::size_t>(beacon.slots, kMaxTags);
  out.put(slots, 1);
  for (std::size_t i = 0; i < slots; ++i) out.put(beacon.owners[i], 2);
  if (beacon.challenge_response) {
    out.put(beacon.challenge_response->id, 2);
    out.put(beacon.challenge_response->nonce, 8);
  }
  if (beacon.merge_request) out.put(beacon.place, 5);
}

void write(const Poll& poll, FrameWriter& out) noexcept {
  out.put(poll.exchange, 2);
  out.put(poll.superframe, 4);
  out.put(poll.slot | unsigned{flag_if(poll.lent, kLent)}, 1);
  const std::size_t count = std::min<std::size_t>(poll.count, kMaxAnchors);
  out.put(count, 1);
  for (std::size_t i = 0; i < count; ++i) out.put(poll.anchors[i], 2);
}

void write(const Response& response, FrameWriter& out) noexcept {
  out.put(response.exchange, 2);
  out.put(response.reply, 4);
  out.put(flag_if(response.closing_valid, kClosingValid), 1);
  out.put(response.closed_exchange, 2);
  out.put(response.closing, 5);
  out.put(static_cast<std::uint8_t>(response.health.temperature_c), 1);
  out.put(response.health.supply_64ths_v, 1);
}

void write(const Final& final, FrameWriter& out) noexcept {
  out.put(final.exchange, 2);
}

void write(const Join& join, FrameWriter& out) noexcept {
  out.put(join.origin, 2);
  out.put(join.nonce, 8);
  out.put(flag_if(join.tag, kTag) | flag_if(join.wants_slot, kWantsSlot) |
              flag_if(join.wants_challenge_response, kWantsChallengeResponse) |
              flag_if(join.leaving, kLeaving),
          1);
}

void write(const Data& data, FrameWriter& out) noexcept {
  out.put(data.origin, 2);
  out.put(data.target, 2);
  out.put(data.message, 1);
  out.put(data.fragment, 1);
  out.put(data.fragments, 1);
  out.put(static_cast<std::uint8_t>(flag_if(data.acknowledgement, kAcknowledgement) |
                                    flag_if(data.to_host, kToHost) | flag_if(data.asks, kAsks) |
                                    (data.hops_left & 3U) << kHopsShift |
                                    static_cast<unsigned>(data.round) << kRoundShift),
          1);
  out.put(std::span(data.payload).first(std::min<std::size_t>(data.size, kMaxDataBytes)));
}

template <class T>
bool write_if(Type type, const Frame& frame, FrameBytes& out) noexcept {
  const T* const body = std::get_if<T>(&frame.body);
  if (body == nullptr) return false;
  FrameWriter writer(frame, type, out);
  write(*body, writer);
  writer.end();
  return true;
}

}  // namespace

FrameBytes serialize(const Frame& frame) noexcept {
  FrameBytes out;
  serialize(frame, out);
  return out;
}

// Avoids std::visit, which could throw, as far as the compiler knows.
void serialize(const Frame& frame, FrameBytes& out) noexcept {
  (void)(write_if<Response>(Type::kResponse, frame, out) || write_if<Poll>(Type::kPoll, frame, out) ||
         write_if<Beacon>(Type::kBeacon, frame, out) || write_if<Final>(Type::kFinal, frame, out) ||
         write_if<Join>(Type::kJoin, frame, out) || write_if<Data>(Type::kData, frame, out));
}

}  // namespace groma::mac
