#include "firmware/core/mac/frame.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <random>

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

TEST(Frame, HasTheBytesThatTheHeaderPromises) {
  const auto bytes = bytes_of(with(Final{.exchange = 0x0A0B}));
  const std::vector<std::uint8_t> expected{0x41, 0x88, 0x5A, 0xEF, 0xBE, 0x34,
                                           0x12, 0x02, 0x01, 4,    0x0B, 0x0A};
  EXPECT_EQ(bytes, expected);
}

TEST(Frame, LengthsAreThoseTheScheduleCountsOn) {
  EXPECT_EQ(bytes_of(with(Beacon{})).size() + 2, kBeaconBytes);
  EXPECT_EQ(bytes_of(with(Response{})).size() + 2, kResponseBytes);
  EXPECT_EQ(bytes_of(with(Final{})).size() + 2, kFinalBytes);
  EXPECT_EQ(bytes_of(with(full_poll())).size() + 2, poll_bytes(kMaxAnchors));
  EXPECT_EQ(bytes_of(with(Poll{})).size() + 2, poll_bytes(0));
  EXPECT_LE(poll_bytes(kMaxAnchors), dw1000::kMaxFrameBytes);
}

TEST(Frame, ComesBackAsItWent) {
  {
    const auto parsed = parse(bytes_of(with(Beacon{0x89ABCDEF, 0x01234567, 0xFEDCBA98})));
    ASSERT_TRUE(parsed.frame);
    EXPECT_EQ(parsed.frame->sequence, 0x5A);
    EXPECT_EQ(parsed.frame->network, 0xBEEF);
    EXPECT_EQ(parsed.frame->destination, 0x1234);
    EXPECT_EQ(parsed.frame->source, 0x0102);
    const auto& beacon = std::get<Beacon>(parsed.frame->body);
    EXPECT_EQ(beacon.superframe, 0x89ABCDEF);
    EXPECT_EQ(beacon.epoch, 0x01234567U);
    EXPECT_EQ(beacon.schedule_hash, 0xFEDCBA98);
  }
  {
    const Poll sent = full_poll();
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& poll = std::get<Poll>(parsed.frame->body);
    EXPECT_EQ(poll.exchange, sent.exchange);
    EXPECT_EQ(poll.superframe, sent.superframe);
    EXPECT_EQ(poll.slot, sent.slot);
    EXPECT_EQ(poll.count, sent.count);
    EXPECT_EQ(poll.anchors, sent.anchors);
  }
  for (const bool valid : {false, true}) {
    const Response sent{.exchange = 0x8001,
                        .reply = Ticks((std::int64_t{1} << 32) - 1),
                        .closing_valid = valid,
                        .closed_exchange = 0x8000,
                        .closing = Ticks((std::int64_t{1} << 40) - 1)};
    const auto parsed = parse(bytes_of(with(sent)));
    ASSERT_TRUE(parsed.frame);
    const auto& response = std::get<Response>(parsed.frame->body);
    EXPECT_EQ(response.exchange, sent.exchange);
    EXPECT_EQ(response.reply, sent.reply);
    EXPECT_EQ(response.closing_valid, valid);
    EXPECT_EQ(response.closed_exchange, sent.closed_exchange);
    EXPECT_EQ(response.closing, sent.closing);
  }
}

// Each copy sits at the very end of its own allocation, so that a sanitizer sees any read beyond it.
ParseResult parse_exact(const std::vector<std::uint8_t>& bytes) {
  const auto copy = std::make_unique<std::uint8_t[]>(bytes.size());
  std::copy(bytes.begin(), bytes.end(), copy.get());
  return parse(std::span<const std::uint8_t>(copy.get(), bytes.size()));
}

TEST(Frame, CutOrLengthenedIsNoFrame) {
  for (const Body& body : {Body(Beacon{}), Body(full_poll()), Body(Response{}), Body(Final{})}) {
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

TEST(Frame, APollThatNamesMoreThanItCarriesIsMalformed) {
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
  bytes[9] = 5;
  EXPECT_EQ(parse_exact(bytes).error, ParseError::kMalformed);
}

TEST(Frame, AnyBytesAreParsedWithoutHarmAndOnlyCanonicalOnesAccepted) {
  std::mt19937_64 random(11);
  std::size_t accepted = 0;
  for (int i = 0; i < 500'000; ++i) {
    std::vector<std::uint8_t> bytes(static_cast<std::size_t>(random() % 70));
    for (auto& byte : bytes) byte = static_cast<std::uint8_t>(random());
    // Mostly with a header that leads into the bodies.
    if (bytes.size() >= kHeaderBytes && i % 4 != 0) {
      bytes[0] = 0x41;
      bytes[1] = 0x88;
      bytes[9] = static_cast<std::uint8_t>(random() % 6);
      if (bytes[9] == 2 && bytes.size() > 17) bytes[17] = static_cast<std::uint8_t>((bytes.size() - 18) / 2);
    }
    const auto result = parse_exact(bytes);
    if (!result.frame) continue;
    ++accepted;
    auto again = bytes_of(*result.frame);
    if (std::holds_alternative<Response>(result.frame->body)) {
      again[16] = bytes[16];  // unused flags are not kept
    }
    ASSERT_EQ(again, bytes);
  }
  EXPECT_GT(accepted, 1000U);
}

}  // namespace
}  // namespace groma::mac
