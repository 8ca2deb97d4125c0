#include "proto/frame_codec.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <string_view>
#include <vector>

#include "groma.pb.h"
#include "proto/crc32.hpp"

namespace groma::wire {
namespace {

using Bytes = std::vector<std::uint8_t>;

// SplitMix64: identical numbers on every machine.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}

  std::uint64_t next() {
    std::uint64_t z = (state_ += 0x9E3779B97F4A7C15U);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9U;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBU;
    return z ^ (z >> 31);
  }
  std::size_t below(std::size_t n) { return static_cast<std::size_t>(next() % n); }
  std::uint8_t byte() { return static_cast<std::uint8_t>(next() >> 56); }
  Bytes bytes(std::size_t n) {
    Bytes out(n);
    for (auto& b : out) b = byte();
    return out;
  }

 private:
  std::uint64_t state_;
};

Bytes encode(const Bytes& payload) {
  Bytes out(max_encoded_size(payload.size()));
  out.resize(encode_frame(payload, out));
  return out;
}

std::vector<Bytes> push_all(FrameDecoder& decoder, const Bytes& bytes) {
  std::vector<Bytes> frames;
  for (const std::uint8_t byte : bytes) {
    if (decoder.push(byte)) frames.emplace_back(decoder.payload().begin(), decoder.payload().end());
  }
  return frames;
}

std::vector<Bytes> decode(const Bytes& bytes) {
  FrameDecoder decoder;
  return push_all(decoder, bytes);
}

// The definition: bitwise long division by x^32 + x^26 + ..., with reflected bytes.
std::uint32_t crc32_bit_by_bit(const Bytes& bytes) {
  std::uint32_t remainder = 0xFFFFFFFFU;
  for (const std::uint8_t byte : bytes) {
    for (int bit = 0; bit < 8; ++bit) {
      const bool in = ((byte >> bit) & 1) != 0;
      const bool top = (remainder & 0x80000000U) != 0;
      remainder <<= 1;
      if (in != top) remainder ^= 0x04C11DB7U;
    }
  }
  std::uint32_t reflected = 0;
  for (unsigned bit = 0; bit < 32; ++bit) reflected |= ((remainder >> bit) & 1U) << (31U - bit);
  return ~reflected;
}

// COBS by its definition: split at zeros and after 254 bytes.
Bytes cobs_by_definition(Bytes plain) {
  plain.push_back(0);
  Bytes out;
  std::size_t begin = 0;
  while (begin < plain.size()) {
    const auto zero = static_cast<std::size_t>(
        std::find(plain.begin() + static_cast<std::ptrdiff_t>(begin), plain.end(), 0) - plain.begin());
    const std::size_t length = std::min<std::size_t>(zero - begin, 254);
    out.push_back(static_cast<std::uint8_t>(length + 1));
    out.insert(out.end(), plain.begin() + static_cast<std::ptrdiff_t>(begin),
               plain.begin() + static_cast<std::ptrdiff_t>(begin + length));
    begin += length + (length < 254 ? 1 : 0);
  }
  return out;
}

TEST(Crc32, HasThePublishedCheckValue) {
  constexpr std::string_view kText = "123456789";
  EXPECT_EQ(crc32(Bytes(kText.begin(), kText.end())), 0xCBF43926U);
  EXPECT_EQ(crc32({}), 0U);
}

TEST(Crc32, EqualsTheBitByBitDivision) {
  Random random(1);
  for (std::size_t n = 0; n < 600; ++n) {
    const Bytes bytes = random.bytes(n);
    ASSERT_EQ(crc32(bytes), crc32_bit_by_bit(bytes)) << n;
  }
}

TEST(FrameCodec, HoldsTheLargestMessageOfTheSchema) {
  static_assert(kMaxPayload >= groma_NodeToHost_size);
  static_assert(kMaxPayload >= groma_HostToNode_size);
  EXPECT_LE(sizeof(FrameDecoder), kMaxPayload + 96);
}

TEST(FrameCodec, EncodesAsDefined) {
  Random random(2);
  for (const std::size_t n : {0U, 1U, 5U, 248U, 249U, 250U, 253U, 254U, 255U, 503U, 504U, 1472U}) {
    for (int fill = 0; fill < 3; ++fill) {
      Bytes payload = random.bytes(n);
      if (fill == 1) std::fill(payload.begin(), payload.end(), std::uint8_t{0});
      if (fill == 2) std::replace(payload.begin(), payload.end(), std::uint8_t{0}, std::uint8_t{7});
      Bytes plain{kFrameVersion};
      plain.insert(plain.end(), payload.begin(), payload.end());
      const std::uint32_t crc = crc32_bit_by_bit(plain);
      for (unsigned shift = 0; shift < 32; shift += 8)
        plain.push_back(static_cast<std::uint8_t>(crc >> shift));
      Bytes expected{0};
      const Bytes cobs = cobs_by_definition(plain);
      expected.insert(expected.end(), cobs.begin(), cobs.end());
      expected.push_back(0);
      ASSERT_EQ(encode(payload), expected) << n << " bytes, fill " << fill;
    }
  }
}

TEST(FrameCodec, RoundTripsEachSizeWithAndWithoutZeros) {
  Random random(3);
  FrameDecoder decoder;
  std::uint32_t frames = 0;
  for (std::size_t n = 0; n <= kMaxPayload; ++n) {
    for (int fill = 0; fill < 4; ++fill) {
      Bytes payload = random.bytes(n);
      if (fill == 1) std::fill(payload.begin(), payload.end(), std::uint8_t{0});
      if (fill == 2) std::fill(payload.begin(), payload.end(), std::uint8_t{0xFF});
      if (fill == 3) {
        for (auto& b : payload) b = static_cast<std::uint8_t>(b & 1U);
      }
      const Bytes frame = encode(payload);
      ASSERT_LE(frame.size(), max_encoded_size(n));
      ASSERT_EQ(std::count(frame.begin(), frame.end(), 0), 2);
      const auto decoded = push_all(decoder, frame);
      ASSERT_EQ(decoded.size(), 1U) << n;
      ASSERT_EQ(decoded[0], payload) << n;
      ASSERT_EQ(decoder.encoded_size(), frame.size());
      ++frames;
    }
  }
  EXPECT_EQ(decoder.counters().frames, frames);
  EXPECT_EQ(decoder.counters().bytes_discarded, 0U);
}

TEST(FrameCodec, TheWorstCaseFillsExactlyTheStatedSize) {
  // If version, payload and CRC contain no zero, each 254 bytes need one byte more.
  Random random(4);
  for (const std::size_t n : {249U, 503U, 1265U}) {
    Bytes frame;
    do {
      Bytes payload = random.bytes(n);
      std::replace(payload.begin(), payload.end(), std::uint8_t{0}, std::uint8_t{1});
      frame = encode(payload);
    } while (frame.size() < max_encoded_size(n));
    EXPECT_EQ(frame.size(), max_encoded_size(n));
  }
}

TEST(FrameCodec, RejectsWhatDoesNotFit) {
  Bytes out(max_encoded_size(kMaxPayload + 1));
  EXPECT_EQ(encode_frame(Bytes(kMaxPayload + 1, 1), out), 0U);
  for (const std::size_t n : {0U, 10U, 300U}) {
    const Bytes payload(n, 1);
    Bytes tight(max_encoded_size(n));
    EXPECT_NE(encode_frame(payload, tight), 0U);
    tight.resize(max_encoded_size(n) - 1);
    tight.assign(tight.size(), 0xAA);
    EXPECT_EQ(encode_frame(payload, tight), 0U);
    EXPECT_EQ(std::count(tight.begin(), tight.end(), 0xAA), static_cast<std::ptrdiff_t>(tight.size()));
  }
}

TEST(FrameDecoder, CountsAFrameOfAnotherVersion) {
  // Version 2, payload {9}, a valid CRC.
  Bytes plain{2, 9};
  const std::uint32_t crc = crc32(plain);
  for (unsigned shift = 0; shift < 32; shift += 8) plain.push_back(static_cast<std::uint8_t>(crc >> shift));
  Bytes stream = cobs_by_definition(plain);
  stream.push_back(0);
  FrameDecoder decoder;
  EXPECT_TRUE(push_all(decoder, stream).empty());
  EXPECT_EQ(decoder.counters().version_errors, 1U);
  EXPECT_EQ(decoder.counters().bytes_discarded, stream.size() - 1);
}

TEST(FrameDecoder, CountsDroppedBytesByCause) {
  FrameDecoder decoder;
  EXPECT_TRUE(push_all(decoder, {5, 1, 2, 0}).empty());
  EXPECT_EQ(decoder.counters().cobs_errors, 1U);
  EXPECT_TRUE(push_all(decoder, {3, 1, 2, 0}).empty());
  EXPECT_EQ(decoder.counters().truncated, 1U);
  EXPECT_TRUE(push_all(decoder, {8, 1, 2, 3, 4, 5, 6, 7, 0}).empty());
  EXPECT_EQ(decoder.counters().crc_errors, 1U);
  EXPECT_TRUE(push_all(decoder, Bytes(100'000, 1)).empty());
  EXPECT_TRUE(push_all(decoder, {0}).empty());
  EXPECT_EQ(decoder.counters().oversize, 1U);
  EXPECT_EQ(decoder.counters().bytes_discarded, 3U + 3U + 8U + 100'000U);
  EXPECT_TRUE(push_all(decoder, {0, 0, 0}).empty());
  EXPECT_EQ(push_all(decoder, encode({1, 2, 3})), std::vector<Bytes>({{1, 2, 3}}));
  EXPECT_EQ(decoder.counters().bytes_discarded, 100'014U);
}

TEST(FrameDecoder, ResetDiscardsAPartialFrame) {
  const Bytes frame = encode({1, 2, 3, 4});
  FrameDecoder decoder;
  push_all(decoder, Bytes(frame.begin(), frame.begin() + 5));
  decoder.reset();
  EXPECT_EQ(decoder.counters().bytes_discarded, 4U);
  EXPECT_TRUE(push_all(decoder, Bytes(frame.begin() + 5, frame.end())).empty());
  EXPECT_EQ(push_all(decoder, frame).size(), 1U);
}

// A frame with one or two flipped bits yields nothing, except that a flipped bit in the leading or closing
// zero may leave the frame itself intact.
TEST(FrameDecoder, AcceptsNoFrameWithOneOrTwoBitsFlipped) {
  Random random(5);
  for (const std::size_t n : {0U, 1U, 7U, 24U, 60U}) {
    for (int fill = 0; fill < 2; ++fill) {
      Bytes payload = random.bytes(n);
      if (fill == 1) {
        for (auto& b : payload) b = (b & 3U) != 0 ? std::uint8_t{0} : b;
      }
      const Bytes frame = encode(payload);
      const std::size_t bits = frame.size() * 8;
      Bytes bad = frame;
      const auto flip = [&](std::size_t bit) {
        bad[bit / 8] = static_cast<std::uint8_t>(bad[bit / 8] ^ (1U << (bit % 8)));
      };
      for (std::size_t i = 0; i < bits; ++i) {
        flip(i);
        for (std::size_t j = i; j < bits; ++j) {
          if (j != i) flip(j);
          Bytes stream = bad;
          stream.push_back(0);
          for (const Bytes& got : decode(stream)) ASSERT_EQ(got, payload) << i << " " << j;
          const bool framing_only = (j < 8 || j >= bits - 8) && (i < 8 || i >= bits - 8);
          if (!framing_only) {
            ASSERT_TRUE(decode(stream).empty()) << n << " bytes, bits " << i << " " << j;
          }
          if (j != i) flip(j);
        }
        flip(i);
      }
    }
  }
}

TEST(FrameDecoder, AcceptsNoLongFrameWithOneBitFlipped) {
  Random random(6);
  const Bytes payload = random.bytes(700);
  Bytes frame = encode(payload);
  FrameDecoder decoder;
  for (std::size_t bit = 8; bit < (frame.size() - 1) * 8; ++bit) {
    frame[bit / 8] = static_cast<std::uint8_t>(frame[bit / 8] ^ (1U << (bit % 8)));
    ASSERT_TRUE(push_all(decoder, frame).empty()) << bit;
    frame[bit / 8] = static_cast<std::uint8_t>(frame[bit / 8] ^ (1U << (bit % 8)));
  }
  EXPECT_EQ(push_all(decoder, frame), std::vector<Bytes>({payload}));
}

TEST(FrameDecoder, LosesOnlyTheTruncatedFrame) {
  Random random(7);
  for (const std::size_t n : {0U, 3U, 40U, 600U}) {
    const Bytes first = random.bytes(n);
    const Bytes second = random.bytes(n + 1);
    const Bytes frame = encode(first);
    const Bytes next = encode(second);
    for (std::size_t cut = 0; cut < frame.size(); ++cut) {
      // First the end is missing, then the beginning.
      Bytes stream(frame.begin(), frame.begin() + static_cast<std::ptrdiff_t>(cut));
      stream.insert(stream.end(), next.begin(), next.end());
      const auto without_end = decode(stream);
      stream.assign(frame.begin() + static_cast<std::ptrdiff_t>(cut), frame.end());
      stream.insert(stream.end(), next.begin(), next.end());
      const auto without_begin = decode(stream);
      // Without its closing zero, the next frame's zero ends a frame; without its leading zero it is
      // complete.
      const bool whole_without_end = cut == frame.size() - 1;
      const bool whole_without_begin = cut <= 1;
      ASSERT_EQ(without_end,
                whole_without_end ? std::vector<Bytes>({first, second}) : std::vector<Bytes>({second}));
      ASSERT_EQ(without_begin,
                whole_without_begin ? std::vector<Bytes>({first, second}) : std::vector<Bytes>({second}));
    }
  }
}

TEST(FrameDecoder, LosesNoWholeFrameAmidGarbage) {
  Random random(8);
  FrameDecoder decoder;
  constexpr std::uint32_t kFrames = 20'000;
  for (std::uint32_t i = 0; i < kFrames; ++i) {
    Bytes stream = random.bytes(random.below(60));
    if (random.below(3) == 0) {
      const Bytes torn = encode(random.bytes(random.below(200)));
      stream.insert(stream.end(), torn.begin(),
                    torn.begin() + static_cast<std::ptrdiff_t>(random.below(torn.size() - 1)));
    }
    if (random.below(50) == 0) stream.insert(stream.end(), 3000, 0x55);
    const Bytes payload = random.bytes(random.below(300));
    const Bytes frame = encode(payload);
    stream.insert(stream.end(), frame.begin(), frame.end());
    const auto got = push_all(decoder, stream);
    ASSERT_EQ(got.size(), 1U) << i;
    ASSERT_EQ(got[0], payload) << i;
  }
  EXPECT_EQ(decoder.counters().frames, kFrames);
}

// Ten million tries of three kinds: well-formed COBS with random content, which only the CRC can reject;
// frames with a few damaged bytes; random bytes.
TEST(FrameDecoder, AcceptsNoFalseFrameInTenMillionTries) {
  Random random(9);
  FrameDecoder decoder;
  std::vector<Bytes> frames;
  for (std::size_t n = 0; n < 64; ++n) frames.push_back(encode(random.bytes(n)));
  std::uint64_t tries = 0;
  while (tries < 10'000'000) {
    switch (tries % 3) {
      case 0: {
        std::uint64_t word = random.next();
        const std::size_t length = 5 + (word & 15U);
        decoder.push(static_cast<std::uint8_t>(length + 2));
        decoder.push(kFrameVersion);
        for (std::size_t i = 0; i < length; ++i) {
          if (i % 8 == 0) word = random.next() | 0x0101010101010101U;
          ASSERT_FALSE(decoder.push(static_cast<std::uint8_t>(word >> (8 * (i % 8)))));
        }
        ASSERT_FALSE(decoder.push(0));
        break;
      }
      case 1: {
        const Bytes& frame = frames[random.below(frames.size())];
        const std::uint64_t word = random.next();
        const auto at = static_cast<std::size_t>(1 + word % (frame.size() - 2));
        const auto mask = static_cast<std::uint8_t>(1 + (word >> 32) % 255);
        const auto again = static_cast<std::size_t>(1 + (word >> 40) % (frame.size() - 2));
        for (std::size_t i = 0; i < frame.size(); ++i) {
          std::uint8_t byte = frame[i];
          if (i == at) byte ^= mask;
          if (i == again && again != at) byte = static_cast<std::uint8_t>(byte + (word >> 56));
          ASSERT_FALSE(decoder.push(byte));
        }
        break;
      }
      default: {
        std::uint64_t word = 0;
        const std::size_t length = 8 + random.below(24);
        for (std::size_t i = 0; i < length; ++i) {
          if (i % 8 == 0) word = random.next();
          ASSERT_FALSE(decoder.push(static_cast<std::uint8_t>(word >> (8 * (i % 8)))));
        }
        ASSERT_FALSE(decoder.push(0));
      }
    }
    ++tries;
  }
  EXPECT_EQ(decoder.counters().frames, 0U);
  // Many tries reach the CRC.
  EXPECT_GT(decoder.counters().crc_errors, 4'000'000U);
  EXPECT_EQ(decoder.counters().version_errors, 0U);
}

}  // namespace
}  // namespace groma::wire
