#include "firmware/sim/node_clock.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {
namespace {

__extension__ using Wide = __int128;

TEST(SimulationTime, HoldsProcessorCyclesAndTicksExactly) {
  EXPECT_EQ(kUnitsPerSecond % 64'000'000, 0);
  EXPECT_EQ(kUnitsPerSecond / 64'000'000, 4992);
  EXPECT_EQ(kUnitsPerSecond / kUnitsPerTick, 63'897'600'000);
  EXPECT_EQ(from_seconds(1.0), kUnitsPerSecond);
  EXPECT_EQ(from_seconds(-0.5), -kUnitsPerSecond / 2);
}

TEST(NodeClock, WithoutOffsetIsTheWorldsTime) {
  const NodeClock clock(ClockSpec{.first_tick = 17});
  for (const SimTime t : {SimTime{0}, SimTime{4}, SimTime{5}, SimTime{123'456'789'012'345'678}}) {
    EXPECT_EQ(clock.local_units(t), t);
    EXPECT_EQ(clock.ticks(t), t / 5 + 17);
    EXPECT_EQ(clock.time_of_tick(t / 5 + 17), t / 5 * 5);
  }
}

TEST(NodeClock, WithAConstantOffsetIsTheRationalProduct) {
  for (const double ppm : {-20.0, -0.3, 0.001, 7.77, 20.0, 900.0}) {
    const NodeClock clock(ClockSpec{.offset_ppm = ppm});
    const auto offset = static_cast<std::int64_t>(std::llround(std::ldexp(ppm * 1e-6, 48)));
    KeyedRandom random(3);
    for (std::uint64_t i = 0; i < 2000; ++i) {
      const auto t = static_cast<SimTime>(random.of(i).bits() >> 5);
      const Wide exact = ((static_cast<Wide>(t) << 48) + static_cast<Wide>(t) * offset) >> 48;
      ASSERT_EQ(clock.local_units(t), static_cast<std::int64_t>(exact)) << ppm << ' ' << t;
    }
  }
}

class ClockInBothDirections : public testing::TestWithParam<ClockSpec> {};

TEST_P(ClockInBothDirections, TheInverseIsTheFirstInstantOfATick) {
  const NodeClock clock(GetParam());
  KeyedRandom random(11);
  for (std::uint64_t i = 0; i < 5000; ++i) {
    const auto t =
        static_cast<SimTime>(random.of(i).bits() % static_cast<std::uint64_t>(100 * kUnitsPerSecond)) + 10;
    const std::int64_t tick = clock.ticks(t);
    const SimTime first = clock.time_of_tick(tick);
    ASSERT_LE(first, t);
    ASSERT_EQ(clock.ticks(first), tick);
    ASSERT_EQ(clock.ticks(first - 1), tick - 1);
    ASSERT_GE(clock.local_units(t + 1), clock.local_units(t));
  }
}

TEST_P(ClockInBothDirections, TheNearestTickAgreesWithTheTick) {
  const NodeClock clock(GetParam());
  for (std::uint64_t i = 0; i < 2000; ++i) {
    const auto t = static_cast<SimTime>(KeyedRandom(12).of(i).bits() >> 18);
    const std::int64_t nearest = clock.nearest_tick(t, 0.0);
    const std::int64_t floor = clock.ticks(t);
    ASSERT_TRUE(nearest == floor || nearest == floor + 1);
    ASSERT_EQ(clock.nearest_tick(t, 1000.0), nearest + 1000);
    ASSERT_EQ(clock.nearest_tick(t, -0.5), floor);
  }
}

TEST(NodeClock, TheFirstInstantIsFoundWhereUnitsRepeatAndWhereTheyAreSkipped) {
  for (const double ppm : {-1000.0, 1000.0}) {
    const NodeClock clock(ClockSpec{.offset_ppm = ppm});
    for (std::uint64_t i = 0; i < 20'000; ++i) {
      const auto units = static_cast<std::int64_t>(KeyedRandom(13).of(i).bits() >> 16) + 2;
      const SimTime first = clock.time_of_local(units);
      ASSERT_GE(clock.local_units(first), units);
      ASSERT_LT(clock.local_units(first - 1), units);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    Crystals, ClockInBothDirections,
    testing::Values(
        ClockSpec{}, ClockSpec{.offset_ppm = 20.0, .first_tick = 0xFF'FFFF'0000},
        ClockSpec{.offset_ppm = -20.0},
        ClockSpec{.offset_ppm = 3.0, .drift_ppm_per_s = 1.0, .drift_until_s = 30.0},
        ClockSpec{.offset_ppm = 3.0, .drift_ppm_per_s = -0.7, .drift_from_s = 2.0, .drift_until_s = 50.0}));

TEST(NodeClock, WithADriftIsTheExactSumOfItsPieces) {
  const NodeClock clock(
      ClockSpec{.offset_ppm = 5.0, .drift_ppm_per_s = -1.0, .drift_from_s = 0.5, .drift_until_s = 2.0});
  const SimTime piece = SimTime{1} << 30;
  const auto offset = static_cast<std::int64_t>(std::llround(std::ldexp(5e-6, 48)));
  const auto step = static_cast<std::int64_t>(std::llround(std::ldexp(-1e-6 * to_seconds(piece), 48)));
  const std::int64_t first = from_seconds(0.5) / piece;
  const std::int64_t last = from_seconds(2.0) / piece;
  Wide excess = 0;
  for (std::int64_t k = 0; k < 1200; ++k) {
    const std::int64_t here = offset + step * std::clamp<std::int64_t>(k - first, 0, last - first);
    for (const SimTime within : {SimTime{0}, SimTime{1}, piece / 3, piece - 1}) {
      const Wide exact = excess + static_cast<Wide>(within) * here;
      ASSERT_EQ(clock.local_units(k * piece + within),
                k * piece + within + static_cast<std::int64_t>(exact >> 48));
    }
    excess += static_cast<Wide>(piece) * here;
  }
}

TEST(NodeClock, ADriftFollowsItsRamp) {
  const ClockSpec spec{.offset_ppm = -4.0, .drift_ppm_per_s = 1.0, .drift_from_s = 1.0, .drift_until_s = 3.0};
  const NodeClock clock(spec);
  // Phase against nominal, as the integral of the frequency. The tolerance is a step of the piecewise line.
  const auto area_ppm_s = [&](double t_s) {
    const double grown_s = std::clamp(t_s - 1.0, 0.0, 2.0);
    return -4.0 * t_s + grown_s * grown_s / 2.0 + 2.0 * std::max(t_s - 3.0, 0.0);
  };
  for (double t_s = 0.1; t_s < 6.0; t_s += 0.0731) {
    const SimTime t = from_seconds(t_s);
    const double seen_ppm_s =
        static_cast<double>(clock.local_units(t) - t) / static_cast<double>(kUnitsPerSecond) * 1e6;
    EXPECT_NEAR(seen_ppm_s, area_ppm_s(t_s), 0.015) << t_s;
    EXPECT_NEAR(clock.offset(t) * 1e6, -4.0 + std::clamp(t_s - 1.0, 0.0, 2.0), 0.005) << t_s;
  }
  // The reported frequency offset is the slope of the phase.
  for (double t_s = 0.5; t_s < 5.0; t_s += 0.517) {
    const SimTime t = from_seconds(t_s) & ~((SimTime{1} << 30) - 1);
    const SimTime span = SimTime{1} << 30;
    const double slope = static_cast<double>(clock.local_units(t + span) - clock.local_units(t) - span) /
                         static_cast<double>(span);
    EXPECT_NEAR(slope, clock.offset(t), 2e-9);
  }
}

TEST(NodeClock, GoesUpAndDownWithinItsBounds) {
  ClockSpec spec{.offset_ppm = -10.0};
  spec.more_ramps = up_and_down(2.0, 20.0, 1.0, 45.0);
  const NodeClock clock(spec);
  for (double t_s = 0.05; t_s < 60.0; t_s += 0.0917) {
    const double phase_s = std::fmod(std::max(t_s - 1.0, 0.0), 20.0);
    const double triangle = t_s >= 41.0 ? 0.0 : 2.0 * std::min(phase_s, 20.0 - phase_s);
    EXPECT_NEAR(clock.offset(from_seconds(t_s)) * 1e6, -10.0 + triangle, 0.02) << t_s;
  }
  // Strictly monotonic over the corners, and invertible.
  for (SimTime t = from_seconds(10.9); t < from_seconds(11.1); t += 7'777'777)
    EXPECT_EQ(clock.time_of_local(clock.local_units(t) + 1) > t, true);
}

TEST(NodeClock, TwoRampsAreTheSumOfEach) {
  const DriftRamp a{.ppm_per_s = 1.0, .from_s = 0.5, .until_s = 2.5};
  const DriftRamp b{.ppm_per_s = -0.5, .from_s = 1.5, .until_s = 4.5};
  const NodeClock both(ClockSpec{.more_ramps = {a, b}});
  const NodeClock first(ClockSpec{.more_ramps = {a}});
  const NodeClock second(ClockSpec{.drift_ppm_per_s = -0.5, .drift_from_s = 1.5, .drift_until_s = 4.5});
  for (SimTime t = 1; t < from_seconds(6.0); t += 12'345'678'901)
    EXPECT_NEAR(static_cast<double>(both.local_units(t) - t),
                static_cast<double>(first.local_units(t) + second.local_units(t) - 2 * t), 1.0);
}

}  // namespace
}  // namespace groma::sim
