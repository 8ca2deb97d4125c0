#include "host/filter/gate.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <vector>

#include "test/host/filter/small_site.hpp"
#include "test/support/random.hpp"

namespace groma::filter {
namespace {

constexpr double kSigma_m = 0.1;
constexpr double kVariance_m2 = kSigma_m * kSigma_m;

using test::Random;

double fresh_weight(double innovation_m) {
  return Gate(GateConfig{}).weigh(0, 0, 0.0, innovation_m, kVariance_m2);
}

TEST(Gate, RejectsNonFiniteValues) {
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
  EXPECT_TRUE(std::isfinite(gate.nlos(0, 0)));
  EXPECT_GT(gate.weigh(0, 0, 1.0, 0.0, kVariance_m2), 0.9);
}

TEST(Gate, WeightFallsWithTheInnovationAndFasterForLongRanges) {
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
    EXPECT_TRUE(std::isfinite(gate.nlos(0, 0))) << garbage_m;
    EXPECT_GT(gate.weigh(0, 0, 0.1, 0.0, kVariance_m2), 0.9) << garbage_m;
  }
  // Without garbage in the model no hypothesis explains the range, and the pair's probability stays.
  GateConfig config;
  config.garbage_share = 0.0;
  Gate gate(config);
  EXPECT_EQ(gate.weigh(0, 0, 0.0, 300e3, kVariance_m2), 0.0);
  EXPECT_GT(gate.weigh(0, 0, 0.1, 0.0, kVariance_m2), 0.9);
}

TEST(Gate, ALargeVarianceAcceptsLargeInnovations) {
  Gate gate{GateConfig{}};
  EXPECT_GT(gate.weigh(0, 0, 0.0, 8.0, 100.0), 0.85);
  EXPECT_GT(gate.weigh(0, 1, 0.0, 0.0, 1e12), 0.0);
}

TEST(Gate, RemembersAnNlosPairForAWhile) {
  Gate gate{GateConfig{}};
  double t_s = 0.0;
  for (; t_s < 2.0; t_s += 0.1) {
    static_cast<void>(gate.weigh(3, 1, t_s, 5.0 * kSigma_m, kVariance_m2));
    static_cast<void>(gate.weigh(4, 2, t_s, 0.0, kVariance_m2));
  }
  EXPECT_GT(gate.nlos(3, 1), 0.4);
  EXPECT_LT(gate.nlos(4, 2), 0.1);
  // An innovation that would pass for another pair still has a low weight.
  const double suspect = gate.weigh(3, 1, t_s, 1.5 * kSigma_m, kVariance_m2);
  EXPECT_LT(suspect, gate.weigh(4, 2, t_s, 1.5 * kSigma_m, kVariance_m2) - 0.2);
  // LOS again: full weight within seconds.
  for (const double end_s = t_s + 2.0; t_s < end_s; t_s += 0.1)
    static_cast<void>(gate.weigh(3, 1, t_s, 0.0, kVariance_m2));
  EXPECT_GT(gate.weigh(3, 1, t_s, 0.0, kVariance_m2), 0.95);
}

TEST(Gate, ExpectsNlosOfAnAnchorForItsOtherTags) {
  Gate gate{GateConfig{}};
  for (double t_s = 0.0; t_s < 2.0; t_s += 0.1) {
    static_cast<void>(gate.weigh(3, 1, t_s, 5.0 * kSigma_m, kVariance_m2));
    static_cast<void>(gate.weigh(4, 1, t_s, 0.0, kVariance_m2));
  }
  // The same moderate innovation for another tag at the NLOS anchor and at the LOS anchor.
  const double next = gate.weigh(3, 2, 2.0, 1.5 * kSigma_m, kVariance_m2);
  EXPECT_LT(next, gate.weigh(4, 2, 2.0, 1.5 * kSigma_m, kVariance_m2) - 0.1);
  EXPECT_LT(next, fresh_weight(1.5 * kSigma_m) - 0.1);
  // The first tag is LOS again, but the second one stays NLOS.
  for (double t_s = 2.1; t_s < 4.0; t_s += 0.1) {
    static_cast<void>(gate.weigh(3, 2, t_s, 5.0 * kSigma_m, kVariance_m2));
    static_cast<void>(gate.weigh(3, 1, t_s, 0.0, kVariance_m2));
  }
  EXPECT_GT(gate.nlos(3, 2), 0.4);
}

// E(x^2 | e) for e = x + n, x exponential and n Gaussian, by Simpson's rule.
TEST(RangeDensity, MeanSquareExcessEqualsNumericalIntegration) {
  for (const double mean_m : {0.5, 3.0}) {
    for (const double sigma_m : {0.05, 0.3, 2.0, 6.0}) {
      for (const double error_m : {-5.0, -1.0, -0.1, 0.0, 0.2, 1.0, 4.0, 15.0}) {
        // The integrand is concentrated near the error, or near zero if the error is negative.
        const double width_m = std::min(sigma_m, sigma_m * sigma_m / (std::abs(error_m) + sigma_m));
        const double from_m = std::max(0.0, error_m - sigma_m * sigma_m / mean_m - 12.0 * sigma_m);
        const double to_m = std::max(0.0, error_m) + 12.0 * sigma_m;
        const int steps = 2 * static_cast<int>(std::ceil((to_m - from_m) / width_m * 50.0));
        const double step_m = (to_m - from_m) / steps;
        double density = 0.0;
        double square = 0.0;
        for (int i = 0; i <= steps; ++i) {
          const double x = from_m + i * step_m;
          const double inner = i % 2 == 0 ? 2.0 : 4.0;
          const double weight = (i == 0 || i == steps ? 1.0 : inner) * step_m / 3.0;
          // Relative to the largest value, to avoid underflow.
          const double z = (error_m - x) / sigma_m;
          const double z0 = std::min(error_m, 0.0) / sigma_m;
          const double p = weight * std::exp(-0.5 * (z * z - z0 * z0) - x / mean_m);
          density += p;
          square += p * x * x;
        }
        const double expected = square / density;
        // In the far tail the exponential approximation is good to some per cent.
        const bool is_tail = error_m / sigma_m - sigma_m / mean_m < -8.0;
        EXPECT_NEAR(excess_square(error_m, sigma_m, mean_m), expected, (is_tail ? 0.1 : 1e-6) * expected)
            << error_m << " " << sigma_m << " " << mean_m;
      }
    }
  }
}

TEST(Gate, SuspectsDivergenceIfMostIsRefusedAndNotForOneNlosPair) {
  const GateConfig config;
  Gate gate(config);
  double t_s = 0.0;
  for (int i = 0; i < 200; ++i, t_s += 0.01) {
    static_cast<void>(gate.weigh(i % 6, 0, t_s, i % 6 == 0 ? 3.0 : 0.0, kVariance_m2));
    EXPECT_FALSE(gate.suspects_divergence(t_s));
  }
  for (int i = 0; i < 300; ++i, t_s += 0.01) static_cast<void>(gate.weigh(i % 6, 0, t_s, 3.0, kVariance_m2));
  EXPECT_TRUE(gate.suspects_divergence(t_s));
  EXPECT_EQ(gate.divergences(), 1U);
  // No suspected divergence without ranges.
  EXPECT_FALSE(gate.suspects_divergence(t_s + 2.0 * config.window_s));
  // Good ranges clear the flag.
  for (int i = 0; i < 300; ++i, t_s += 0.01) static_cast<void>(gate.weigh(i % 6, 0, t_s, 0.0, kVariance_m2));
  EXPECT_FALSE(gate.suspects_divergence(t_s));
}

// One range each 10 ms from the anchors in turn; the first `off` anchors have the error off_m.
double feed(Gate& gate, double begin_s, double duration_s, int anchors, int off, double off_m) {
  double t_s = begin_s;
  for (int i = 0; t_s < begin_s + duration_s; ++i, t_s += 0.01) {
    static_cast<void>(gate.weigh(i % anchors, 0, t_s, i % anchors < off ? off_m : 0.0, kVariance_m2));
  }
  return t_s;
}

TEST(Gate, TakesManyOutliersForAWrongStartOnlyBeforeRangesHaveAgreed) {
  for (const double off_m : {5.0 * kSigma_m, -5.0 * kSigma_m}) {
    Gate gate{GateConfig{}};
    double t_s = feed(gate, 0.0, 3.0, 12, 10, off_m);
    EXPECT_TRUE(gate.suspects_divergence(t_s));
    t_s = feed(gate, t_s, 20.0, 12, 0, 0.0);
    EXPECT_FALSE(gate.suspects_divergence(t_s));
    t_s = feed(gate, t_s, 15.0, 12, 10, off_m);
    EXPECT_FALSE(gate.suspects_divergence(t_s));
    gate.reset(t_s);
    t_s = feed(gate, t_s, 3.0, 12, 10, off_m);
    EXPECT_TRUE(gate.suspects_divergence(t_s));
  }
}

TEST(Gate, SuspectsDivergenceIfAsManyAnchorsAreFarOffAsAgreeUnlessThreeAgree) {
  const auto suspects_divergence = [](int anchors, int off, double off_m) {
    Gate gate{GateConfig{}};
    double t_s = feed(gate, 0.0, 10.0, anchors, 0, 0.0);
    t_s = feed(gate, t_s, 2.0, anchors, off, off_m);
    return gate.suspects_divergence(t_s);
  };
  EXPECT_TRUE(suspects_divergence(4, 2, 2.0));
  EXPECT_FALSE(suspects_divergence(4, 2, 0.5));  // a typical NLOS excess
  EXPECT_FALSE(suspects_divergence(4, 1, 2.0));
  EXPECT_FALSE(suspects_divergence(2, 1, 2.0));
  EXPECT_FALSE(suspects_divergence(5, 2, 2.0));
  EXPECT_FALSE(suspects_divergence(6, 3, 2.0));
}

// A range of 10 m whose first path has strength_dbm at 1 m and is hidden_db below the total power.
model::RangeSample with_powers(double strength_dbm, double hidden_db) {
  model::RangeSample range;
  range.range_m = 10.0;
  range.first_path_power_dbm = static_cast<float>(strength_dbm - 20.0);
  range.receive_power_dbm = static_cast<float>(strength_dbm - 20.0 + hidden_db);
  return range;
}

model::PowerClass class_of(double strength_dbm, double hidden_db) {
  return model::power_class(with_powers(strength_dbm, hidden_db));
}

TEST(PowerHint, ClassesFollowTheChipsFiguresAndTheStrength) {
  const auto hidden = [](model::PowerClass of) { return model::hidden_class(of); };
  EXPECT_EQ(hidden(class_of(-60.0, 0.0)), 0U);
  EXPECT_EQ(hidden(class_of(-60.0, 5.9)), 0U);
  EXPECT_EQ(hidden(class_of(-60.0, 6.1)), 1U);
  EXPECT_EQ(hidden(class_of(-60.0, 9.9)), 1U);
  EXPECT_EQ(hidden(class_of(-60.0, 10.1)), 2U);
  EXPECT_EQ(class_of(-59.9, 1.0), class_of(-57.1, 1.0));
  EXPECT_NE(class_of(-60.1, 1.0), class_of(-59.9, 1.0));
  EXPECT_EQ(class_of(-99.0, 1.0), class_of(-300.0, 1.0));
  EXPECT_EQ(class_of(-50.0, 1.0), class_of(300.0, 1.0));
  // The class does not depend on the length.
  model::RangeSample far = with_powers(-58.0, 1.0);
  far.range_m = 20.0;
  far.first_path_power_dbm -= 6.02F;
  far.receive_power_dbm -= 6.02F;
  EXPECT_EQ(model::power_class(far), class_of(-58.0, 1.0));

  model::RangeSample sample;
  sample.range_m = 10.0;
  EXPECT_EQ(model::power_class(sample), model::kNoPowerClass);
  sample.first_path_power_dbm = -80.0F;
  EXPECT_EQ(model::power_class(sample), model::kNoPowerClass);
  sample.first_path_power_dbm = model::kUnknown;
  sample.line_of_sight = model::LineOfSight::kUnlikely;
  EXPECT_EQ(hidden(model::power_class(sample)), 2U);
  EXPECT_EQ(model::power_class(sample) % model::kStrengthClasses, model::kStrengthClasses - 1);
  sample.line_of_sight = model::LineOfSight::kLikely;
  EXPECT_EQ(hidden(model::power_class(sample)), 0U);
}

// Reference for PowerHint: the probability of a class from all counted ranges, summed directly.
struct PowerObservation {
  model::PowerClass of = 0;
  double t_s = 0.0;
  double nlos = 0.0;
  double los = 0.0;
};
double share_of_all(const std::vector<PowerObservation>& all, double PowerObservation::*state,
                    model::PowerClass of, double t_s, const GateConfig& config) {
  constexpr double kLos[] = {0.8, 0.15, 0.05};
  constexpr double kNlos[] = {0.4, 0.3, 0.3};
  const std::size_t hidden = of / model::kStrengthClasses;
  const double believed = (state == &PowerObservation::nlos ? kNlos[hidden] : kLos[hidden]) /
                          static_cast<double>(model::kStrengthClasses);
  double of_class = config.hint_prior_count * believed;
  double sum = config.hint_prior_count;
  for (const PowerObservation& one : all) {
    const double counted = one.*state * std::exp(-(t_s - one.t_s) / config.hint_memory_s);
    sum += counted;
    if (one.of == of) of_class += counted;
  }
  return of_class / sum;
}

TEST(PowerHint, IsTheDecayingCountOfObservations) {
  GateConfig config;
  config.hint_memory_s = 3.0;  // short, so that the unit is renormalized during the test
  config.hint_most = 50.0;
  PowerHint hint(config);
  EXPECT_NEAR(hint.likelihood_ratio(class_of(-60.0, 12.0)), 0.3 / 0.05, 1e-12);
  EXPECT_NEAR(hint.likelihood_ratio(class_of(-70.0, 1.0)), 0.4 / 0.8, 1e-12);
  EXPECT_EQ(hint.likelihood_ratio(model::kNoPowerClass), 1.0);
  Random random(31);
  std::vector<PowerObservation> all;
  double t_s = 0.0;
  for (int i = 0; i < 3000; ++i) {
    t_s += 0.05 * random.uniform();
    const double nlos = random.uniform();
    all.push_back({static_cast<model::PowerClass>(random.next() % model::kNoPowerClass), t_s, nlos,
                   (1.0 - nlos) * random.uniform()});
    hint.observe(all.back().of, t_s, all.back().nlos, all.back().los);
    if (i % 500 != 499) continue;
    for (model::PowerClass of = 0; of < model::kNoPowerClass; ++of) {
      const double expected = share_of_all(all, &PowerObservation::nlos, of, t_s, config) /
                              share_of_all(all, &PowerObservation::los, of, t_s, config);
      EXPECT_NEAR(hint.likelihood_ratio(of), expected, 1e-9 * expected) << of;
    }
  }
  const model::PowerClass rare = class_of(-60.0, 12.0);
  for (int i = 0; i < 1000; ++i) hint.observe(rare, t_s + 100.0, 1.0, 0.0);
  EXPECT_EQ(hint.likelihood_ratio(rare), config.hint_most);
}

// A Gaussian plus an exponential excess, by the trapezoidal rule.
double with_excess(double x, double sigma, double mean) {
  constexpr int kSteps = 4000;
  const double end = 20.0 * mean;
  double sum = 0.0;
  for (int i = 0; i <= kSteps; ++i) {
    const double excess = end * i / kSteps;
    const double e = (x - excess) / sigma;
    sum += (i == 0 || i == kSteps ? 0.5 : 1.0) * std::exp(-excess / mean - 0.5 * e * e);
  }
  return sum * end / kSteps / (mean * sigma * std::sqrt(2.0 * std::numbers::pi));
}

TEST(Gate, WeightEqualsTheBayesianPosterior) {
  GateConfig config;
  config.hint_s = 0.8;
  Gate gate(config);
  PowerHint reference(config);
  Random random(32);
  constexpr double kStep_s = 0.5;  // polls too rare for the reception test
  double chain = config.nlos_prior;
  double t_s = 0.0;
  for (int i = 0; i < 200; ++i) {
    t_s += kStep_s;
    const bool behind_wall = i / 20 % 2 == 1;
    const double e_m = kSigma_m * random.gaussian() + (behind_wall ? 0.3 : 0.0);
    const bool seen = random.uniform() < 0.8;
    const model::PowerClass of = i % 7 == 3            ? model::kNoPowerClass
                                 : behind_wall == seen ? class_of(-70.0, 11.0)
                                                       : class_of(-58.0, 1.0);
    const auto densities = [&](double share) {
      const double los = (1.0 - share) * (1.0 - config.garbage_share) *
                         std::exp(-0.5 * e_m * e_m / kVariance_m2) /
                         (kSigma_m * std::sqrt(2.0 * std::numbers::pi));
      const double nlos = share * (1.0 - config.garbage_share) * with_excess(e_m, kSigma_m, config.excess_m);
      return std::pair{los, nlos};
    };
    const double garbage = config.garbage_share / config.garbage_width_m;
    const double prior =
        config.nlos_prior + (chain - config.nlos_prior) * std::exp(-kStep_s / config.sticky_s);
    const auto [los, nlos] = densities(prior);
    const double total = los + nlos + garbage;
    chain = std::min((nlos + garbage * prior) / total, config.nlos_max);
    const double weight = gate.weigh(2, 1, t_s, e_m, kVariance_m2, of);
    double expected = los / total;
    if (of != model::kNoPowerClass) {
      const double ratio = reference.likelihood_ratio(of);
      const double count = kStep_s / config.hint_s;
      if (!gate.suspects_divergence(t_s))
        reference.observe(of, t_s, count * nlos / total, count * los / total);
      const double all = reference.nlos_share();
      const double known = std::min(std::max(prior, all), config.nlos_max);
      const auto [now_los, now_nlos] = densities(1.0 / (1.0 + (1.0 - known) / (ratio * known)));
      expected = now_los / (now_los + now_nlos + garbage);
      expected *= std::pow((1.0 - all) / (1.0 - all + ratio * all), 2);
    }
    if (weight > 0.0) {
      ASSERT_NEAR(weight, expected, 1e-4) << i;
    } else {
      ASSERT_LT(expected, 2e-3) << i;
    }
  }
}

TEST(Gate, UnusedPowersChangeNoBit) {
  GateConfig config;
  config.hint_most = 1.0;
  Gate plain{GateConfig{}};
  Gate unused(config);
  Random random(33);
  double t_s = 0.0;
  for (int i = 0; i < 2000; ++i) {
    t_s += 0.02 * random.uniform();
    const int anchor = static_cast<int>(random.next() % 6);
    const double e_m = 0.15 * random.gaussian() + (anchor == 2 ? 0.4 : 0.0);
    const model::PowerClass of = static_cast<model::PowerClass>(random.next() % model::kNoPowerClass);
    ASSERT_EQ(plain.weigh(anchor, 0, t_s, e_m, kVariance_m2),
              unused.weigh(anchor, 0, t_s, e_m, kVariance_m2, of));
    ASSERT_EQ(plain.nlos(anchor, 0), unused.nlos(anchor, 0));
    ASSERT_EQ(plain.suspects_divergence(t_s), unused.suspects_divergence(t_s));
  }
}

// Five LOS anchors and one that is NLOS every other 5 s. informative: whether its powers indicate that.
void train(Gate& gate, bool informative, Random& random) {
  double t_s = 0.0;
  for (int i = 0; t_s < 60.0; ++i, t_s += 0.01) {
    const bool hidden = i % 6 == 5 && std::fmod(t_s, 10.0) > 5.0;
    const double e_m = kSigma_m * random.gaussian() + (hidden ? 0.6 : 0.0);
    const bool weak = informative ? hidden : random.uniform() < 0.5;
    static_cast<void>(
        gate.weigh(i % 6, 0, t_s, e_m, kVariance_m2, weak ? class_of(-70.0, 1.0) : class_of(-58.0, 1.0)));
  }
}

// A pair is LOS, then NLOS with a small excess: number of ranges until the weight is below 0.5.
int ranges_until_found(bool informative) {
  Gate gate{GateConfig{}};
  Random random(34);
  train(gate, informative, random);
  double t_s = 60.0;
  for (; t_s < 65.0; t_s += 0.05)
    static_cast<void>(gate.weigh(0, 0, t_s, 0.0, kVariance_m2, class_of(-58.0, 1.0)));
  for (int i = 1; i < 200; ++i, t_s += 0.05) {
    if (gate.weigh(0, 0, t_s, 2.0 * kSigma_m, kVariance_m2, class_of(-70.0, 1.0)) < 0.5) return i;
  }
  return 200;
}

TEST(Gate, FindsAnNlosPairSoonerByInformativePowers) {
  EXPECT_EQ(ranges_until_found(true), 1);
  EXPECT_GT(ranges_until_found(false), 3);
}

// A weak antenna is not NLOS.
TEST(Gate, DoesNotLockOutAPairWithMisleadingPowers) {
  Gate gate{GateConfig{}};
  Random random(35);
  train(gate, true, random);
  const model::PowerClass weak = class_of(-70.0, 1.0);
  EXPECT_GT(gate.hint().likelihood_ratio(weak), 5.0);
  double t_s = 60.0;
  for (; t_s < 180.0; t_s += 0.05)
    static_cast<void>(gate.weigh(1, 0, t_s, kSigma_m * random.gaussian(), kVariance_m2, weak));
  EXPECT_LT(gate.hint().likelihood_ratio(weak), 3.0);
  EXPECT_GT(gate.weigh(1, 0, t_s, 0.0, kVariance_m2, weak), 0.6);
}

}  // namespace
}  // namespace groma::filter
