#include "firmware/core/mac/frame.hpp"

namespace groma::mac {
namespace {

// Data frame, PAN id compressed, short addresses (IEEE 802.15.4-2011, 5.2.1.1).
constexpr std::uint16_t kFrameControl = 0x8841;
constexpr std::uint8_t kClosingValid = 0x01;

enum class Type : std::uint8_t { kBeacon = 1, kPoll = 2, kResponse = 3, kFinal = 4 };

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

  [[nodiscard]] bool good() const noexcept { return good_; }
  [[nodiscard]] bool at_end() const noexcept { return good_ && rest_.empty(); }

 private:
  std::span<const std::uint8_t> rest_;
  bool good_ = true;
};

Beacon read_beacon(Reader& in) noexcept {
  Beacon beacon;
  beacon.superframe = in.take32();
  beacon.epoch = in.take32();
  beacon.schedule_hash = in.take32();
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
  response.closing_valid = (in.take8() & kClosingValid) != 0;
  response.closed_exchange = in.take16();
  response.closing = in.take_ticks(5);
  return response;
}

std::optional<Body> read_body(Type type, Reader& in) noexcept {
  switch (type) {
    case Type::kBeacon:
      return Body(read_beacon(in));
    case Type::kPoll:
      if (const auto poll = read_poll(in)) return Body(*poll);
      return std::nullopt;
    case Type::kResponse:
      return Body(read_response(in));
    case Type::kFinal:
      return Body(Final{in.take16()});
  }
  return std::nullopt;
}

}  // namespace

ParseResult parse(std::span<const std::uint8_t> bytes) noexcept {
  Reader in(bytes);
  const std::uint16_t frame_control = in.take16();
  Frame frame{
      .sequence = in.take8(), .network = in.take16(), .destination = in.take16(), .source = in.take16()};
  const std::uint8_t type = in.take8();
  if (!in.good() || frame_control != kFrameControl) return {std::nullopt, ParseError::kForeign};
  const auto body = read_body(static_cast<Type>(type), in);
  if (!body || !in.at_end()) return {std::nullopt, ParseError::kMalformed};
  frame.body = *body;
  return {frame, ParseError::kForeign};
}

class FrameWriter {
 public:
  FrameWriter(const Frame& frame, Type type) noexcept {
    put(kFrameControl, 2);
    put(frame.sequence, 1);
    put(frame.network, 2);
    put(frame.destination, 2);
    put(frame.source, 2);
    put(static_cast<std::uint8_t>(type), 1);
  }
  void put(std::uint64_t value, std::size_t count) noexcept {
    for (std::size_t i = 0; i < count; ++i) {
      out_.data_[out_.size_++] = static_cast<std::uint8_t>(value >> (8 * i));
    }
  }
  void put(ranging::Ticks ticks, std::size_t count) noexcept {
    put(static_cast<std::uint64_t>(ticks.count()), count);
  }
  [[nodiscard]] const FrameBytes& result() const noexcept { return out_; }

 private:
  FrameBytes out_;
};

FrameBytes serialize(const Frame& frame) noexcept {
  if (const auto* beacon = std::get_if<Beacon>(&frame.body)) {
    FrameWriter out(frame, Type::kBeacon);
    out.put(beacon->superframe, 4);
    out.put(beacon->epoch, 4);
    out.put(beacon->schedule_hash, 4);
    return out.result();
  }
  if (const auto* poll = std::get_if<Poll>(&frame.body)) {
    FrameWriter out(frame, Type::kPoll);
    out.put(poll->exchange, 2);
    out.put(poll->superframe, 4);
    out.put(poll->slot, 1);
    const std::size_t count = poll->count < kMaxAnchors ? poll->count : kMaxAnchors;
    out.put(count, 1);
    for (std::size_t i = 0; i < count; ++i) out.put(poll->anchors[i], 2);
    return out.result();
  }
  if (const auto* response = std::get_if<Response>(&frame.body)) {
    FrameWriter out(frame, Type::kResponse);
    out.put(response->exchange, 2);
    out.put(response->reply, 4);
    out.put(response->closing_valid ? kClosingValid : 0U, 1);
    out.put(response->closed_exchange, 2);
    out.put(response->closing, 5);
    return out.result();
  }
  FrameWriter out(frame, Type::kFinal);
  if (const auto* final = std::get_if<Final>(&frame.body)) out.put(final->exchange, 2);
  return out.result();
}

}  // namespace groma::mac
