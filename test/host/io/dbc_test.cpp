#include "host/io/dbc.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <string>
#include <tuple>
#include <vector>

#include "test/support/random.hpp"

namespace groma::io {
namespace {

using ::testing::HasSubstr;

constexpr const char* kFile = R"(VERSION "1.0"

NS_ :
	NS_DESC_
	CM_
	SIG_VALTYPE_
	BO_TX_BU_

BS_:

BU_: Drive Base

BO_ 2364540158 Engine: 8 Drive
 SG_ Speed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" Base,Other

BO_ 496 Drive: 8 Drive
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" Base
 SG_ Slow m0 : 8|12@1- (0.01,250) [229.52|270.47] "degK" Base
 SG_ Fast m12 : 15|12@0- (1E-002,+2.5) [0|0] "m/s" Base
 SG_ Both m3M : 8|2@1+ (1,0) [0|0] "" Base
BO_ 100 Floats: 12 Drive
 SG_ Single : 0|32@1- (1,0) [0|0] "" Base
 SG_ Whole : 0|32@1- (1,0) [0|0] "" Base
 SG_ Twice : 39|64@0+ (2,0) [0|0] "" Base

CM_ BO_ 496 "Text with \"quotes\" over lines:
BO_ this is no message
 SG_ nor this a signal";
BA_DEF_ BO_ "Cycle" INT 0 1000;
VAL_ 496 Page 0 "BO_" 1 "SG_ x" ;
SIG_VALTYPE_ 100 Single : 1;
SIG_VALTYPE_ 100 Twice 2;
SIG_VALTYPE_ 100 Gone : 2;
UNKNOWN_SECTION_ 1 2 3 "and so on
";
)";

DbcSignal signal_of(unsigned start_bit, unsigned bits, bool big_endian, DbcSignal::Type type) {
  DbcSignal signal;
  signal.start_bit = start_bit;
  signal.bits = bits;
  signal.big_endian = big_endian;
  signal.type = type;
  return signal;
}

// The error message for the file with one text replaced.
std::string error_with(const std::string& from, const std::string& to) {
  std::string text = kFile;
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  text.replace(at, from.size(), to);
  try {
    for (const DbcMessage& message : parse_dbc("robot.dbc", text)) {
      for (const DbcSignal& signal : message.signals) expect_readable(message, signal);
    }
  } catch (const ConfigError& error) {
    return error.what();
  }
  return "no error";
}

TEST(Dbc, ReadsMessagesAndSignals) {
  const std::vector<DbcMessage> messages = parse_dbc("robot.dbc", kFile);
  ASSERT_EQ(messages.size(), 3U);
  EXPECT_EQ(messages[0].id, 0x8CF0'04FEU);
  EXPECT_EQ(messages[0].name, "Engine");
  ASSERT_EQ(messages[0].signals.size(), 1U);
  const DbcSignal& speed = messages[0].signals[0];
  EXPECT_EQ(speed.name, "Speed");
  EXPECT_EQ(speed.start_bit, 24U);
  EXPECT_EQ(speed.bits, 16U);
  EXPECT_FALSE(speed.big_endian);
  EXPECT_EQ(speed.type, DbcSignal::Type::kUnsigned);
  EXPECT_EQ(speed.factor, 0.125);
  EXPECT_EQ(speed.max, 8031.875);
  EXPECT_TRUE(speed.has_bounds());
  EXPECT_EQ(speed.unit, "rpm");
  EXPECT_EQ(to_string(speed.place), "robot.dbc:14:6");

  EXPECT_EQ(messages[1].id, 496U);
  EXPECT_EQ(messages[1].bytes, 8U);
  ASSERT_EQ(messages[1].signals.size(), 4U);
  const auto& [page, slow, fast, both] = std::tie(messages[1].signals[0], messages[1].signals[1],
                                                  messages[1].signals[2], messages[1].signals[3]);
  EXPECT_TRUE(page.is_multiplexor);
  EXPECT_FALSE(page.multiplexed);
  EXPECT_FALSE(page.has_bounds());
  EXPECT_EQ(slow.multiplexed, 0U);
  EXPECT_EQ(slow.type, DbcSignal::Type::kSigned);
  EXPECT_EQ(fast.multiplexed, 12U);
  EXPECT_TRUE(fast.big_endian);
  EXPECT_EQ(fast.factor, 0.01);
  EXPECT_EQ(fast.offset, 2.5);
  EXPECT_TRUE(both.is_multiplexor && both.multiplexed == 3U);

  EXPECT_EQ(messages[2].signals[0].type, DbcSignal::Type::kFloat);
  EXPECT_EQ(messages[2].signals[1].type, DbcSignal::Type::kSigned);
  EXPECT_EQ(messages[2].signals[2].type, DbcSignal::Type::kDouble);
}

TEST(Dbc, ReadsFilesWithCarriageReturnsOfAnyEncoding) {
  std::string text;
  for (const char c : std::string(kFile)) text += c == '\n' ? std::string("\r\n") : std::string(1, c);
  text.replace(text.find("degK"), 4, "\xB0K");
  const std::vector<DbcMessage> messages = parse_dbc("robot.dbc", "\xEF\xBB\xBF" + text);
  ASSERT_EQ(messages.size(), 3U);
  EXPECT_EQ(messages[1].signals[1].unit, "\xB0K");
  EXPECT_TRUE(parse_dbc("robot.dbc", "").empty());
}

TEST(Dbc, NamesThePlaceOfEachMistake) {
  EXPECT_THAT(error_with("496 Drive: 8", "496 Drive 8"),
              HasSubstr("robot.dbc:16:15: '8 Drive' is not expected"));
  EXPECT_THAT(error_with("BO_ 496", "BO_ 0x1F0"), HasSubstr("robot.dbc:16:11: 'Drive: 8 Drive'"));
  EXPECT_THAT(error_with("BO_ 2364540158", "BO_ 99999999999"), HasSubstr("robot.dbc:13:5: "));
  EXPECT_THAT(error_with("24|16@1+", "24|16@2+"), HasSubstr("robot.dbc:14:20: "));
  EXPECT_THAT(error_with("24|16@1+", "24|16@1 (0"), HasSubstr("write it as SG_ NAME"));
  EXPECT_THAT(error_with("(0.125,0)", "(0.125)"), HasSubstr("robot.dbc:14:29: "));
  EXPECT_THAT(error_with("[0|8031.875]", "[0|many]"), HasSubstr("'many] "));
  EXPECT_THAT(error_with("\"rpm\"", "rpm"), HasSubstr("'rpm Base"));
  EXPECT_THAT(error_with("Slow m0", "Slow mx"), HasSubstr("robot.dbc:18:11: 'mx' is no multiplexing"));
  EXPECT_THAT(error_with(" : 1;", " : float;"), HasSubstr("SIG_VALTYPE_ ID NAME : TYPE"));
  EXPECT_THAT(error_with("BO_ 2364540158 Engine: 8 Drive\n", ""), HasSubstr("below the BO_ line"));
  EXPECT_THAT(error_with("and so on\n\"", "and so on\n"),
              HasSubstr("robot.dbc:34:24: the quoted text does not end"));

  EXPECT_EQ(error_with("24|16@1+", "48|16@1+"), "no error");
  EXPECT_THAT(error_with("24|16@1+", "49|16@1+"), HasSubstr("Engine.Speed does not fit the 8 bytes"));
  EXPECT_THAT(error_with("24|16@1+", "24|0@1+"), HasSubstr("has 0 bits"));
  EXPECT_THAT(error_with("24|16@1+", "24|65@1+"), HasSubstr("has 65 bits"));
  EXPECT_THAT(error_with("24|16@1+", "4294967295|16@1+"), HasSubstr("does not fit"));
  EXPECT_THAT(error_with("(0.125,0)", "(0,0)"), HasSubstr("factor 0"));
  EXPECT_THAT(error_with("Whole : 0|32@1-", "Whole : 0|31@1-"), "no error");
  EXPECT_THAT(error_with("Single : 0|32@1-", "Single : 0|31@1-"),
              HasSubstr("floating-point number of 31 bits"));
  EXPECT_THAT(error_with("Floats: 12", "Floats: 65"), HasSubstr("65 bytes"));
}

// The layout of cantools' first example, by hand.
TEST(Dbc, ReadsABigEndianMessage) {
  const std::vector<DbcMessage> messages = parse_dbc("", R"(BO_ 496 ExampleMessage: 8 PCM1
 SG_ Temperature : 0|12@0- (0.01,250) [229.52|270.47] "degK" PCM1
 SG_ AverageRadius : 6|6@0+ (0.1,0) [0|5] "m" PCM1
 SG_ Enable : 7|1@0+ (1,0) [0|0] "-" PCM1
)");
  const std::array<std::uint8_t, 8> payload{0xC0, 0x06, 0xE0};
  const std::vector<DbcSignal>& signals = messages.at(0).signals;
  EXPECT_DOUBLE_EQ(physical_value(signals[0], payload), 250.55);
  EXPECT_DOUBLE_EQ(physical_value(signals[1], payload), 3.2);
  EXPECT_EQ(physical_value(signals[2], payload), 1.0);
}

// Against arithmetic with the whole payload as one number.
TEST(Dbc, ReadsBitsOfEachLayout) {
  groma::test::Random random(91);
  for (int round = 0; round < 20'000; ++round) {
    std::array<std::uint8_t, 8> payload{};
    for (std::uint8_t& byte : payload) byte = static_cast<std::uint8_t>(random.uniform(0.0, 256.0));
    const auto bits = static_cast<unsigned>(random.uniform(1.0, 65.0));
    const auto first = static_cast<unsigned>(random.uniform(0.0, 65.0 - bits));
    const bool big_endian = round % 2 == 0;
    const bool is_signed = round % 4 < 2;
    std::uint64_t whole = 0;
    for (unsigned i = 0; i < 8; ++i) whole |= std::uint64_t{payload[big_endian ? 7 - i : i]} << (8 * i);
    // `first` counts from the least significant bit, or from the most significant one.
    const std::uint64_t shifted = big_endian ? whole >> (64 - bits - first) : whole >> first;
    const std::uint64_t expected = bits == 64 ? shifted : shifted & ((std::uint64_t{1} << bits) - 1);
    const DbcSignal signal = signal_of(big_endian ? first / 8 * 8 + 7 - first % 8 : first, bits, big_endian,
                                       is_signed ? DbcSignal::Type::kSigned : DbcSignal::Type::kUnsigned);
    ASSERT_TRUE(fits(signal, 8));
    ASSERT_EQ(raw_value(signal, payload), expected) << bits << " bits from " << first;
    long double value = static_cast<long double>(expected);
    if (is_signed && (expected >> (bits - 1) & 1U) != 0) value -= std::ldexp(1.0L, static_cast<int>(bits));
    ASSERT_EQ(physical_value(signal, payload), static_cast<double>(value));
    const std::size_t needed = (first + bits + 7) / 8;
    EXPECT_TRUE(fits(signal, needed));
    EXPECT_FALSE(fits(signal, needed - 1));
  }
}

TEST(Dbc, ReadsFloatingPointNumbers) {
  std::array<std::uint8_t, 8> payload{};
  const float single = -1.25F;
  std::memcpy(payload.data(), &single, 4);
  EXPECT_EQ(physical_value(signal_of(0, 32, false, DbcSignal::Type::kFloat), payload), -1.25);
  const auto bits = std::bit_cast<std::uint64_t>(6.5e-300);
  for (std::size_t i = 0; i < 8; ++i) payload[i] = static_cast<std::uint8_t>(bits >> (56 - 8 * i));
  EXPECT_EQ(physical_value(signal_of(7, 64, true, DbcSignal::Type::kDouble), payload), 6.5e-300);
}

}  // namespace
}  // namespace groma::io
