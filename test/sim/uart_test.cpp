#include "firmware/sim/uart.hpp"

#include <gtest/gtest.h>

namespace groma::sim {
namespace {

std::vector<TimedByte> taken(UartLine& line, SimTime until) {
  std::vector<TimedByte> out;
  line.take(until, out);
  return out;
}

TEST(UartLine, TakesTenBitsPerByte) {
  UartLine line({.bits_per_s = 1'000'000, .queue_bytes = 100});
  const SimTime start = 7 * kUnitsPerMillisecond;
  ASSERT_TRUE(line.write(start, std::vector<std::uint8_t>{1, 2, 3}));
  EXPECT_EQ(line.next_byte(), start + 10 * kUnitsPerMicrosecond);
  EXPECT_TRUE(taken(line, start + 10 * kUnitsPerMicrosecond - 1).empty());
  const std::vector<TimedByte> first = taken(line, start + 20 * kUnitsPerMicrosecond);
  ASSERT_EQ(first.size(), 2U);
  EXPECT_EQ(first[1].t, start + 20 * kUnitsPerMicrosecond);
  EXPECT_EQ(first[1].value, 2);
  // Written while the line is busy: it waits.
  ASSERT_TRUE(line.write(start + 25 * kUnitsPerMicrosecond, std::vector<std::uint8_t>{4}));
  const std::vector<TimedByte> rest = taken(line, start + kUnitsPerMillisecond);
  ASSERT_EQ(rest.size(), 2U);
  EXPECT_EQ(rest[1].t, start + 40 * kUnitsPerMicrosecond);
}

TEST(UartLine, RefusesAWriteThatDoesNotFitWhole) {
  UartLine line({.bits_per_s = 1'000'000, .queue_bytes = 10});
  ASSERT_TRUE(line.write(0, std::vector<std::uint8_t>(8, 1)));
  EXPECT_FALSE(line.write(0, std::vector<std::uint8_t>(3, 2)));
  EXPECT_EQ(line.overflow_bytes(), 3U);
  EXPECT_EQ(line.overflow_writes(), 1U);
  // One byte sent makes room for the refused write.
  EXPECT_TRUE(line.write(10 * kUnitsPerMicrosecond, std::vector<std::uint8_t>(3, 2)));
  EXPECT_FALSE(line.write(10 * kUnitsPerMicrosecond, std::vector<std::uint8_t>(1, 3)));
  EXPECT_EQ(taken(line, kUnitsPerSecond).size(), 11U);
  EXPECT_EQ(line.accepted_bytes(), 11U);
}

TEST(UartLine, DropsTheRestWhenCleared) {
  UartLine line;
  ASSERT_TRUE(line.write(0, std::vector<std::uint8_t>(10, 1)));
  line.clear(35 * kUnitsPerMicrosecond);
  EXPECT_EQ(taken(line, kUnitsPerSecond).size(), 3U);
  ASSERT_TRUE(line.write(50 * kUnitsPerMicrosecond, std::vector<std::uint8_t>{9}));
  EXPECT_EQ(line.next_byte(), 60 * kUnitsPerMicrosecond);
}

}  // namespace
}  // namespace groma::sim
