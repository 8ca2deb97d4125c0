#include "firmware/core/mcp2518fd/bit_timing.hpp"

#include <gtest/gtest.h>

namespace groma::mcp2518fd {
namespace {

// Microchip's own tables for a 40 MHz clock, as values rather than register fields.
TEST(BitTiming, AgreesWithTheMakersTablesAt40MHz) {
  EXPECT_EQ(nominal_timing(1'000'000), (BitTiming{1, 31, 8, 8}));
  EXPECT_EQ(nominal_timing(500'000), (BitTiming{1, 63, 16, 16}));
  EXPECT_EQ(nominal_timing(250'000), (BitTiming{1, 127, 32, 32}));
  EXPECT_EQ(nominal_timing(125'000), (BitTiming{1, 255, 64, 64}));

  EXPECT_EQ(data_timing(500'000), (BitTiming{2, 31, 8, 8}));
  EXPECT_EQ(data_timing(1'000'000), (BitTiming{1, 31, 8, 8}));
  EXPECT_EQ(data_timing(2'000'000), (BitTiming{1, 15, 4, 4}));
  EXPECT_EQ(data_timing(4'000'000), (BitTiming{1, 7, 2, 2}));
  EXPECT_EQ(data_timing(5'000'000), (BitTiming{1, 5, 2, 2}));
  EXPECT_EQ(data_timing(8'000'000), (BitTiming{1, 3, 1, 1}));

  EXPECT_EQ(transmitter_delay_offset(*data_timing(1'000'000)), 31);
  EXPECT_EQ(transmitter_delay_offset(*data_timing(2'000'000)), 15);
  EXPECT_EQ(transmitter_delay_offset(*data_timing(4'000'000)), 7);
  EXPECT_EQ(transmitter_delay_offset(*data_timing(5'000'000)), 5);
  EXPECT_EQ(transmitter_delay_offset(*data_timing(8'000'000)), 3);
  EXPECT_EQ(transmitter_delay_offset(*data_timing(500'000)), 62);
}

TEST(BitTiming, AgreesWithTheMakersTablesAt20MHz) {
  EXPECT_EQ(nominal_timing(1'000'000, 20'000'000), (BitTiming{1, 15, 4, 4}));
  EXPECT_EQ(nominal_timing(500'000, 20'000'000), (BitTiming{1, 31, 8, 8}));
  EXPECT_EQ(data_timing(2'000'000, 20'000'000), (BitTiming{1, 7, 2, 2}));
  EXPECT_EQ(data_timing(5'000'000, 20'000'000), (BitTiming{1, 2, 1, 1}));
}

TEST(BitTiming, EveryResultIsExactAndFitsTheRegisters) {
  int found = 0;
  for (std::uint32_t clock : {40'000'000U, 20'000'000U}) {
    for (std::uint32_t rate = 10'000; rate <= 8'000'000; rate += 1'000) {
      if (const auto nominal = nominal_timing(rate, clock)) {
        ++found;
        ASSERT_EQ(nominal->bit_per_s(clock) * nominal->prescaler * nominal->quanta(), clock);
        ASSERT_EQ(nominal->bit_per_s(clock), rate);
        ASSERT_TRUE(nominal->prescaler >= 1 && nominal->prescaler <= 256);
        ASSERT_TRUE(nominal->segment1 >= 2 && nominal->segment1 <= 256);
        ASSERT_TRUE(nominal->segment2 >= 1 && nominal->segment2 <= 128);
        ASSERT_TRUE(nominal->sample_point() >= 0.75 && nominal->sample_point() <= 0.8);
        ASSERT_LE(rate, 1'000'000U);
      }
      if (const auto data = data_timing(rate, clock)) {
        ++found;
        ASSERT_EQ(data->bit_per_s(clock), rate);
        ASSERT_TRUE(data->segment1 >= 1 && data->segment1 <= 32);
        ASSERT_TRUE(data->segment2 >= 1 && data->segment2 <= 16);
        ASSERT_LE(data->jump_width, data->segment2);
        ASSERT_TRUE(data->sample_point() >= 0.75 && data->sample_point() <= 0.8);
      }
    }
  }
  EXPECT_GT(found, 50);
}

TEST(BitTiming, RefusesImpossibleRates) {
  EXPECT_FALSE(nominal_timing(0));
  EXPECT_FALSE(nominal_timing(333'333));    // no whole number of cycles
  EXPECT_FALSE(nominal_timing(2'000'000));  // arbitration is at most 1 Mbit/s
  EXPECT_FALSE(nominal_timing(1'000));
  EXPECT_FALSE(data_timing(100'000));
  EXPECT_FALSE(data_timing(10'000'000));
  EXPECT_FALSE(data_timing(6'000'000));
}

}  // namespace
}  // namespace groma::mcp2518fd
