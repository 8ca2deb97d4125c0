#include "proto/can_segment.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "proto/frame_codec.hpp"

namespace groma::wire {
namespace {

using Bytes = std::vector<std::uint8_t>;

std::vector<CanFrame> cut(Bytes stream, CanFormat format) {
  std::vector<CanFrame> frames;
  std::span<const std::uint8_t> left(stream);
  while (!left.empty()) {
    CanFrame frame;
    frame.id = can_id({CanDirection::kToHost, 3});
    const std::size_t taken = cut_can_payload(left, format, frame);
    EXPECT_GT(taken, 0U);
    left = left.subspan(taken);
    frames.push_back(frame);
  }
  return frames;
}

Bytes encoded(std::size_t size, std::uint8_t seed) {
  Bytes payload(size);
  for (std::size_t i = 0; i < size; ++i) payload[i] = static_cast<std::uint8_t>(seed + 7 * i);
  Bytes frame(max_encoded_size(size));
  frame.resize(encode_frame(payload, frame));
  return frame;
}

TEST(CanId, IsAsDocumentedAndDecodesToTheAddress) {
  EXPECT_EQ(can_id({CanDirection::kToHost, 3}), 0x16000003U);
  EXPECT_EQ(can_id({CanDirection::kToNode, 3}), 0x16010003U);
  EXPECT_EQ(can_id({CanDirection::kToNode, 0xFFFF}), 0x1601FFFFU);
  for (std::uint32_t node = 0; node <= 0xFFFF; ++node) {
    for (const CanDirection direction : {CanDirection::kToHost, CanDirection::kToNode}) {
      const CanAddress address{direction, static_cast<std::uint16_t>(node)};
      ASSERT_LE(can_id(address), kCanIdBits);
      ASSERT_EQ(can_address(can_id(address)), address);
    }
  }
}

TEST(CanId, OfAnotherProtocolIsRejected) {
  // Flips each fixed bit, and each bit beyond the 29 bits, where SocketCAN has its flags.
  for (unsigned bit = 17; bit < 32; ++bit) {
    EXPECT_FALSE(can_address(can_id({CanDirection::kToHost, 3}) ^ (1U << bit))) << bit;
    EXPECT_FALSE(can_address(can_id({CanDirection::kToNode, 3}) ^ (1U << bit))) << bit;
  }
}

TEST(CanLength, HasEachLengthOfTheFormat) {
  for (std::size_t size = 0; size <= 8; ++size) EXPECT_EQ(can_length_code(size), size);
  EXPECT_EQ(can_length_code(9), 9U);
  EXPECT_EQ(can_length_code(12), 9U);
  EXPECT_EQ(can_length_code(13), 10U);
  EXPECT_EQ(can_length_code(25), 13U);
  EXPECT_EQ(can_length_code(33), 14U);
  EXPECT_EQ(can_length_code(48), 14U);
  EXPECT_EQ(can_length_code(49), 15U);
  EXPECT_EQ(can_length_code(64), 15U);
}

TEST(CanSegment, ClassicPayloadsHoldTheStreamUnchanged) {
  for (std::size_t size = 0; size < 100; ++size) {
    const Bytes stream = encoded(size, 1);
    const auto frames = cut(stream, CanFormat::kClassic);
    ASSERT_EQ(frames.size(), (stream.size() + 7) / 8);
    Bytes joined;
    for (const CanFrame& frame : frames) {
      EXPECT_FALSE(frame.bit_rate_switch);
      ASSERT_LE(frame.size, 8U);
      const auto bytes = stream_in(frame, {CanDirection::kToHost, 3});
      joined.insert(joined.end(), bytes.begin(), bytes.end());
    }
    EXPECT_EQ(joined, stream);
  }
}

TEST(CanSegment, FdPayloadsArePaddedWithZerosThatTheDecoderSkips) {
  FrameDecoder decoder;
  std::uint32_t sent = 0;
  for (std::size_t size = 0; size < 300; ++size) {
    for (const CanFrame& frame : cut(encoded(size, 9), CanFormat::kFd)) {
      EXPECT_TRUE(frame.bit_rate_switch);
      ASSERT_EQ(kCanLengths[can_length_code(frame.size)], frame.size);
      for (const std::uint8_t byte : stream_in(frame, {CanDirection::kToHost, 3})) {
        if (decoder.push(byte)) {
          EXPECT_EQ(decoder.payload().size(), size);
        }
      }
    }
    ++sent;
  }
  EXPECT_EQ(decoder.counters().frames, sent);
  EXPECT_EQ(decoder.counters().bytes_discarded, 0U);
}

TEST(CanSegment, ALostPayloadLosesOneFrameAndIsCounted) {
  for (const CanFormat format : {CanFormat::kClassic, CanFormat::kFd}) {
    const Bytes middle = encoded(200, 5);
    const std::size_t pieces = cut(middle, format).size();
    for (std::size_t lost = 0; lost < pieces; ++lost) {
      FrameDecoder decoder;
      const auto take = [&decoder](const std::vector<CanFrame>& frames, std::size_t without) {
        for (std::size_t i = 0; i < frames.size(); ++i) {
          if (i == without) continue;
          for (const std::uint8_t byte : frames[i].payload()) decoder.push(byte);
        }
      };
      take(cut(encoded(20, 1), format), pieces);
      take(cut(middle, format), lost);
      take(cut(encoded(20, 2), format), pieces);
      EXPECT_EQ(decoder.counters().frames, 2U) << lost;
      EXPECT_GT(decoder.counters().bytes_discarded, 0U) << lost;
    }
  }
}

TEST(CanSegment, TakesOnlyPayloadsOfItsNodeAndDirection) {
  const CanFrame frame = cut(encoded(20, 1), CanFormat::kFd).front();
  EXPECT_EQ(stream_in(frame, {CanDirection::kToHost, 3}).size(), frame.size);
  EXPECT_TRUE(stream_in(frame, {CanDirection::kToHost, 4}).empty());
  EXPECT_TRUE(stream_in(frame, {CanDirection::kToNode, 3}).empty());
}

TEST(CanSegment, CutsNothingFromAnEmptyStream) {
  CanFrame frame;
  EXPECT_EQ(cut_can_payload({}, CanFormat::kClassic, frame), 0U);
  EXPECT_EQ(frame.size, 0U);
}

}  // namespace
}  // namespace groma::wire
