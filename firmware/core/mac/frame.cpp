#include "firmware/core/mac/frame.hpp"

#include <algorithm>
#include <concepts>
#include <type_traits>

namespace groma::mac {
namespace {

// Data frame, PAN id compressed, short addresses (IEEE 802.15.4-2011, 5.2.1.1).
constexpr std::uint16_t kFrameControl = 0x8841;

// The fields of a frame, in their order on the air: reads or writes each number little-endian.
template <bool kReads>
class Fields {
 public:
  static constexpr bool kReading = kReads;
  using Byte = std::conditional_t<kReads, const std::uint8_t, std::uint8_t>;

  explicit Fields(std::span<Byte> bytes) noexcept : rest_(bytes) {}

  template <class T>
  void number(T& value, std::size_t bytes = sizeof(T)) noexcept {
    auto word = static_cast<std::uint64_t>(value);
    pass(word, bytes);
    if constexpr (kReads) value = static_cast<T>(word);
  }
  void ticks(auto& value, std::size_t bytes) noexcept {
    std::int64_t count = value.count();
    number(count, bytes);
    if constexpr (kReads) value = Ticks(count);
  }
  // One byte of fields with these widths, from bit 0 on. The bits above them must be 0.
  template <class... T>
  void bits(const std::array<unsigned, sizeof...(T)>& widths, T&... fields) noexcept {
    unsigned byte = 0;
    if constexpr (kReads) number(byte, 1);
    unsigned at = 0;
    std::size_t i = 0;
    const auto field = [&](auto& value) {
      const unsigned mask = (1U << widths[i]) - 1U;
      if constexpr (kReads) {
        value = static_cast<std::remove_reference_t<decltype(value)>>(byte >> at & mask);
      } else {
        byte |= (value & mask) << at;
      }
      at += widths[i++];
    };
    (field(fields), ...);
    require(byte >> at == 0);
    if constexpr (!kReads) number(byte, 1);
  }
  void list(auto& count, auto& ids) noexcept {
    number(count);
    require(count <= ids.size());
    for (std::size_t i = 0; good_ && i < count; ++i) number(ids[i]);
  }
  // All bytes that are left.
  void rest(auto& size, auto& bytes) noexcept {
    if constexpr (kReads) size = static_cast<std::uint8_t>(rest_.size());
    require(size <= bytes.size());
    for (std::size_t i = 0; good_ && i < size; ++i) number(bytes[i]);
  }
  void require(bool holds) noexcept { good_ = good_ && holds; }

  void drop_last(std::size_t count) noexcept {
    require(rest_.size() >= count);
    if (good_) rest_ = rest_.first(rest_.size() - count);
  }
  // False if the bytes have run out or a field had an invalid value.
  [[nodiscard]] bool good() const noexcept { return good_; }
  [[nodiscard]] std::size_t left() const noexcept { return rest_.size(); }

 private:
  void pass(std::uint64_t& word, std::size_t bytes) noexcept {
    require(rest_.size() >= bytes);
    if (!good_) return;
    if constexpr (kReads) word = 0;
    for (std::size_t i = 0; i < bytes; ++i) {
      if constexpr (kReads) {
        word |= std::uint64_t{rest_[i]} << (8 * i);
      } else {
        rest_[i] = static_cast<std::uint8_t>(word >> (8 * i));
      }
    }
    rest_ = rest_.subspan(bytes);
  }

  std::span<Byte> rest_;
  bool good_ = true;
};

// The fields of each frame: transfer() reads them or writes them.
template <class T, class U>
concept Is = std::same_as<std::remove_const_t<T>, U>;

void transfer(auto& io, Is<Frame> auto& frame, auto& frame_control, auto& type) noexcept {
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
  if constexpr (std::remove_reference_t<decltype(io)>::kReading) {
    if (responds) beacon.challenge_response.emplace();
  }
  if (responds) {
    io.number(beacon.challenge_response->id);
    io.number(beacon.challenge_response->nonce);
  }
  if (beacon.merge_request) io.ticks(beacon.place, 5);
}

void transfer(auto& io, Is<Poll> auto& poll) noexcept {
  io.number(poll.exchange);
  io.number(poll.superframe);
  io.bits({7, 1}, poll.slot, poll.lent);
  io.list(poll.count, poll.anchors);
}

void transfer(auto& io, Is<Response> auto& response) noexcept {
  io.number(response.exchange);
  io.ticks(response.reply, 4);
  io.bits({1}, response.closing_valid);
  io.number(response.closed_exchange);
  io.ticks(response.closing, 5);
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
  io.require(!io.kReading || data.fragment < data.fragments);
  io.bits({1, 1, 1, 2, 3}, data.acknowledgement, data.to_host, data.asks, data.hops_left, data.round);
  io.rest(data.size, data.payload);
}

// The body of this kind, if it is the one at `index` of Body. Reads in place: a body is large, and is read
// between two frames.
template <class T>
bool transfer_if(std::size_t index, auto& io, Is<Body> auto& body) noexcept {
  constexpr std::size_t kIndex = Body(T{}).index();
  if (index != kIndex) return false;
  // Assigning a T could throw, as far as the compiler knows.
  if constexpr (std::remove_reference_t<decltype(io)>::kReading) body = Body(T{});
  if (auto* const place = std::get_if<T>(&body)) transfer(io, *place);
  return true;
}

// Avoids std::visit, which could throw, as far as the compiler knows.
bool transfer(std::size_t index, auto& io, Is<Body> auto& body) noexcept {
  return transfer_if<Response>(index, io, body) || transfer_if<Poll>(index, io, body) ||
         transfer_if<Beacon>(index, io, body) || transfer_if<Final>(index, io, body) ||
         transfer_if<Join>(index, io, body) || transfer_if<Data>(index, io, body);
}

// The types count the kinds of Body.
constexpr std::size_t kFirstType = 1;
static_assert(static_cast<std::size_t>(FrameType::kBeacon) == kFirstType &&
              static_cast<std::size_t>(FrameType::kData) == std::variant_size_v<Body>);

}  // namespace

bool looks_like_poll(std::span<const std::uint8_t> bytes) noexcept {
  return bytes.size() >= kHeaderBytes &&
         (bytes[kHeaderBytes - 1] & ~unsigned{kSecuredFlag}) == static_cast<unsigned>(FrameType::kPoll);
}

std::optional<ParseError> parse(std::span<const std::uint8_t> bytes, Frame& frame) noexcept {
  Fields<true> in(bytes);
  std::uint16_t frame_control = 0;
  std::uint8_t type = 0;
  transfer(in, frame, frame_control, type);
  if (!in.good() || frame_control != kFrameControl) return ParseError::kForeign;
  frame.secured = (type & kSecuredFlag) != 0;
  if (frame.secured) in.drop_last(kCodeBytes);
  const std::size_t index = (type & ~std::size_t{kSecuredFlag}) - kFirstType;
  const bool known = transfer(index, in, frame.body);
  return known && in.good() && in.left() == 0 ? std::nullopt : std::optional(ParseError::kMalformed);
}

std::span<std::uint8_t> FrameBytes::code() noexcept {
  return std::span(data_).first(size_).last(size_ < kCodeBytes ? 0 : kCodeBytes);
}

void serialize(const Frame& frame, FrameBytes& out) noexcept {
  Fields<false> writer(out.data_);
  const auto type =
      static_cast<std::uint8_t>((frame.body.index() + kFirstType) | (frame.secured ? kSecuredFlag : 0U));
  transfer(writer, frame, kFrameControl, type);
  (void)transfer(frame.body.index(), writer, frame.body);
  constexpr std::uint64_t kNoCode = 0;
  if (frame.secured) writer.number(kNoCode, kCodeBytes);
  out.size_ = out.data_.size() - writer.left();
}

}  // namespace groma::mac
