#include "firmware/core/mac/clock_tracker.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace groma::mac {
namespace {

using ranging::ClockTime;
using ranging::Ticks;

constexpr double kTicksPerSecond = 63'897'600'000.0;

// This node's clock as a function of the master's: offset, rate, rate ramp, and timestamps with Gaussian
// noise.
class Beacons {
 public:
  Beacons(double ppm, double ramp_ppm_per_s, double noise_ticks, std::uint64_t seed)
      : ppm_(ppm), ramp_(ramp_ppm_per_s), noise_ticks_(noise_ticks), random_(seed) {}

  [[nodiscard]] double exact(Ticks master) const {
    const double m = static_cast<double>(master.count());
    const double t_s = m / kTicksPerSecond;
    return kPhase + m + m * 1e-6 * (ppm_ + ramp_ * t_s / 2.0);
  }
  [[nodiscard]] ClockTime timestamp(Ticks master) {
    return ClockTime(std::llround(exact(master) + noise_ticks_ * gaussian()));
  }
  double gaussian() {
    double sum = -6.0;
    for (int i = 0; i < 12; ++i) sum += static_cast<double>(random_() >> 11) * 0x1p-53;
    return sum;
  }

 private:
  static constexpr double kPhase = 1e9;
  double ppm_;
  double ramp_;
  double noise_ticks_;
  std::mt19937_64 random_;
};

constexpr Ticks kPeriod = Ticks::from_us(20'000);

TEST(ClockTracker, OneBeaconPredictsTheNext) {
  Beacons beacons(35.0, 0.0, 6.0, 1);
  ClockTracker tracker;
  tracker.seed(Ticks(0), beacons.timestamp(Ticks(0)), -35'500);  // the carrier estimate errs by 0.5 ppm
  const double error = static_cast<double>(tracker.local(kPeriod).count()) - beacons.exact(kPeriod);
  EXPECT_LT(std::abs(error), 20e-9 * kTicksPerSecond);
  EXPECT_LT(std::abs(error), 3.0 * static_cast<double>(tracker.sigma(kPeriod).count()));
  EXPECT_TRUE(tracker.update(kPeriod, beacons.timestamp(kPeriod)));
  EXPECT_NEAR(tracker.skew_ppb(), 35'000, 20);
}

TEST(ClockTracker, CoastsTenLostBeaconsAndASecondWithinTheGuard) {
  for (const double ramp : {0.0, 1.0, -1.0}) {
    Beacons beacons(-20.0, ramp, 6.0, 2);
    ClockTracker tracker;
    tracker.seed(Ticks(0), beacons.timestamp(Ticks(0)), 20'000);
    int n = 1;
    for (; n <= 200; ++n) ASSERT_TRUE(tracker.update(n * kPeriod, beacons.timestamp(n * kPeriod)));
    for (const int lost : {1, 10, 50}) {
      const Ticks then = (n + lost) * kPeriod;
      const double error = static_cast<double>(tracker.local(then).count()) - beacons.exact(then);
      EXPECT_LT(std::abs(error), 2e-6 * kTicksPerSecond) << ramp << ' ' << lost;
      EXPECT_LT(static_cast<double>(tracker.sigma(then).count()), 2e-6 * kTicksPerSecond) << lost;
    }
  }
}

// The tracker's sigma is consistent: normalized errors over many runs whose rate is the random walk that it
// assumes.
TEST(ClockTracker, ErrorsMatchItsSigma) {
  double sum_squares = 0.0;
  int samples = 0;
  std::mt19937_64 random(3);
  for (int run = 0; run < 300; ++run) {
    Beacons noise(0.0, 0.0, 0.0, random());
    const double seed_error_ppm = noise.gaussian();
    const double start_ppm = 15.0;
    double rate_ppm = start_ppm;
    double offset = 5e8;
    const double period_s = 0.02;
    ClockTracker tracker;
    tracker.seed(Ticks(0), ClockTime(std::llround(offset + 13.0 * noise.gaussian())),
                 static_cast<std::int32_t>(-(start_ppm + seed_error_ppm) * 1000.0));
    Ticks master(0);
    const auto advance = [&] {
      // Rate walk with its exact joint effect on the offset.
      const double walk = 0.1 * std::sqrt(period_s) * noise.gaussian();
      const double bend = 0.1 * std::sqrt(period_s) * noise.gaussian();
      offset += (rate_ppm * period_s + period_s * (walk / 2.0 + bend / (2.0 * std::sqrt(3.0)))) * 1e-6 *
                kTicksPerSecond;
      rate_ppm += walk;
      master += kPeriod;
    };
    for (int n = 0; n < 40; ++n) {
      advance();
      const double truth = offset + static_cast<double>(master.count());
      ASSERT_TRUE(tracker.update(master, ClockTime(std::llround(truth + 13.0 * noise.gaussian()))));
    }
    for (int n = 0; n < 15; ++n) advance();
    const double truth = offset + static_cast<double>(master.count());
    const double error = static_cast<double>(tracker.local(master).count()) - truth;
    const double sigma = static_cast<double>(tracker.sigma(master).count());
    sum_squares += error * error / (sigma * sigma);
    ++samples;
  }
  // Chi-square over 300: its mean within 4 sigma.
  EXPECT_NEAR(sum_squares / samples, 1.0, 4.0 * std::sqrt(2.0 / samples));
}

TEST(ClockTracker, RejectsAnOutlierAndIsUnaffected) {
  Beacons beacons(10.0, 0.0, 6.0, 4);
  ClockTracker tracker;
  tracker.seed(Ticks(0), beacons.timestamp(Ticks(0)), -10'000);
  for (int n = 1; n < 50; ++n) tracker.update(n * kPeriod, beacons.timestamp(n * kPeriod));
  const ClockTime before = tracker.local(60 * kPeriod);
  EXPECT_FALSE(tracker.update(50 * kPeriod, beacons.timestamp(50 * kPeriod) + Ticks::from_us(10)));
  EXPECT_FALSE(tracker.update(50 * kPeriod, beacons.timestamp(50 * kPeriod) - Ticks::from_us(1'000'000)));
  EXPECT_EQ(tracker.local(60 * kPeriod), before);
  EXPECT_TRUE(tracker.update(50 * kPeriod, beacons.timestamp(50 * kPeriod)));
}

TEST(ClockTracker, GivesTheMastersTimeOfThisNodesClock) {
  Beacons beacons(35.0, 0.0, 6.0, 6);
  ClockTracker tracker;
  tracker.seed(Ticks(0), beacons.timestamp(Ticks(0)), -35'000);
  for (int n = 1; n < 50; ++n) tracker.update(n * kPeriod, beacons.timestamp(n * kPeriod));
  for (const Ticks master : {45 * kPeriod, 50 * kPeriod, 100 * kPeriod}) {
    const Ticks back = tracker.master(tracker.local(master));
    EXPECT_NEAR(static_cast<double>((back - master).count()), 0.0, 50.0) << master.count();
  }
}

TEST(ClockTracker, HoursOfBeaconsLoseNoPrecision) {
  Beacons beacons(-39.0, 0.0, 6.0, 5);
  ClockTracker tracker;
  tracker.seed(Ticks(0), beacons.timestamp(Ticks(0)), 39'000);
  Ticks master(0);
  for (int n = 0; n < 400'000; ++n) {
    master += kPeriod;
    ASSERT_TRUE(tracker.update(master, beacons.timestamp(master)));
  }
  const Ticks next = master + kPeriod;
  // This test's double resolves 1/8 tick at 2.2 hours.
  EXPECT_NEAR(static_cast<double>(tracker.local(next).count()) - beacons.exact(next), 0.0, 60.0);
  EXPECT_NEAR(tracker.skew_ppb(), -39'000, 60);
}

}  // namespace
}  // namespace groma::mac
