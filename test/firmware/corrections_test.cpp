#include "firmware/core/ranging/corrections.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

namespace groma::ranging {
namespace {

double metres(FlightTime t) {
  return static_cast<double>(t.in_256ths()) / 256.0 / 63.8976e9 * 299'792'458.0;
}

constexpr double kRounding_m = 0.000'01;  // half of 1/256 tick is 9 um

TEST(Drift, IsZeroAtTheReference) {
  EXPECT_EQ(temperature_drift(2'300).in_256ths(), 0);
  EXPECT_EQ(supply_drift(3'300).in_256ths(), 0);
}

TEST(Drift, Is2Point15MillimetresADegreeAnd5Point35CentimetresAVolt) {
  for (const int temperature_cdegc : {-4'000, -1, 2'299, 2'301, 5'000, 8'500, 12'700}) {
    EXPECT_NEAR(metres(temperature_drift(temperature_cdegc)), 0.00215 * (temperature_cdegc / 100.0 - 23.0),
                kRounding_m)
        << temperature_cdegc;
  }
  for (const int supply_mv : {2'800, 3'000, 3'299, 3'301, 3'600, 3'984}) {
    EXPECT_NEAR(metres(supply_drift(supply_mv)), 0.0535 * (supply_mv / 1000.0 - 3.3), kRounding_m)
        << supply_mv;
  }
}

// The published points, in centimetres from -93 dBm up.
TEST(PowerBias, InterpolatesThePublishedTable) {
  const std::vector<double> table_cm = {8.1,  7.6,  7.1,  6.2,  4.9,  4.2,   3.5,   2.1,  0.0,
                                        -2.7, -5.1, -6.9, -8.2, -9.3, -10.0, -10.5, -11.0};
  for (std::size_t i = 0; i < table_cm.size(); ++i) {
    const auto power_cdbm = -9'300 + 200 * static_cast<int>(i);
    EXPECT_NEAR(metres(power_bias(power_cdbm)), 0.01 * table_cm[i], kRounding_m) << power_cdbm;
    if (i + 1 == table_cm.size()) break;
    EXPECT_NEAR(metres(power_bias(power_cdbm + 50)), 0.01 * (0.75 * table_cm[i] + 0.25 * table_cm[i + 1]),
                kRounding_m)
        << power_cdbm + 50;
  }
}

TEST(PowerBias, ClampsAtTheTablesEnds) {
  EXPECT_EQ(power_bias(-9'301), power_bias(-9'300));
  EXPECT_EQ(power_bias(-32'768), power_bias(-9'300));
  EXPECT_EQ(power_bias(-6'099), power_bias(-6'100));
  EXPECT_EQ(power_bias(0), power_bias(-6'100));
}

// A strong signal crosses the threshold early: its timestamp is early and its range short.
TEST(PowerBias, OfAStrongSignalShortensARange) {
  EXPECT_LT(power_bias(-6'100), FlightTime(0));
  EXPECT_GT(power_bias(-9'300), FlightTime(0));
  for (int power_cdbm = -9'300; power_cdbm < -6'100; power_cdbm += 10) {
    EXPECT_LE(power_bias(power_cdbm + 10), power_bias(power_cdbm)) << power_cdbm;
  }
}

}  // namespace
}  // namespace groma::ranging
