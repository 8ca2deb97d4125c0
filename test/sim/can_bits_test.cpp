#include "firmware/sim/can_bits.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <string>

#include "test/sim/can_bench.hpp"

namespace groma::sim {
namespace {

using wire::CanFormat;
using wire::CanFrame;

std::string binary(std::uint64_t value, int width) {
  std::string text;
  for (int bit = width - 1; bit >= 0; --bit) text += ((value >> bit) & 1U) != 0 ? '1' : '0';
  return text;
}

// Long division of the bits, extended by zeros for the remainder, by the generator polynomial.
std::string crc_by_division(const std::string& bits, const std::string& generator) {
  std::string work = bits + std::string(generator.size() - 1, '0');
  for (std::size_t i = 0; i + generator.size() <= work.size(); ++i) {
    if (work[i] == '0') continue;
    for (std::size_t k = 0; k < generator.size(); ++k) work[i + k] = work[i + k] == generator[k] ? '0' : '1';
  }
  return work.substr(bits.size());
}

std::string field_bits(const CanFrame& frame, bool error_passive) {
  const std::string id = binary(frame.id, 29);
  std::string bits = "0" + id.substr(0, 11) + "11" + id.substr(11) + "0";
  if (frame.format == CanFormat::kFd) {
    bits += std::string("10") + (frame.bit_rate_switch ? "1" : "0") + (error_passive ? "1" : "0");
  } else {
    bits += "00";
  }
  int code = 0;
  while (wire::kCanLengths[static_cast<std::size_t>(code)] != frame.size) ++code;
  bits += binary(static_cast<std::uint64_t>(code), 4);
  for (const std::uint8_t byte : frame.payload()) bits += binary(byte, 8);
  return bits;
}

// After five equal bits (stuff bits included) a bit of the other value follows, marked by a letter.
std::string stuffed(const std::string& bits) {
  std::string out;
  std::string plain;
  for (const char bit : bits) {
    out += bit;
    plain += bit;
    if (plain.size() < 5 || plain.find_first_not_of(bit, plain.size() - 5) != std::string::npos) continue;
    out += bit == '0' ? 'I' : 'O';
    plain += bit == '0' ? '1' : '0';
  }
  return out;
}

unsigned letters(const std::string& coded) {
  return static_cast<unsigned>(std::count_if(coded.begin(), coded.end(), [](char c) { return c > '9'; }));
}

CanBits by_brute_force(const CanFrame& frame, bool error_passive) {
  const std::string fields = field_bits(frame, error_passive);
  if (frame.format == CanFormat::kClassic) {
    const std::string coded = stuffed(fields + crc_by_division(fields, "1100010110011001"));
    return {.nominal = static_cast<unsigned>(coded.size()) + 10, .data = 0, .stuff = letters(coded)};
  }
  std::string coded = stuffed(fields);
  // The fixed stuff bit before the stuff count replaces it.
  if (coded.back() > '9') coded.pop_back();
  // Up to and including BRS: 1 + 11 + 2 + 18 + 1 + 3 bits of fields. A stuff bit after BRS belongs to the
  // data phase.
  std::size_t to_brs = 0;
  for (int left = 36; left > 0; ++to_brs) left -= coded[to_brs] > '9' ? 0 : 1;
  const unsigned crc = frame.size <= 16 ? 17 : 21;
  const unsigned fixed = crc == 17 ? 6 : 7;
  const auto before = static_cast<unsigned>(to_brs);
  const unsigned behind = static_cast<unsigned>(coded.size()) - before + 4 + crc + fixed + 1;
  const unsigned stuff = letters(coded) + fixed;
  if (!frame.bit_rate_switch) return {.nominal = before + behind + 9, .data = 0, .stuff = stuff};
  return {.nominal = before + 9, .data = behind, .stuff = stuff};
}

TEST(CanBits, AgreeWithBruteForceForManyFrames) {
  std::mt19937_64 random(11);
  for (int i = 0; i < 20'000; ++i) {
    CanFrame frame;
    frame.format = i % 2 == 0 ? CanFormat::kClassic : CanFormat::kFd;
    frame.bit_rate_switch = frame.format == CanFormat::kFd && i % 4 == 1;
    frame.id = static_cast<std::uint32_t>(random()) & wire::kCanIdBits;
    if (i % 3 == 0) frame.id &= 0x1C00'0007U;
    if (i % 3 == 1) frame.id |= 0x03FF'FFF0U;
    const std::size_t code = random() % (frame.format == CanFormat::kFd ? 16 : 9);
    frame.size = wire::kCanLengths[code];
    for (auto& byte : frame.data) {
      const std::uint64_t word = random();
      // Long runs, which need stuff bits.
      constexpr std::array<std::uint8_t, 6> kRuns{0x00, 0xFF, 0xF0, 0x0F, 0x1F, 0xE0};
      byte = word % 4 == 0 ? static_cast<std::uint8_t>(word >> 8) : kRuns[(word >> 8) % kRuns.size()];
    }
    for (const bool passive : {false, true}) {
      const CanBits expected = by_brute_force(frame, passive);
      const CanBits bits = can_bits(frame, passive);
      ASSERT_EQ(bits.nominal, expected.nominal) << i;
      ASSERT_EQ(bits.data, expected.data) << i;
      ASSERT_EQ(bits.stuff, expected.stuff) << i;
    }
  }
}

TEST(CanBits, StayWithinTheBoundsOfTheFormats) {
  // Classic, 29 bits of id: 67 bits without data, and at worst a stuff bit for each four after the first.
  for (std::size_t size = 0; size <= 8; ++size) {
    for (const int pattern : {0x00, 0xFF, 0x55, 0x0F}) {
      const auto fill = static_cast<std::uint8_t>(pattern);
      const CanBits bits = can_bits(test::frame_of(0x16000003, size, CanFormat::kClassic, fill));
      const unsigned plain = 64 + 8 * static_cast<unsigned>(size);
      EXPECT_EQ(bits.total() - bits.stuff, plain);
      EXPECT_LE(bits.stuff, (54 + 8 * static_cast<unsigned>(size) - 1) / 4);
    }
  }
  const CanBits full = can_bits(test::frame_of(0x16000003, 64, CanFormat::kFd, 0x55));
  // 0x16000003 has a run of 7 zeros and one of 16.
  EXPECT_EQ(full.nominal, 36U + 9U + 4U);
  EXPECT_EQ(full.data, 1U + 4U + 512U + 4U + 21U + 7U + 1U);
}

}  // namespace
}  // namespace groma::sim
