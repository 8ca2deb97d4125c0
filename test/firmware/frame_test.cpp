#include "firmware/core/mac/frame.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <random>

#include "test/support/random_bodies.hpp"

namespace groma::mac {
namespace {

using ranging::Ticks;

std::vector<std::uint8_t> bytes_of(const Frame& frame) {
  const FrameBytes out = serialize(frame);
  return {out.bytes().begin(), out.bytes().end()};
}

Frame with(const Body& body) {
  return {.sequence = 0x5A, .network = 0xBEEF, .destination = 0x1234, .source = 0x0102, .body = body};
}

Poll full_poll() {
  Poll poll{.exchange = 0xFFFE, .superframe = 0xFFFFFFFF, .slot = 15, .count = kMaxAnchors};
  for (std::size_t i = 0; i < kMaxAnchors; ++i) poll.anchors[i] = static_cast<std::uint16_t>(1000 * i + 7);
  return poll;
}

TEST(Frame, HasTheLayoutOfTheHeaderFile) {
  const auto bytes = bytes_of(with(Final{.exchange = 0x0A0B}));
  const std::vector<std::uint8_t> expected{0x41, 0x88, 0x5A, 0xEF, 0xBE, 0x34,
                                           0x12, 0x02, 0x01, 4,    0x0B, 0x0A};
  EXPECT_EQ(bytes, expected);
}

TEST(Frame, LengthsMatchTheSchedulesAssumptions) {
  Beacon beacon{.slots = 5};
  EXPECT_EQ(bytes_of(with(beacon)).size() + 2, beacon_bytes(5, false));
  beacon.challenge_response = ChallengeResponse{};
  EXPECT_EQ(bytes_of(with(beacon)).size() + 2, beacon_bytes(5, true));
  EXPECT_EQ(bytes_of(with(Join{})).size() + 2, kJoinBytes);
  EXPECT_EQ(bytes_of(with(Data{.fragments = 1, .size = 48})).size() + 2, data_bytes(48));
  EXPECT_EQ(bytes_of(with(Response{})).size() + 2, kResponseBytes);
  EXPECT_EQ(bytes_of(with(Final{})).size() + 2, kFinalBytes);
  EXPECT_EQ(bytes_of(with(full_poll())).size() + 2, poll_bytes(kMaxAnchors));
  EXPECT_EQ(bytes_of(with(Poll{})).size() + 2, poll_bytes(0));
  EXPECT_LE(poll_bytes(kMaxAnchors), radio::kMaxFrameBytes);
}

TEST(Frame, RoundTrips) {
  {
    Beacon sent{.superframe = 0x89ABCDEF,
                .session = 0x1122'3344'5566'7788,
                .epoch = 0x01234567,
                .schedule_hash = 0xFEDCBA98,
                .master = 0xABCD,
                .hop = 3,
                .age = 0xFF,
                .tx_offset_dtu = -511,
                .dissolving = true,
                .shared = true,
                .quiet = true,
                .merge_request = true,
                .place = ranging::Ticks(0x12'3456'789A),
                .slots = 2,
                .challenge_response = ChallengeResponse{.id = 0x7766, .nonce = 0x8899'AABB'CCDD'EEFF}};
    sent.owners[0] = kBroadcast;
    sent.owners[1] = 0x0203;
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    EXPECT_EQ(parsed.frame->sequence, 0x5A);
    EXPECT_EQ(parsed.frame->network, 0xBEEF);
    EXPECT_EQ(parsed.frame->destination, 0x1234);
    EXPECT_EQ(parsed.frame->source, 0x0102);
    const auto& beacon = std::get<Beacon>(parsed.frame->body);
    EXPECT_EQ(beacon.superframe, 0x89ABCDEF);
    EXPECT_EQ(beacon.epoch, 0x01234567U);
    EXPECT_EQ(beacon.schedule_hash, 0xFEDCBA98);
    EXPECT_EQ(beacon.session, sent.session);
    EXPECT_EQ(beacon.master, sent.master);
    EXPECT_EQ(beacon.hop, sent.hop);
    EXPECT_EQ(beacon.age, sent.age);
    EXPECT_EQ(beacon.tx_offset_dtu, sent.tx_offset_dtu);
    EXPECT_TRUE(beacon.dissolving);
    EXPECT_TRUE(beacon.shared);
    EXPECT_TRUE(beacon.merge_request);
    EXPECT_TRUE(beacon.quiet);
    EXPECT_EQ(beacon.place, sent.place);
    EXPECT_EQ(beacon.slots, sent.slots);
    EXPECT_EQ(beacon.owners, sent.owners);
    ASSERT_TRUE(beacon.challenge_response);
    EXPECT_EQ(beacon.challenge_response->id, sent.challenge_response->id);
    EXPECT_EQ(beacon.challenge_response->nonce, sent.challenge_response->nonce);
  }
  {
    Poll sent = full_poll();
    sent.lent = true;
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& poll = std::get<Poll>(parsed.frame->body);
    EXPECT_EQ(poll.exchange, sent.exchange);
    EXPECT_EQ(poll.superframe, sent.superframe);
    EXPECT_EQ(poll.slot, sent.slot);
    EXPECT_TRUE(poll.lent);
    EXPECT_EQ(poll.count, sent.count);
    EXPECT_EQ(poll.anchors, sent.anchors);
  }
  for (const bool valid : {false, true}) {
    const Response sent{.exchange = 0x8001,
                        .reply = Ticks((std::int64_t{1} << 32) - 1),
                        .closing_valid = valid,
                        .closed_exchange = 0x8000,
                        .closing = Ticks((std::int64_t{1} << 40) - 1),
                        .health = {.temperature_c = -40, .supply_64ths_v = 211}};
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& response = std::get<Response>(parsed.frame->body);
    EXPECT_EQ(response.exchange, sent.exchange);
    EXPECT_EQ(response.reply, sent.reply);
    EXPECT_EQ(response.closing_valid, valid);
    EXPECT_EQ(response.closed_exchange, sent.closed_exchange);
    EXPECT_EQ(response.closing, sent.closing);
    EXPECT_EQ(response.health, sent.health);
  }
  for (const bool set : {false, true}) {
    const Join sent{.origin = 0x0708,
                    .nonce = 0x0102'0304'0506'0708,
                    .tag = set,
                    .wants_slot = !set,
                    .wants_challenge_response = set,
                    .leaving = !set};
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& join = std::get<Join>(parsed.frame->body);
    EXPECT_EQ(join.origin, sent.origin);
    EXPECT_EQ(join.nonce, sent.nonce);
    EXPECT_EQ(join.tag, set);
    EXPECT_EQ(join.wants_slot, !set);
    EXPECT_EQ(join.wants_challenge_response, set);
    EXPECT_EQ(join.leaving, !set);
  }
  for (const std::uint8_t size : {std::uint8_t{0}, std::uint8_t{1}, std::uint8_t{48}}) {
    Data sent{.origin = 0x1112,
              .target = 0x2122,
              .message = 9,
              .fragment = 3,
              .fragments = 4,
              .asks = size % 2 == 0,
              .hops_left = static_cast<std::uint8_t>(size % 4),
              .round = static_cast<std::uint8_t>(size % 8),
              .size = size};
    for (std::size_t i = 0; i < size; ++i) sent.payload[i] = static_cast<std::uint8_t>(i + 1);
    sent.to_host = size == 1;
    sent.acknowledgement = size == 0;
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& data = std::get<Data>(parsed.frame->body);
    EXPECT_EQ(data.origin, sent.origin);
    EXPECT_EQ(data.target, sent.target);
    EXPECT_EQ(data.message, sent.message);
    EXPECT_EQ(data.fragment, sent.fragment);
    EXPECT_EQ(data.fragments, sent.fragments);
    EXPECT_EQ(data.to_host, sent.to_host);
    EXPECT_EQ(data.asks, sent.asks);
    EXPECT_EQ(data.hops_left, sent.hops_left);
    EXPECT_EQ(data.round, sent.round);
    EXPECT_EQ(data.acknowledgement, sent.acknowledgement);
    EXPECT_EQ(data.size, size);
    EXPECT_EQ(data.payload, sent.payload);
  }
}

TEST(Frame, ASecuredFrameIsLongerByItsMic) {
  for (const Body& body :
       {Body(Beacon{}), Body(full_poll()), Body(Response{}), Body(Final{}), Body(Join{})}) {
    Frame frame = with(body);
    const std::size_t plain = bytes_of(frame).size();
    frame.secured = true;
    auto bytes = bytes_of(frame);
    EXPECT_EQ(bytes.size(), plain + kCodeBytes);
    const auto parsed = parse(bytes);
    ASSERT_TRUE(parsed.frame);
    EXPECT_TRUE(parsed.frame->secured);
    EXPECT_EQ(parsed.frame->body.index(), body.index());
    bytes.resize(plain);
    EXPECT_FALSE(parse(bytes).frame);
  }
  EXPECT_LE(poll_bytes(kMaxAnchors) + kCodeBytes, radio::kMaxFrameBytes);
}

// Each copy ends with its own allocation, so that a sanitizer sees any read beyond it.
ParseResult parse_exact(const std::vector<std::uint8_t>& bytes) {
  const auto copy = std::make_unique<std::uint8_t[]>(bytes.size());
  std::copy(bytes.begin(), bytes.end(), copy.get());
  return parse(std::span<const std::uint8_t>(copy.get(), bytes.size()));
}

TEST(Frame, ATruncatedOrExtendedFrameIsRejected) {
  for (const Body& body :
       {Body(Beacon{}), Body(full_poll()), Body(Response{}), Body(Final{}), Body(Join{})}) {
    auto bytes = bytes_of(with(body));
    for (std::size_t n = 0; n < bytes.size(); ++n) {
      const auto result = parse_exact({bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(n)});
      EXPECT_FALSE(result.frame) << n;
      EXPECT_EQ(result.error, n < kHeaderBytes ? ParseError::kForeign : ParseError::kMalformed) << n;
    }
    bytes.push_back(0);
    EXPECT_FALSE(parse_exact(bytes).frame);
  }
}

TEST(Frame, APollWhoseCountDiffersFromItsLengthIsMalformed) {
  auto bytes = bytes_of(with(full_poll()));
  bytes[17] = kMaxAnchors - 1;
  EXPECT_FALSE(parse_exact(bytes).frame);
  bytes[17] = kMaxAnchors + 1;
  bytes.resize(bytes.size() + 2);
  EXPECT_FALSE(parse_exact(bytes).frame);
  bytes[17] = 0xFF;
  EXPECT_FALSE(parse_exact(bytes).frame);
}

TEST(Frame, OtherFrameControlIsForeign) {
  auto bytes = bytes_of(with(Beacon{}));
  bytes[0] = 0x42;
  EXPECT_EQ(parse_exact(bytes).error, ParseError::kForeign);
  bytes[0] = 0x41;
  bytes[9] = 7;
  EXPECT_EQ(parse_exact(bytes).error, ParseError::kMalformed);
}

TEST(Frame, AnyBytesAreParsedWithoutHarmAndOnlyCanonicalOnesAccepted) {
  std::mt19937_64 random(11);
  std::size_t accepted = 0;
  for (int i = 0; i < 700'000; ++i) {
    std::vector<std::uint8_t> bytes(static_cast<std::size_t>(random() % 100));
    for (auto& byte : bytes) byte = static_cast<std::uint8_t>(random());
    // Mostly with a valid header, so that the body is parsed.
    if (bytes.size() >= kHeaderBytes && i % 4 != 0) {
      bytes[0] = 0x41;
      bytes[1] = 0x88;
      const auto type = static_cast<std::uint8_t>(random() % 8);
      const std::size_t mic_bytes = i % 3 == 0 ? kCodeBytes : 0;
      bytes[9] = static_cast<std::uint8_t>(type | (mic_bytes != 0 ? 0x80U : 0U));
      if (type == 2 && bytes.size() > 17 + mic_bytes)
        bytes[17] = static_cast<std::uint8_t>((bytes.size() - mic_bytes - 18) / 2);
    }
    const auto result = parse_exact(bytes);
    if (!result.frame) continue;
    ++accepted;
    auto again = bytes_of(*result.frame);
    ASSERT_EQ(again.size(), bytes.size());
    if (result.frame->secured)
      std::copy(bytes.end() - kCodeBytes, bytes.end(), again.end() - kCodeBytes);  // the MIC is not parsed
    ASSERT_EQ(again, bytes);
  }
  EXPECT_GT(accepted, 1000U);
}

class RandomFrames {
 public:
  Frame next() {
    return {.sequence = bodies_.word<std::uint8_t>(),
            .network = bodies_.word<std::uint16_t>(),
            .destination = bodies_.word<std::uint16_t>(),
            .source = bodies_.word<std::uint16_t>(),
            .secured = bodies_.coin(),
            .body = body()};
  }
  std::size_t below(std::size_t bound) { return bodies_.below(bound); }

 private:
  Body body() {
    switch (below(6)) {
      case 0:
        return bodies_.beacon();
      case 1:
        return bodies_.poll();
      case 2:
        return bodies_.response();
      case 3:
        return bodies_.final();
      case 4:
        return bodies_.join();
      default:
        return bodies_.data();
    }
  }

  RandomBodies bodies_{12};
};

TEST(Frame, AnyFrameRoundTripsAndNoOtherLengthIsAccepted) {
  RandomFrames frames;
  for (int i = 0; i < 300'000; ++i) {
    const Frame sent = frames.next();
    const auto bytes = bytes_of(sent);
    const auto result = parse_exact(bytes);
    ASSERT_TRUE(result.frame) << sent.body.index();
    ASSERT_TRUE(*result.frame == sent) << sent.body.index();
    // Only DATA may have another length: its payload extends to the end of the frame.
    const auto* data = std::get_if<Data>(&sent.body);
    if (i % 4 != 0) continue;
    auto other = bytes;
    other.resize(frames.below(radio::kMaxFrameBytes - 1U));
    if (other.size() == bytes.size()) continue;
    const std::size_t shortest = bytes.size() - (data != nullptr ? data->size : 0);
    const bool fits = data != nullptr && other.size() >= shortest && other.size() - shortest <= kMaxDataBytes;
    ASSERT_EQ(parse_exact(other).frame.has_value(), fits) << sent.body.index() << ' ' << other.size();
  }
}

}  // namespace
}  // namespace groma::mac
