#include "firmware/core/ranging/twr.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "test/support/int128.hpp"

namespace groma::ranging {
namespace {

using test::Int128;

constexpr std::int64_t kWrap = std::int64_t{1} << 40;

class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  std::int64_t integer(std::int64_t low, std::int64_t high) {
    return low + static_cast<std::int64_t>(engine_() % static_cast<std::uint64_t>(high - low + 1));
  }

 private:
  std::mt19937_64 engine_;
};

Int128 floor_div(Int128 a, Int128 b) {
  const Int128 q = a / b;
  return q * b != a && (a < 0) != (b < 0) ? q - 1 : q;
}

// Nearest integer to a/b, b > 0, halves away from zero.
Int128 nearest(Int128 a, Int128 b) {
  return a < 0 ? -floor_div(-2 * a + b, 2 * b) : floor_div(2 * a + b, 2 * b);
}

Int128 exact_double_sided(std::int64_t ra, std::int64_t da, std::int64_t rb, std::int64_t db) {
  const Int128 numerator = Int128{ra} * rb - Int128{da} * db;
  return nearest(numerator * 256, Int128{ra} + rb + da + db);
}

TEST(DoubleSided, EqualsTheExactRationalForAnyFourIntervals) {
  Random random(1);
  for (int i = 0; i < 200'000; ++i) {
    // Magnitudes from 1 tick to the whole period, similar and different.
    const auto interval = [&] { return random.integer(1, (std::int64_t{1} << random.integer(1, 40)) - 1); };
    const std::int64_t ra = interval();
    const std::int64_t da = interval();
    const std::int64_t rb = interval();
    const std::int64_t db = interval();
    const auto result = double_sided({Ticks(ra), Ticks(da), Ticks(rb), Ticks(db)});
    ASSERT_TRUE(result);
    ASSERT_EQ(Int128{result->in_256ths()}, exact_double_sided(ra, da, rb, db))
        << ra << ' ' << da << ' ' << rb << ' ' << db;
  }
}

TEST(DoubleSided, EqualsTheExactRationalAtTheEdges) {
  const std::int64_t top = kWrap - 1;
  for (const std::int64_t ra : {std::int64_t{1}, std::int64_t{2}, top - 1, top}) {
    for (const std::int64_t da : {std::int64_t{1}, top}) {
      for (const std::int64_t rb : {std::int64_t{1}, top}) {
        for (const std::int64_t db : {std::int64_t{1}, top}) {
          const auto result = double_sided({Ticks(ra), Ticks(da), Ticks(rb), Ticks(db)});
          ASSERT_TRUE(result);
          EXPECT_EQ(Int128{result->in_256ths()}, exact_double_sided(ra, da, rb, db));
        }
      }
    }
  }
}

TEST(DoubleSided, RefusesInvalidIntervals) {
  const Ticks good(1000);
  for (const Ticks bad : {Ticks(0), Ticks(-1), Ticks(kWrap)}) {
    EXPECT_FALSE(double_sided({bad, good, good, good}));
    EXPECT_FALSE(double_sided({good, bad, good, good}));
    EXPECT_FALSE(double_sided({good, good, bad, good}));
    EXPECT_FALSE(double_sided({good, good, good, bad}));
  }
}

// A clock with rate offset `ppb` and reading `phase` at true time 0; true time in thousandths of a tick.
struct Clock {
  std::int64_t ppb;
  std::int64_t phase;
  [[nodiscard]] DeviceTime timestamp(std::int64_t t_milliticks) const {
    const Int128 shown = Int128{t_milliticks} * (1'000'000'000 + ppb);
    return DeviceTime(
        static_cast<std::uint64_t>(static_cast<std::int64_t>(nearest(shown, 1'000'000'000'000)) + phase));
  }
};

TEST(DoubleSided, MeasuresTheDistanceAcrossTheWrapAndAtFortyPpm) {
  Random random(2);
  for (int i = 0; i < 100'000; ++i) {
    const Clock tag{random.integer(-40'000, 40'000), random.integer(0, kWrap - 1)};
    const Clock anchor{random.integer(-40'000, 40'000), random.integer(0, kWrap - 1)};
    const std::int64_t tof_m = random.integer(0, 64'000'000);  // milliticks: 0 to 300 m
    const std::int64_t reply = random.integer(10'000'000, 600'000'000) * 1000;
    const std::int64_t rest = random.integer(10'000'000, 60'000'000'000) * 1000;
    const std::int64_t t1 = random.integer(0, 1'000'000'000'000);
    const std::int64_t a1 = t1 + tof_m;
    const std::int64_t a2 = a1 + reply;
    const std::int64_t t2 = a2 + tof_m;
    const std::int64_t t3 = t2 + rest;
    const std::int64_t a3 = t3 + tof_m;
    const DoubleSidedIntervals intervals{.tag_round = tag.timestamp(t2) - tag.timestamp(t1),
                                         .anchor_reply = anchor.timestamp(a2) - anchor.timestamp(a1),
                                         .anchor_round = anchor.timestamp(a3) - anchor.timestamp(a2),
                                         .tag_reply = tag.timestamp(t3) - tag.timestamp(t2)};
    const auto result = double_sided(intervals);
    ASSERT_TRUE(result);
    const double tof = static_cast<double>(tof_m) / 1000.0;
    const double measured = static_cast<double>(result->in_256ths()) / 256.0;
    // Six timestamps rounded to a tick, and the flight time times the clock offset.
    ASSERT_NEAR(measured, tof, 1.6 + tof * 41e-6);
    const double offset_ppb = static_cast<double>(anchor.ppb - tag.ppb);
    ASSERT_NEAR(clock_offset_ppb(intervals), offset_ppb,
                2.0 + 2e12 / static_cast<double>(reply + rest) + std::abs(offset_ppb) * 1e-4);
  }
}

// For linear motion the estimate is the distance at the RESPONSE, even if the two round trips differ in
// length.
TEST(DoubleSided, IsTheDistanceAtTheResponseOfATagInMotion) {
  const double speed_mps = 3.0;
  const double metres_per_tick = kSpeedOfLight_mps / static_cast<double>(Ticks::kPerSecond);
  const auto tof_at = [&](double t) { return (50.0 + speed_mps * t / 63.8976e9) / metres_per_tick; };
  const double t1 = 0.0;
  const double a1 = t1 + tof_at(t1);
  const double a2 = a1 + 400e6;
  const double t2 = a2 + tof_at(a2);
  const double t3 = t2 + 1300e6;
  const double a3 = t3 + tof_at(t3);
  const auto ticks = [](double d) { return Ticks(std::llround(d)); };
  const auto result = double_sided({ticks(t2 - t1), ticks(a2 - a1), ticks(a3 - a2), ticks(t3 - t2)});
  ASSERT_TRUE(result);
  EXPECT_NEAR(static_cast<double>(result->distance_m()), tof_at(a2) * metres_per_tick, 0.006);
  // The distance at the POLL was different.
  EXPECT_GT(tof_at(a2) * metres_per_tick - tof_at(t1) * metres_per_tick, 0.018);
}

TEST(SingleSided, EqualsTheExactRational) {
  Random random(3);
  for (int i = 0; i < 100'000; ++i) {
    const std::int64_t reply = random.integer(1, (std::int64_t{1} << random.integer(1, 39)) - 1);
    const std::int64_t round = reply + random.integer(-std::min<std::int64_t>(reply - 1, 1000), 100'000);
    const auto ppb = static_cast<std::int32_t>(random.integer(-1'000'000, 1'000'000));
    const auto result = single_sided(Ticks(round), Ticks(reply), ppb);
    ASSERT_TRUE(result);
    const Int128 numerator = Int128{round - reply} * 1'000'000'000 + Int128{reply} * ppb;
    const Int128 exact = nearest(numerator * 256, Int128{2'000'000'000});
    ASSERT_LE(result->in_256ths() - static_cast<std::int64_t>(exact), 1);
    ASSERT_GE(result->in_256ths() - static_cast<std::int64_t>(exact), -1);
  }
  EXPECT_FALSE(single_sided(Ticks(0), Ticks(10), 0));
  EXPECT_FALSE(single_sided(Ticks(10), Ticks(kWrap), 0));
}

TEST(SingleSided, AgreesWithDoubleSidedWhenTheOffsetIsKnown) {
  const Clock tag{-17'000, 5};
  const Clock anchor{23'000, 9};
  const std::int64_t tof = 21'314'000;  // 100 m
  const std::int64_t reply = 200'000'000'000;
  const auto round_ticks = tag.timestamp(2 * tof + reply) - tag.timestamp(0);
  const auto reply_ticks = anchor.timestamp(tof + reply) - anchor.timestamp(tof);
  const auto result = single_sided(round_ticks, reply_ticks, 40'000);
  ASSERT_TRUE(result);
  EXPECT_NEAR(static_cast<double>(result->distance_m()), 100.0, 0.02);
}

TEST(FlightTime, ConvertsToMetresByTheSpeedOfLight) {
  EXPECT_NEAR(static_cast<double>(FlightTime(256).distance_m()), 0.00469176, 1e-8);
  EXPECT_NEAR(static_cast<double>(FlightTime(-5'456'384).distance_m()), -100.0, 0.001);
}

TEST(ClockOffset, SaturatesInsteadOfOverflowing) {
  const Ticks top(kWrap - 1);
  EXPECT_EQ(clock_offset_ppb({Ticks(1), top, top, Ticks(1)}), 1'000'000);
  EXPECT_EQ(clock_offset_ppb({top, Ticks(1), Ticks(1), top}), -1'000'000);
  EXPECT_EQ(clock_offset_ppb({top, top, top, top}), 0);
}

}  // namespace
}  // namespace groma::ranging
