// Draws of the medium: keyed, of the right distribution, the same in any order.
#include "firmware/sim/medium.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "test/sim/radio_bench.hpp"

namespace groma::sim {
namespace {

struct MediumTest : testing::Test {
  DistanceTable space;
  static AirFrame frame(std::size_t source, std::uint32_t number) {
    AirFrame f;
    f.source = source;
    f.number = number;
    return f;
  }
};

struct ThreeStations {
  ThreeStations(const PropagationModel& space, const MediumSettings& settings, std::uint64_t seed)
      : medium(space, settings, seed), a({.id = 10}, medium), b({.id = 20}, medium), c({.id = 30}, medium) {}
  Medium medium;
  Dw1000Chip a, b, c;
};

TEST_F(MediumTest, FlightIsExactToAFractionOfATick) {
  space.set(10, 20, {.audible = true, .flight_m = 12.3456});
  const ThreeStations air(space, {}, 1);
  const Reception reception = air.medium.reception(frame(0, 1), 1);
  const double ticks = static_cast<double>(reception.delay) / 5.0 + reception.delay_residue_ticks;
  EXPECT_NEAR(ticks * kMetresPerTick, 12.3456, 1e-9);
  EXPECT_GE(reception.delay_residue_ticks, 0.0);
  EXPECT_LT(reception.delay_residue_ticks, 0.2);
}

TEST_F(MediumTest, ADrawDependsOnItsKeysAlone) {
  const MediumSettings settings{.loss_probability = 0.5};
  const ThreeStations one(space, settings, 7);
  const ThreeStations two(space, settings, 7);
  const ThreeStations other(space, settings, 8);
  int differ = 0;
  for (std::uint32_t n = 1; n < 200; ++n) {
    const Reception forward = one.medium.reception(frame(0, n), 1);
    const Reception backward = two.medium.reception(frame(0, 200 - n), 1);
    const Reception same = two.medium.reception(frame(0, n), 1);
    EXPECT_EQ(forward.timestamp_noise_ticks, same.timestamp_noise_ticks);
    EXPECT_EQ(forward.carrier_noise_ppm, same.carrier_noise_ppm);
    EXPECT_EQ(forward.loss, same.loss);
    EXPECT_EQ(forward.junk, same.junk);
    if (n != 100) {
      EXPECT_NE(forward.timestamp_noise_ticks, backward.timestamp_noise_ticks);
    }
    EXPECT_NE(forward.timestamp_noise_ticks, one.medium.reception(frame(0, n), 2).timestamp_noise_ticks);
    EXPECT_NE(forward.timestamp_noise_ticks, one.medium.reception(frame(1, n), 0).timestamp_noise_ticks);
    differ += forward.loss != other.medium.reception(frame(0, n), 1).loss ? 1 : 0;
  }
  EXPECT_GT(differ, 50);
}

TEST_F(MediumTest, LossesHaveTheirRateAndKinds) {
  const double p = 0.02;
  const ThreeStations air(space, {.loss_probability = p}, 3);
  constexpr int kFrames = 200'000;
  std::array<double, 5> seen{};
  for (std::uint32_t n = 0; n < kFrames; ++n)
    seen[static_cast<std::size_t>(air.medium.reception(frame(n % 3, n / 3), (n + 1) % 3).loss)] += 1.0;
  const std::array<double, 5> share{1.0 - p, 0.5 * p, 0.15 * p, 0.15 * p, 0.2 * p};
  double chi2 = 0.0;
  for (std::size_t i = 0; i < share.size(); ++i) {
    const double expected = share[i] * kFrames;
    chi2 += (seen[i] - expected) * (seen[i] - expected) / expected;
  }
  EXPECT_LT(chi2, 18.47) << "99.9 % of 4 degrees of freedom";
}

TEST_F(MediumTest, LossesFollowNoPatternInTime) {
  const ThreeStations air(space, {.loss_probability = 0.3}, 5);
  // Pairs of consecutive frames: the four outcomes have the products of their shares.
  std::array<double, 4> seen{};
  constexpr std::uint32_t kPairs = 50'000;
  for (std::uint32_t n = 0; n < kPairs; ++n) {
    const bool lost = air.medium.reception(frame(0, 2 * n), 1).loss != Loss::kNone;
    const bool next = air.medium.reception(frame(0, 2 * n + 1), 1).loss != Loss::kNone;
    seen[(lost ? 2U : 0U) + (next ? 1U : 0U)] += 1.0;
  }
  const std::array<double, 4> share{0.49, 0.21, 0.21, 0.09};
  double chi2 = 0.0;
  for (std::size_t i = 0; i < 4; ++i) chi2 += std::pow(seen[i] - share[i] * kPairs, 2) / (share[i] * kPairs);
  EXPECT_LT(chi2, 16.27) << "99.9 % of 3 degrees of freedom";
}

TEST_F(MediumTest, TimestampNoiseIsGaussianWithTheConfiguredSigma) {
  const ThreeStations air(space, {.timestamp_noise_s = 1e-10}, 9);
  constexpr int kFrames = 100'000;
  double sum = 0.0;
  double squares = 0.0;
  double beyond_two_sigma = 0.0;
  for (std::uint32_t n = 0; n < kFrames; ++n) {
    const double noise_s = air.medium.reception(frame(0, n), 1).timestamp_noise_ticks / 63.8976e9;
    sum += noise_s;
    squares += noise_s * noise_s;
    beyond_two_sigma += std::abs(noise_s) > 2e-10 ? 1.0 : 0.0;
  }
  EXPECT_NEAR(sum / kFrames, 0.0, 4.0 * 1e-10 / std::sqrt(kFrames));
  EXPECT_NEAR(std::sqrt(squares / kFrames), 1e-10, 1e-12);
  EXPECT_NEAR(beyond_two_sigma / kFrames, 0.0455, 0.0026);
}

// ---- faults ---------------------------------------------------------------------------------------

AirFrame frame_at(std::uint32_t number, SimTime rmarker) {
  AirFrame frame;
  frame.number = number;
  frame.rmarker = rmarker;
  return frame;
}

TEST_F(MediumTest, AFadeAffectsItsShareOfFramesInItsTimeOnly) {
  ThreeStations air(space, {}, 3);
  air.medium.add_fade({.from = from_seconds(1.0), .until = from_seconds(2.0), .probability = 0.3}, 0);
  std::array<int, 3> lost{};
  constexpr std::uint32_t kFrames = 30'000;
  for (std::uint32_t n = 0; n < kFrames; ++n) {
    const double t_s = 3.0 * n / kFrames;
    const AirFrame frame = frame_at(n, from_seconds(t_s));
    const Loss loss = air.medium.reception(frame, 1).loss;
    EXPECT_EQ(loss, air.medium.reception(frame, 1).loss);
    lost[static_cast<std::size_t>(t_s)] += loss != Loss::kNone ? 1 : 0;
  }
  EXPECT_EQ(lost[0], 0);
  EXPECT_NEAR(lost[1], 3000, 4 * std::sqrt(10'000 * 0.21));
  EXPECT_EQ(lost[2], 0);
}

TEST_F(MediumTest, AFadeHitsOnlyItsFramesAndLinks) {
  ThreeStations air(space, {}, 3);
  air.medium.add_fade(
      {.silent = true,
       .hits = [](const AirFrame& frame, std::uint16_t from,
                  std::uint16_t to) { return frame.data[9] == 0x42 && from == 10 && to == 30; }},
      0);
  AirFrame frame = frame_at(1, from_seconds(1.0));
  EXPECT_EQ(air.medium.reception(frame, 2).loss, Loss::kNone);
  frame.data[9] = 0x42;
  EXPECT_EQ(air.medium.reception(frame, 1).loss, Loss::kNone);
  EXPECT_EQ(air.medium.reception(frame, 2).loss, Loss::kUnheard);
}

TEST_F(MediumTest, TwoFadesDrawIndependently) {
  ThreeStations air(space, {}, 3);
  for (int i = 0; i < 2; ++i) air.medium.add_fade({.probability = 0.5}, 0);
  int received = 0;
  for (std::uint32_t n = 0; n < 10'000; ++n)
    received += air.medium.reception(frame_at(n, from_seconds(1.0)), 1).loss == Loss::kNone ? 1 : 0;
  EXPECT_NEAR(received, 2500, 4 * std::sqrt(10'000 * 0.25 * 0.75));
}

TEST_F(MediumTest, AnExpiredFadeChangesNoLaterOne) {
  const auto losses = [&](bool with_an_old_one) {
    ThreeStations air(space, {}, 3);
    air.medium.add_fade({.until = from_seconds(1.0)}, 0);
    if (with_an_old_one) air.medium.add_fade({.until = from_seconds(1.5)}, 0);
    air.medium.add_fade({.from = from_seconds(2.0), .probability = 0.5},
                        with_an_old_one ? from_seconds(1.9) : 0);
    int lost = 0;
    for (std::uint32_t n = 0; n < 1000; ++n)
      lost += air.medium.reception(frame_at(n, from_seconds(3.0)), 1).loss != Loss::kNone ? 1 : 0;
    return lost;
  };
  EXPECT_NEAR(losses(false), 500, 64);
  EXPECT_NEAR(losses(true), 500, 64);
}

}  // namespace
}  // namespace groma::sim
