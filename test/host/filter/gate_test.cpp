#include "host/filter/gate.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "test/host/filter/small_site.hpp"
#include "test/support/random.hpp"

namespace groma::filter {
namespace {

constexpr double kSigma_m = 0.1;
constexpr double kVariance_m2 = kSigma_m * kSigma_m;

double fresh_weight(double innovation_m) {
  return Gate(GateConfig{}).weigh(0, 0, 0.0, innovation_m, kVariance_m2);
}

TEST(Gate, TurnsAwayWhatIsNoNumber) {
  Gate gate{GateConfig{}};
  for (const auto& [innovation, variance] : {std::pair{testing::kNan, 1.0},
                                             {1.0, testing::kNan},
                                             {testing::kInfinity, 1.0},
                                             {-testing::kInfinity, 1.0},
                                             {1.0, testing::kInfinity},
                                             {0.0, 0.0},
                                             {0.0, -1.0}}) {
    EXPECT_EQ(gate.weigh(0, 0, 0.0, innovation, variance), 0.0);
  }
  EXPECT_TRUE(std::isfinite(gate.blocked(0, 0)));
  EXPECT_GT(gate.weigh(0, 0, 1.0, 0.0, kVariance_m2), 0.9);
}

TEST(Gate, WeighsInnovationsByTheirSizeAndRangesThatAreTooLongLess) {
  EXPECT_GT(fresh_weight(0.0), 0.95);
  for (const double sigmas : {1.5, 2.0, 3.0, 4.0}) {
    EXPECT_LT(fresh_weight(sigmas * kSigma_m), fresh_weight(-sigmas * kSigma_m)) << sigmas;
  }
  double last = 1.0;
  for (double e = 1.0; e < 8.0; e += 0.25) {
    const double weight = fresh_weight(e * kSigma_m);
    EXPECT_LE(weight, last);
    last = weight;
  }
  EXPECT_EQ(last, 0.0);
  EXPECT_EQ(fresh_weight(300e3), 0.0);
  EXPECT_EQ(fresh_weight(-300e3), 0.0);
}

TEST(Gate, GarbageLeavesAPairAsItWas) {
  for (const double garbage_m : {300e3, 500.0, 30.0, -30.0, -500.0, -300e3}) {
    Gate gate{GateConfig{}};
    static_cast<void>(gate.weigh(0, 0, 0.0, garbage_m, kVariance_m2));
    EXPECT_TRUE(std::isfinite(gate.blocked(0, 0))) << garbage_m;
    EXPECT_GT(gate.weigh(0, 0, 0.1, 0.0, kVariance_m2), 0.9) << garbage_m;
  }
  // With no class for garbage, nothing explains it; nothing is learnt from it.
  GateConfig config;
  config.garbage_share = 0.0;
  Gate gate(config);
  EXPECT_EQ(gate.weigh(0, 0, 0.0, 300e3, kVariance_m2), 0.0);
  EXPECT_GT(gate.weigh(0, 0, 0.1, 0.0, kVariance_m2), 0.9);
}

TEST(Gate, AWideVarianceForgives) {
  Gate gate{GateConfig{}};
  EXPECT_GT(gate.weigh(0, 0, 0.0, 8.0, 100.0), 0.85);
  EXPECT_GT(gate.weigh(0, 1, 0.0, 0.0, 1e12), 0.0);
}

TEST(Gate, RemembersABlockedPairForAWhileAndNoOtherPair) {
  Gate gate{GateConfig{}};
  double t_s = 0.0;
  for (; t_s < 2.0; t_s += 0.1) {
    static_cast<void>(gate.weigh(3, 1, t_s, 5.0 * kSigma_m, kVariance_m2));
    static_cast<void>(gate.weigh(3, 2, t_s, 0.0, kVariance_m2));
  }
  EXPECT_GT(gate.blocked(3, 1), 0.4);
  EXPECT_LT(gate.blocked(3, 2), 0.1);
  // An innovation that by itself would pass is taken for a blocked one still.
  const double suspect = gate.weigh(3, 1, t_s, 1.5 * kSigma_m, kVariance_m2);
  EXPECT_LT(suspect, gate.weigh(3, 2, t_s, 1.5 * kSigma_m, kVariance_m2) - 0.2);
  // Back in sight: trusted again within seconds.
  for (const double end_s = t_s + 2.0; t_s < end_s; t_s += 0.1)
    static_cast<void>(gate.weigh(3, 1, t_s, 0.0, kVariance_m2));
  EXPECT_GT(gate.weigh(3, 1, t_s, 0.0, kVariance_m2), 0.95);
}

TEST(Gate, DoubtsTheStateWhenMostIsRefusedAndNotForOneBlockedPair) {
  const GateConfig config;
  Gate gate(config);
  double t_s = 0.0;
  for (int i = 0; i < 200; ++i, t_s += 0.01) {
    static_cast<void>(gate.weigh(i % 6, 0, t_s, i % 6 == 0 ? 3.0 : 0.0, kVariance_m2));
    EXPECT_FALSE(gate.doubts(t_s));
  }
  for (int i = 0; i < 300; ++i, t_s += 0.01) static_cast<void>(gate.weigh(i % 6, 0, t_s, 3.0, kVariance_m2));
  EXPECT_TRUE(gate.doubts(t_s));
  EXPECT_EQ(gate.doubts_begun(), 1U);
  // Silence is no reason for doubt.
  EXPECT_FALSE(gate.doubts(t_s + 2.0 * config.window_s));
  // Good ranges end it.
  for (int i = 0; i < 300; ++i, t_s += 0.01) static_cast<void>(gate.weigh(i % 6, 0, t_s, 0.0, kVariance_m2));
  EXPECT_FALSE(gate.doubts(t_s));
}

// A range each 10 ms by the anchors in turn, of which the first so many are off by that much.
double feed(Gate& gate, double begin_s, double duration_s, int anchors, int off, double off_m) {
  double t_s = begin_s;
  for (int i = 0; t_s < begin_s + duration_s; ++i, t_s += 0.01) {
    static_cast<void>(gate.weigh(i % anchors, 0, t_s, i % anchors < off ? off_m : 0.0, kVariance_m2));
  }
  return t_s;
}

TEST(Gate, TakesManyTooLongForBlockedUntilItLastsAndTooShortForAWrongState) {
  for (const double off_m : {5.0 * kSigma_m, -5.0 * kSigma_m}) {
    Gate gate{GateConfig{}};
    double t_s = feed(gate, 0.0, 10.0, 12, 0, 0.0);
    t_s = feed(gate, t_s, 3.0, 12, 10, off_m);
    EXPECT_EQ(gate.doubts(t_s), off_m < 0.0);
    t_s = feed(gate, t_s, 10.0, 12, 10, off_m);
    EXPECT_TRUE(gate.doubts(t_s));
  }
}

TEST(Gate, DoubtsWhereAsManyAnchorsAreFarOffAsAgreeButForThreeThatAgree) {
  const auto doubts = [](int anchors, int off, double off_m) {
    Gate gate{GateConfig{}};
    double t_s = feed(gate, 0.0, 10.0, anchors, 0, 0.0);
    t_s = feed(gate, t_s, 2.0, anchors, off, off_m);
    return gate.doubts(t_s);
  };
  EXPECT_TRUE(doubts(4, 2, 2.0));
  EXPECT_FALSE(doubts(4, 2, 0.5));  // as much as an obstacle adds
  EXPECT_FALSE(doubts(4, 1, 2.0));
  EXPECT_FALSE(doubts(2, 1, 2.0));
  EXPECT_FALSE(doubts(5, 2, 2.0));
  EXPECT_FALSE(doubts(6, 3, 2.0));
}

}  // namespace
}  // namespace groma::filter
