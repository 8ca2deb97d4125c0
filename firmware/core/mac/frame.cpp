#include "firmware/core/mac/frame.hpp"

#include <algorithm>
#include <concepts>
#include <type_traits>

namespace groma::mac {
namespace {

// Data frame, PAN id compressed, short addresses (IEEE 802.15.4-2011, 5.2.1.1).
constexpr std::uint16_t kFrameControl = 0x8841;

// Reads the fields of transfer().
class Reader {
 public:
  static constexpr bool kReads = true;

  explicit Reader(std::span<const std::uint8_t> bytes) noexcept : rest_(bytes) {}

  template <class T>
  void number(T& value, std::size_t bytes = sizeof(T)) noexcept {
    value = static_cast<T>(take(bytes));
  }
  void number(Ticks& ticks, std::size_t bytes) noexcept {
    ticks = Ticks(static_cast<std::int64_t>(take(bytes)));
  }
  // One byte of fields with these widths, from bit 0 on. The bits above them must be 0.
  template <class... Fields>
  void bits(const std::array<unsigned, sizeof...(Fields)>& widths, Fields&... fields) noexcept {
    auto byte = static_cast<unsigned>(take(1));
    std::size_t i = 0;
    const auto cut = [&](auto& field) {
      field = static_cast<std::remove_reference_t<decltype(field)>>(byte & ((1U << widths[i]) - 1U));
      byte >>= widths[i++];
    };
    (cut(fields), ...);
    require(byte == 0);
  }
  template <std::size_t kMost>
  void list(std::uint8_t& count, std::array<std::uint16_t, kMost>& ids) noexcept {
    number(count);
    require(count <= kMost);
    for (std::size_t i = 0; good_ && i < count; ++i) number(ids[i]);
  }
  template <std::size_t kMost>
  void rest(std::uint8_t& size, std::array<std::uint8_t, kMost>& bytes) noexcept {
    require(rest_.size() <= kMost);
    if (!good_) return;
    size = static_cast<std::uint8_t>(rest_.size());
    std::copy(rest_.begin(), rest_.end(), bytes.begin());
    rest_ = {};
  }
  void require(bool holds) noexcept { good_ = good_ && holds; }

  void drop_last(std::size_t count) noexcept {
    require(rest_.size() >= count);
    if (good_) rest_ = rest_.first(rest_.size() - count);
  }
  [[nodiscard]] bool good() const noexcept { return good_; }
  [[nodiscard]] bool at_end() const noexcept { return good_ && rest_.empty(); }

 private:
  // Returns 0 and clears good() if the bytes have run out.
  std::uint64_t take(std::size_t count) noexcept {
    require(rest_.size() >= count);
    if (!good_) return 0;
    std::uint64_t value = 0;
    for (std::size_t i = 0; i < count; ++i) value |= std::uint64_t{rest_[i]} << (8 * i);
    rest_ = rest_.subspan(count);
    return value;
  }

  std::span<const std::uint8_t> rest_;
  bool good_ = true;
};

}  // namespace

// Writes the fields of transfer().
class FrameWriter {
 public:
  static constexpr bool kReads = false;

  explicit FrameWriter(FrameBytes& out) noexcept : out_(out) { out_.size_ = 0; }

  template <class T>
  void number(const T& value, std::size_t bytes = sizeof(T)) noexcept {
    put(static_cast<std::uint64_t>(value), bytes);
  }
  void number(const Ticks& ticks, std::size_t bytes) noexcept {
    put(static_cast<std::uint64_t>(ticks.count()), bytes);
  }
  template <class... Fields>
  void bits(const std::array<unsigned, sizeof...(Fields)>& widths, const Fields&... fields) noexcept {
    unsigned byte = 0;
    unsigned at = 0;
    std::size_t i = 0;
    const auto join = [&](unsigned field) {
      byte |= (field & ((1U << widths[i]) - 1U)) << at;
      at += widths[i++];
    };
    (join(fields), ...);
    put(byte, 1);
  }
  template <std::size_t kMost>
  void list(std::uint8_t count, const std::array<std::uint16_t, kMost>& ids) noexcept {
    const std::size_t most = std::min<std::size_t>(count, kMost);
    put(most, 1);
    for (std::size_t i = 0; i < most; ++i) put(ids[i], 2);
  }
  template <std::size_t kMost>
  void rest(std::uint8_t size, const std::array<std::uint8_t, kMost>& bytes) noexcept {
    for (std::size_t i = 0; i < std::min<std::size_t>(size, kMost); ++i) put(bytes[i], 1);
  }
  void require(bool /*holds*/) noexcept {}

 private:
  void put(std::uint64_t value, std::size_t count) noexcept {
    for (std::size_t i = 0; i < count; ++i) {
      out_.data_[out_.size_++] = static_cast<std::uint8_t>(value >> (8 * i));
    }
  }

  FrameBytes& out_;
};

namespace {

// The fields of each frame, in their order on the air: transfer() reads them or writes them.
template <class T, class U>
concept Is = std::same_as<std::remove_const_t<T>, U>;

void transfer(auto& io, Is<Frame> auto& frame, std::uint16_t& frame_control, std::uint8_t& type) noexcept {
  io.number(frame_control);
  io.number(frame.sequence);
  io.number(frame.network);
  io.number(frame.destination);
  io.number(frame.source);
  io.number(type);
}

void transfer(auto& io, Is<Beacon> auto& beacon) noexcept {
  bool responds = beacon.challenge_response.has_value();
  io.number(beacon.superframe);
  io.number(beacon.session);
  io.number(beacon.epoch);
  io.number(beacon.schedule_hash);
  io.number(beacon.master);
  io.number(beacon.hop);
  io.number(beacon.age);
  io.number(beacon.tx_offset_dtu);
  io.bits({1, 1, 1, 1, 1}, beacon.dissolving, responds, beacon.shared, beacon.merge_request, beacon.quiet);
  io.list(beacon.slots, beacon.owners);
  if constexpr (std::remove_reference_t<decltype(io)>::kReads) {
    if (responds) beacon.challenge_response.emplace();
  }
  if (responds) {
    io.number(beacon.challenge_response->id);
    io.number(beacon.challenge_response->nonce);
  }
  if (beacon.merge_request) io.number(beacon.place, 5);
}

void transfer(auto& io, Is<Poll> auto& poll) noexcept {
  io.number(poll.exchange);
  io.number(poll.superframe);
  io.bits({7, 1}, poll.slot, poll.lent);
  io.list(poll.count, poll.anchors);
}

void transfer(auto& io, Is<Response> auto& response) noexcept {
  io.number(response.exchange);
  io.number(response.reply, 4);
  io.bits({1}, response.closing_valid);
  io.number(response.closed_exchange);
  io.number(response.closing, 5);
  io.number(response.health.temperature_c);
  io.number(response.health.supply_64ths_v);
}

void transfer(auto& io, Is<Final> auto& final) noexcept {
  io.number(final.exchange);
}

void transfer(auto& io, Is<Join> auto& join) noexcept {
  io.number(join.origin);
  io.number(join.nonce);
  io.bits({1, 1, 1, 1}, join.tag, join.wants_slot, join.wants_challenge_response, join.leaving);
}

void transfer(auto& io, Is<Data> auto& data) noexcept {
  io.number(data.origin);
  io.number(data.target);
  io.number(data.message);
  io.number(data.fragment);
  io.number(data.fragments);
  io.require(data.fragment < data.fragments);
  io.bits({1, 1, 1, 2, 3}, data.acknowledgement, data.to_host, data.asks, data.hops_left, data.round);
  io.rest(data.size, data.payload);
}

// Reads in place: a body is large, and is read between two frames.
template <class T>
bool read_if(FrameType of, std::uint8_t type, Reader& in, Body& body) noexcept {
  if (type != static_cast<std::uint8_t>(of)) return false;
  body = Body(T{});  // assigning a T could throw, as far as the compiler knows
  T* const place = std::get_if<T>(&body);
  if (place != nullptr) transfer(in, *place);
  return true;
}

template <class T>
bool write_if(FrameType of, const Frame& frame, FrameBytes& out) noexcept {
  const T* const body = std::get_if<T>(&frame.body);
  if (body == nullptr) return false;
  FrameWriter writer(out);
  std::uint16_t frame_control = kFrameControl;
  auto type = static_cast<std::uint8_t>(static_cast<unsigned>(of) | (frame.secured ? kSecuredFlag : 0U));
  transfer(writer, frame, frame_control, type);
  transfer(writer, *body);
  if (frame.secured) writer.number(std::uint64_t{0}, kCodeBytes);
  return true;
}

}  // namespace

bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept {
  return bytes.size() >= kHeaderBytes &&
         (bytes[kHeaderBytes - 1] & ~unsigned{kSecuredFlag}) == static_cast<unsigned>(FrameType::kPoll);
}

ParseResult parse(std::span<const std::uint8_t> bytes) noexcept {
  Frame frame;
  if (const auto error = parse(bytes, frame)) return {std::nullopt, *error};
  return {frame, ParseError::kForeign};
}

std::optional<ParseError> parse(std::span<const std::uint8_t> bytes, Frame& frame) noexcept {
  Reader in(bytes);
  std::uint16_t frame_control = 0;
  std::uint8_t type = 0;
  transfer(in, frame, frame_control, type);
  if (!in.good() || frame_control != kFrameControl) return ParseError::kForeign;
  frame.secured = (type & kSecuredFlag) != 0;
  if (frame.secured) in.drop_last(kCodeBytes);
  type = static_cast<std::uint8_t>(type & ~kSecuredFlag);
  using enum FrameType;
  const bool read =
      read_if<Response>(kResponse, type, in, frame.body) || read_if<Poll>(kPoll, type, in, frame.body) ||
      read_if<Beacon>(kBeacon, type, in, frame.body) || read_if<Final>(kFinal, type, in, frame.body) ||
      read_if<Join>(kJoin, type, in, frame.body) || read_if<Data>(kData, type, in, frame.body);
  return read && in.at_end() ? std::nullopt : std::optional(ParseError::kMalformed);
}

std::span<std::uint8_t> FrameBytes::code() noexcept {
  return std::span(data_).first(size_).last(size_ < kCodeBytes ? 0 : kCodeBytes);
}

FrameBytes serialize(const Frame& frame) noexcept {
  FrameBytes out;
  serialize(frame, out);
  return out;
}

// Avoids std::visit, which could throw, as far as the compiler knows.
void serialize(const Frame& frame, FrameBytes& out) noexcept {
  using enum FrameType;
  (void)(write_if<Response>(kResponse, frame, out) || write_if<Poll>(kPoll, frame, out) ||
         write_if<Beacon>(kBeacon, frame, out) || write_if<Final>(kFinal, frame, out) ||
         write_if<Join>(kJoin, frame, out) || write_if<Data>(kData, frame, out));
}

}  // namespace groma::mac
