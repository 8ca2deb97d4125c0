#include "firmware/core/mac/frame.hpp"

#include <algorithm>
#include <utility>

namespace groma::mac {
namespace {

// Data frame, PAN id compressed, short addresses (IEEE 802.15.4-2011, 5.2.1.1).
constexpr std::uint16_t kFrameControl = 0x8841;
constexpr std::uint8_t kSecured = 0x80;  // of the type byte

// Flags.
constexpr std::uint8_t kDissolving = 0x01;  // BEACON
constexpr std::uint8_t kWelcome = 0x02;
constexpr std::uint8_t kShared = 0x04;
constexpr std::uint8_t kInvitation = 0x08;
constexpr std::uint8_t kQuiet = 0x10;
constexpr std::uint8_t kClosingValid = 0x01;  // RESPONSE
constexpr std::uint8_t kTag = 0x01;           // JOIN
constexpr std::uint8_t kWantsSlot = 0x02;
constexpr std::uint8_t kWantsWelcome = 0x04;
constexpr std::uint8_t kLeaving = 0x08;
constexpr std::uint8_t kAcknowledgement = 0x01;  // DATA
constexpr std::uint8_t kToHost = 0x02;
constexpr std::uint8_t kAsks = 0x04;
constexpr unsigned kHopsShift = 3;   // two bits
constexpr unsigned kRoundShift = 5;  // three

enum class Type : std::uint8_t { kBeacon = 1, kPoll = 2, kResponse = 3, kFinal = 4, kJoin = 5, kData = 6 };

constexpr std::uint8_t flag_if(bool set, std::uint8_t flag) noexcept {
  return set ? flag : std::uint8_t{0};
}

class Reader {
 public:
  explicit Reader(std::span<const std::uint8_t> bytes) noexcept : rest_(bytes) {}

  // Zero, and not good() any more, where the bytes have run out.
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
  // No other than the known flags are set.
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

std::optional<Beacon> read_beacon(Reader& in) noexcept {
  Beacon beacon;
  beacon.superframe = in.take32();
  beacon.session = in.take64();
  beacon.epoch = in.take32();
  beacon.schedule_hash = in.take32();
  beacon.master = in.take16();
  beacon.hop = in.take8();
  beacon.age = in.take8();
  beacon.lateness_dtu = static_cast<std::int16_t>(in.take16());
  const std::uint8_t flags = in.take_flags(kDissolving | kWelcome | kShared | kInvitation | kQuiet);
  beacon.dissolving = (flags & kDissolving) != 0;
  beacon.shared = (flags & kShared) != 0;
  beacon.invitation = (flags & kInvitation) != 0;
  beacon.quiet = (flags & kQuiet) != 0;
  beacon.slots = in.take8();
  if (beacon.slots > kMaxTags) return std::nullopt;
  for (std::size_t i = 0; i < beacon.slots; ++i) beacon.holders[i] = in.take16();
  if ((flags & kWelcome) != 0) {
    const std::uint16_t id = in.take16();
    beacon.welcome = Welcome{.id = id, .nonce = in.take64()};
  }
  if (beacon.invitation) beacon.place = in.take_ticks(5);
  return beacon;
}

std::optional<Poll> read_poll(Reader& in) noexcept {
  Poll poll;
  poll.exchange = in.take16();
  poll.superframe = in.take32();
  poll.slot = in.take8();
  poll.count = in.take8();
  if (poll.count > kMaxAnchors) return std::nullopt;
  for (std::size_t i = 0; i < poll.count; ++i) poll.anchors[i] = in.take16();
  return poll;
}

Response read_response(Reader& in) noexcept {
  Response response;
  response.exchange = in.take16();
  response.reply = in.take_ticks(4);
  response.closing_valid = (in.take_flags(kClosingValid) & kClosingValid) != 0;
  response.closed_exchange = in.take16();
  response.closing = in.take_ticks(5);
  response.health.temperature_c = static_cast<std::int8_t>(in.take8());
  response.health.supply_64ths_v = in.take8();
  return response;
}

Join read_join(Reader& in) noexcept {
  Join join;
  join.origin = in.take16();
  join.nonce = in.take64();
  const std::uint8_t flags = in.take_flags(kTag | kWantsSlot | kWantsWelcome | kLeaving);
  join.tag = (flags & kTag) != 0;
  join.wants_slot = (flags & kWantsSlot) != 0;
  join.wants_welcome = (flags & kWantsWelcome) != 0;
  join.leaving = (flags & kLeaving) != 0;
  return join;
}

std::optional<Data> read_data(Reader& in) noexcept {
  Data data;
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
  if (payload.size() > kMaxDataBytes || data.fragment >= data.fragments) return std::nullopt;
  data.size = static_cast<std::uint8_t>(payload.size());
  std::copy(payload.begin(), payload.end(), data.payload.begin());
  return data;
}

std::optional<Body> read_body(Type type, Reader& in) noexcept {
  switch (type) {
    case Type::kBeacon:
      if (const auto beacon = read_beacon(in)) return Body(*beacon);
      return std::nullopt;
    case Type::kPoll:
      if (const auto poll = read_poll(in)) return Body(*poll);
      return std::nullopt;
    case Type::kResponse:
      return Body(read_response(in));
    case Type::kFinal:
      return Body(Final{in.take16()});
    case Type::kJoin:
      return Body(read_join(in));
    case Type::kData:
      if (const auto data = read_data(in)) return Body(*data);
      return std::nullopt;
  }
  return std::nullopt;
}

}  // namespace

bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept {
  return bytes.size() >= kHeaderBytes &&
         (bytes[kHeaderBytes - 1] & ~unsigned{kSecured}) == static_cast<unsigned>(Type::kPoll);
}

ParseResult parse(std::span<const std::uint8_t> bytes) noexcept {
  Reader in(bytes);
  const std::uint16_t frame_control = in.take16();
  Frame frame{
      .sequence = in.take8(), .network = in.take16(), .destination = in.take16(), .source = in.take16()};
  const std::uint8_t type = in.take8();
  if (!in.good() || frame_control != kFrameControl) return {std::nullopt, ParseError::kForeign};
  frame.secured = (type & kSecured) != 0;
  if (frame.secured && !in.drop_last(kCodeBytes)) return {std::nullopt, ParseError::kMalformed};
  const auto body = read_body(static_cast<Type>(type & ~kSecured), in);
  if (!body || !in.at_end()) return {std::nullopt, ParseError::kMalformed};
  frame.body = *body;
  return {frame, ParseError::kForeign};
}

class FrameWriter {
 public:
  FrameWriter(const Frame& frame, Type type) noexcept : secured_(frame.secured) {
    put(kFrameControl, 2);
    put(frame.sequence, 1);
    put(frame.network, 2);
    put(frame.destination, 2);
    put(frame.source, 2);
    put(static_cast<std::uint8_t>(type) | flag_if(secured_, kSecured), 1);
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
  [[nodiscard]] const FrameBytes& result() noexcept {
    if (secured_) put(std::uint64_t{0}, kCodeBytes);
    return out_;
  }

 private:
  bool secured_;
  FrameBytes out_;
};

std::span<std::uint8_t> FrameBytes::code() noexcept {
  return std::span(data_).first(size_).last(size_ < kCodeBytes ? 0 : kCodeBytes);
}

namespace {

FrameBytes write(const Frame& frame, const Beacon& beacon) noexcept {
  FrameWriter out(frame, Type::kBeacon);
  out.put(beacon.superframe, 4);
  out.put(beacon.session, 8);
  out.put(beacon.epoch, 4);
  out.put(beacon.schedule_hash, 4);
  out.put(beacon.master, 2);
  out.put(beacon.hop, 1);
  out.put(beacon.age, 1);
  out.put(static_cast<std::uint16_t>(beacon.lateness_dtu), 2);
  out.put(flag_if(beacon.dissolving, kDissolving) | flag_if(beacon.welcome.has_value(), kWelcome) |
              flag_if(beacon.shared, kShared) | flag_if(beacon.invitation, kInvitation) |
              flag_if(beacon.quiet, kQuiet),
          1);
  const std::size_t slots = std::min<std::size_t>(beacon.slots, kMaxTags);
  out.put(slots, 1);
  for (std::size_t i = 0; i < slots; ++i) out.put(beacon.holders[i], 2);
  if (beacon.welcome) {
    out.put(beacon.welcome->id, 2);
    out.put(beacon.welcome->nonce, 8);
  }
  if (beacon.invitation) out.put(beacon.place, 5);
  return out.result();
}

FrameBytes write(const Frame& frame, const Poll& poll) noexcept {
  FrameWriter out(frame, Type::kPoll);
  out.put(poll.exchange, 2);
  out.put(poll.superframe, 4);
  out.put(poll.slot, 1);
  const std::size_t count = std::min<std::size_t>(poll.count, kMaxAnchors);
  out.put(count, 1);
  for (std::size_t i = 0; i < count; ++i) out.put(poll.anchors[i], 2);
  return out.result();
}

FrameBytes write(const Frame& frame, const Response& response) noexcept {
  FrameWriter out(frame, Type::kResponse);
  out.put(response.exchange, 2);
  out.put(response.reply, 4);
  out.put(flag_if(response.closing_valid, kClosingValid), 1);
  out.put(response.closed_exchange, 2);
  out.put(response.closing, 5);
  out.put(static_cast<std::uint8_t>(response.health.temperature_c), 1);
  out.put(response.health.supply_64ths_v, 1);
  return out.result();
}

FrameBytes write(const Frame& frame, const Final& final) noexcept {
  FrameWriter out(frame, Type::kFinal);
  out.put(final.exchange, 2);
  return out.result();
}

FrameBytes write(const Frame& frame, const Join& join) noexcept {
  FrameWriter out(frame, Type::kJoin);
  out.put(join.origin, 2);
  out.put(join.nonce, 8);
  out.put(flag_if(join.tag, kTag) | flag_if(join.wants_slot, kWantsSlot) |
              flag_if(join.wants_welcome, kWantsWelcome) | flag_if(join.leaving, kLeaving),
          1);
  return out.result();
}

FrameBytes write(const Frame& frame, const Data& data) noexcept {
  FrameWriter out(frame, Type::kData);
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
  return out.result();
}

}  // namespace

FrameBytes serialize(const Frame& frame) noexcept {
  // std::visit could throw, for all the compiler knows.
  if (const auto* beacon = std::get_if<Beacon>(&frame.body)) return write(frame, *beacon);
  if (const auto* poll = std::get_if<Poll>(&frame.body)) return write(frame, *poll);
  if (const auto* response = std::get_if<Response>(&frame.body)) return write(frame, *response);
  if (const auto* final = std::get_if<Final>(&frame.body)) return write(frame, *final);
  if (const auto* join = std::get_if<Join>(&frame.body)) return write(frame, *join);
  if (const auto* data = std::get_if<Data>(&frame.body)) return write(frame, *data);
  return {};
}

}  // namespace groma::mac
