#include "firmware/sim/world/site.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace groma::sim {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

Vector3d anywhere(const KeyedRandom& random) {
  return {random.of(0).uniform(-5.0, 5.0), random.of(1).uniform(-5.0, 5.0), random.of(2).uniform(0.0, 4.0)};
}

Wall any_wall(const KeyedRandom& random) {
  const Vector3d a = anywhere(random.of(0));
  const Vector3d b = anywhere(random.of(1));
  return {a.head<2>(), b.head<2>(), 0.2, random.of(2).uniform(0.5, 3.5), 0};
}

// Steps along the straight line and detects a change of side within the wall's outline.
bool crosses_by_stepping(const Wall& wall, const Vector3d& a, const Vector3d& b) {
  const Vector2d along = wall.to_m - wall.from_m;
  const Vector2d normal(-along.y(), along.x());
  constexpr int kSteps = 20'000;
  double last_side = normal.dot(a.head<2>() - wall.from_m);
  for (int i = 1; i <= kSteps; ++i) {
    const Vector3d p = a + (b - a) * (static_cast<double>(i) / kSteps);
    const double side = normal.dot(p.head<2>() - wall.from_m);
    if (side * last_side < 0.0) {
      const double along_wall = along.dot(p.head<2>() - wall.from_m) / along.squaredNorm();
      return along_wall >= 0.0 && along_wall <= 1.0 && p.z() >= wall.bottom_m && p.z() <= wall.top_m;
    }
    last_side = side;
  }
  return false;
}

TEST(Crossing, AgreesWithSteppingAlongTheLine) {
  int crossings = 0;
  int disagreements = 0;
  constexpr int kTries = 1500;
  for (int i = 0; i < kTries; ++i) {
    const KeyedRandom random = KeyedRandom(11).of(static_cast<std::uint64_t>(i));
    const Wall wall = any_wall(random.of(0));
    const Vector3d a = anywhere(random.of(1));
    const Vector3d b = anywhere(random.of(2));
    const bool crosses = crossing(wall, a, b).has_value();
    crossings += crosses ? 1 : 0;
    disagreements += crosses != crosses_by_stepping(wall, a, b) ? 1 : 0;
    EXPECT_EQ(crosses, crossing(wall, b, a).has_value()) << i;
  }
  EXPECT_GT(crossings, 100);
  EXPECT_LE(disagreements, 1) << "a step may hide an edge";
}

TEST(Crossing, GivesTheFractionOfTheCrossing) {
  const Wall wall{{2.0, -1.0}, {2.0, 1.0}, 0.0, 3.0, 0};
  EXPECT_NEAR(crossing(wall, {0.0, 0.0, 1.0}, {8.0, 0.0, 1.0}).value_or(-1.0), 0.25, 1e-12);
  EXPECT_FALSE(crossing(wall, {0.0, 0.0, 1.0}, {1.9, 0.0, 1.0}));
  EXPECT_FALSE(crossing(wall, {0.0, 1.5, 1.0}, {8.0, 1.5, 1.0}));
  EXPECT_FALSE(crossing(wall, {0.0, 0.0, 3.5}, {8.0, 0.0, 3.5}));
  EXPECT_FALSE(crossing(wall, {2.0, -3.0, 1.0}, {2.0, 3.0, 1.0})) << "a line within the wall's plane";
}

TEST(KnifeEdge, HasTheLossesOfTheRecommendation) {
  EXPECT_NEAR(knife_edge_loss_db(0.0, 5.0, 5.0), 6.0, 0.1);  // J(0) = 6.02 dB
  EXPECT_EQ(knife_edge_loss_db(-5.0, 5.0, 5.0), 0.0);
  // v = 2.4 at channel 5: 13 + 20 log10(v) for large v.
  const double wavelength_m = 299'792'458.0 / 6489.6e6;
  const double clearance_m = 2.4 / std::sqrt(2.0 * 10.0 / (wavelength_m * 25.0));
  EXPECT_NEAR(knife_edge_loss_db(clearance_m, 5.0, 5.0), 13.0 + 20.0 * std::log10(2.4), 0.3);
}

RadioClimate quiet_climate() {
  RadioClimate climate;
  climate.floor_reflection_loss_db.reset();
  return climate;
}

TEST(Site, FreeSpaceAddsNoDelayAndFollowsTheInverseSquare) {
  const Site site({}, {}, quiet_climate());
  const Vector3d a(0.0, 0.0, 1.0);
  for (const double distance_m : {1.0, 3.0, 10.0, 30.0}) {
    const Arrival arrival = site.arrival(a, a + Vector3d(distance_m, 0.0, 0.0), 0.0, KeyedRandom(1));
    EXPECT_TRUE(arrival.audible);
    EXPECT_TRUE(arrival.is_los);
    EXPECT_EQ(arrival.excess_m, 0.0);
    EXPECT_NEAR(arrival.receive_power_dbm, quiet_climate().power_at_1m_dbm - 20.0 * std::log10(distance_m),
                1e-9);
    EXPECT_NEAR(arrival.first_path_power_dbm, arrival.receive_power_dbm, 1e-9);
  }
  EXPECT_FALSE(site.arrival(a, a + Vector3d(60.0, 0.0, 0.0), 0.0, KeyedRandom(1)).audible);
}

TEST(Site, ATransparentWallDelaysAndAttenuates) {
  const Wall wall{{5.0, -40.0}, {5.0, 40.0}, -1.0, 40.0, 0};
  const Site site({{"brick", 9.0, 0.3, {}}}, {wall}, quiet_climate());
  const Site open({}, {}, quiet_climate());
  const Vector3d a(0.0, 0.0, 1.0);
  double sum = 0.0;
  double squares = 0.0;
  constexpr int kPlaces = 600;
  double last_m = 0.0;
  for (int i = 0; i < kPlaces; ++i) {
    const Vector3d b(10.0, -15.0 + 0.05 * i, 2.0);
    const Arrival arrival = site.arrival(a, b, 0.0, KeyedRandom(3));
    EXPECT_FALSE(arrival.is_los);
    EXPECT_GT(arrival.excess_m, 0.0);
    EXPECT_NEAR(arrival.first_path_power_dbm,
                open.arrival(a, b, 0.0, KeyedRandom(3)).first_path_power_dbm - 9.0, 1e-9);
    if (i > 0) {
      EXPECT_NEAR(arrival.excess_m, last_m, 0.03) << "the excess varies slowly";
    }
    last_m = arrival.excess_m;
    sum += arrival.excess_m;
    squares += arrival.excess_m * arrival.excess_m;
    EXPECT_EQ(arrival.excess_m, site.arrival(a, b, 0.0, KeyedRandom(3)).excess_m)
        << "the excess is deterministic";
  }
  const double mean = sum / kPlaces;
  EXPECT_NEAR(mean, 0.3, 0.05);
  EXPECT_GT(std::sqrt(squares / kPlaces - mean * mean), 0.03);
  const Vector3d b(10.0, 1.0, 2.0);
  EXPECT_NE(site.arrival(a, b, 0.0, KeyedRandom(3)).excess_m,
            site.arrival(a, b, 0.0, KeyedRandom(4)).excess_m);
}

TEST(Site, AnOpaqueWallIsPassedOnlyByReflection) {
  const Material metal{"cladding", kOpaqueLoss_db, 0.0, 3.0};
  const Wall wall{{5.0, -40.0}, {5.0, 40.0}, -1.0, 40.0, 0};
  const Vector3d a(0.0, 0.0, 1.0);
  const Vector3d b(10.0, 0.0, 1.0);
  const Site closed({metal}, {wall}, quiet_climate());
  EXPECT_FALSE(closed.arrival(a, b, 0.0, KeyedRandom(1)).audible);

  // A reflecting wall beside it lets the signal through, delayed by the detour.
  Wall half = wall;
  half.to_m.y() = 4.0;
  const Wall mirror{{-5.0, 8.0}, {15.0, 8.0}, -1.0, 40.0, 0};
  const Site open({metal}, {half, mirror}, quiet_climate());
  const Arrival arrival = open.arrival(a, b, 0.0, KeyedRandom(1));
  EXPECT_TRUE(arrival.audible);
  EXPECT_FALSE(arrival.is_los);
  EXPECT_NEAR(arrival.excess_m, std::hypot(10.0, 16.0) - 10.0, 1e-9);
}

TEST(Site, AnEdgeDiffractsWhatPassesCloseBehindIt) {
  const Material metal{"cladding", kOpaqueLoss_db, 0.0, {}};
  const Vector3d a(0.0, 0.0, 1.0);
  const Vector3d b(10.0, 0.0, 1.0);
  const Site site({metal}, {{{5.0, -40.0}, {5.0, 0.1}, -1.0, 40.0, 0}}, quiet_climate());
  const Arrival arrival = site.arrival(a, b, 0.0, KeyedRandom(1));
  EXPECT_TRUE(arrival.audible);
  EXPECT_FALSE(arrival.is_los);
  EXPECT_NEAR(arrival.excess_m, 2.0 * std::hypot(5.0, 0.12) - 10.0, 1e-9);
  EXPECT_LT(arrival.first_path_power_dbm, quiet_climate().power_at_1m_dbm - 20.0 - 6.0);
}

TEST(Site, ReflectionsAddPowerAndBiasTheTimestampSlightly) {
  const Material metal{"cladding", kOpaqueLoss_db, 0.0, 1.0};
  const Site site({metal}, {{{-5.0, 0.5}, {15.0, 0.5}, -1.0, 10.0, 0}}, quiet_climate());
  const Vector3d a(0.0, 0.0, 1.0);
  double largest_m = 0.0;
  for (double x = 4.0; x < 12.0; x += 0.01) {
    const Arrival arrival = site.arrival(a, {x, 0.0, 1.0}, 0.0, KeyedRandom(1));
    EXPECT_TRUE(arrival.is_los);
    EXPECT_GT(arrival.receive_power_dbm, arrival.first_path_power_dbm + 1.0);
    largest_m = std::max(largest_m, std::abs(arrival.excess_m));
  }
  EXPECT_GT(largest_m, 0.01);
  EXPECT_LT(largest_m, 0.15);
}

TEST(Site, ALowRackMakesOnlyTheLowTagNlos) {
  const Site site({{"rack", 8.0, 0.4, {}}}, {{{4.0, -3.0}, {4.0, 3.0}, 0.0, 1.2, 0}}, quiet_climate());
  const Vector3d anchor(10.0, 0.0, 3.0);
  EXPECT_FALSE(site.is_los({3.0, 0.0, 0.35}, anchor));
  EXPECT_TRUE(site.is_los({3.0, 0.0, 1.9}, anchor));
}

}  // namespace
}  // namespace groma::sim
