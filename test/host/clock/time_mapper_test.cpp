#include "host/clock/time_mapper.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace groma::clock {
namespace {

// SplitMix64 with own distributions: the same numbers on each platform.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  double uniform() {
    std::uint64_t z = (state_ += 0x9E3779B97F4A7C15U);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9U;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBU;
    return static_cast<double>((z ^ (z >> 31)) >> 11) * 0x1p-53;
  }
  double exponential(double mean) { return -mean * std::log1p(-uniform()); }

 private:
  std::uint64_t state_;
};

// A node that sends 20 messages a second over a link with jitter. The host's clock gives the true time.
struct Node {
  double skew = 0.0;
  double start_s = 1000.0;          // host time at which the counter was zero
  double host_offset_s = 0.0;       // step of the host's clock
  double jitter_s = 0.005;          // mean
  double burst_probability = 0.02;  // a burst delays all messages until it ends
  double burst_s = 0.1;
  double burst_end_s = 0.0;

  [[nodiscard]] std::int64_t ticks(double true_s) const {
    return std::llround((true_s - start_s) * (1.0 + skew) * kDeviceTicksPerSecond);
  }
  double arrival(double true_s, Random& random) {
    if (random.uniform() < burst_probability) burst_end_s = true_s + random.uniform() * burst_s;
    const double jittered_s = true_s + random.exponential(jitter_s);
    return std::max(jittered_s, burst_end_s) + host_offset_s;
  }
};

constexpr double kPeriod_s = 0.05;

// Runs the node from `from_s` to `to_s`; calls `each(true_s, instant)` with the host time of each message.
template <typename Each>
void run(TimeMapper& mapper, Node& node, Random& random, double from_s, double to_s, Each each) {
  for (double t_s = from_s; t_s < to_s; t_s += kPeriod_s) {
    mapper.observe(node.ticks(t_s), node.arrival(t_s, random), 0.0);
    each(t_s, *mapper.to_host(node.ticks(t_s)));
  }
}

double quantile(std::vector<double> values, double q) {
  std::sort(values.begin(), values.end());
  return values[static_cast<std::size_t>(q * static_cast<double>(values.size() - 1))];
}

TEST(TimeMapper, GivesNoTimeBeforeTheFirstMessage) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  EXPECT_FALSE(mapper.to_host(0));
  EXPECT_FALSE(mapper.to_ticks(0.0));
}

TEST(TimeMapper, IsExactWithoutJitterAndSubtractsTheTransmission) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.skew = 20e-6};
  for (int i = 0; i < 400; ++i) {
    const double t_s = 1003.0 + kPeriod_s * i;
    const double transmission_s = 1e-3 * (1 + i % 7);
    mapper.observe(node.ticks(t_s), t_s + transmission_s, transmission_s);
  }
  const double t_s = 1003.0 + kPeriod_s * 399;
  EXPECT_NEAR(mapper.skew(), 20e-6, 1e-10);
  EXPECT_NEAR(mapper.to_host(node.ticks(t_s))->t_s, t_s, 1e-8);
  EXPECT_NEAR(mapper.to_host(node.ticks(t_s - 0.1))->t_s, t_s - 0.1, 1e-8);
  EXPECT_LT(mapper.to_host(node.ticks(t_s))->sigma_s, 1e-3);
}

// 300 nodes with crystals up to 50 ppm off either way: the errors after 1, 10 and 60 s, and whether the
// stated sigmas hold.
TEST(TimeMapper, ConvergesUnderJitterAndBursts) {
  std::vector<double> after_1s;
  std::vector<double> after_10s;
  std::vector<double> after_60s;
  int beyond_3_sigma = 0;
  int total = 0;
  for (std::uint64_t seed = 0; seed < 300; ++seed) {
    Random random(seed);
    TimeMapper mapper(kDeviceTicksPerSecond);
    Node node{.skew = (2.0 * random.uniform() - 1.0) * 50e-6};
    run(mapper, node, random, 1001.0, 1061.05, [&](double t_s, const HostInstant& instant) {
      const double error_s = instant.t_s - t_s;
      ++total;
      if (std::abs(error_s) > 3.0 * instant.sigma_s) ++beyond_3_sigma;
      if (std::abs(t_s - 1002.0) < kPeriod_s / 2) after_1s.push_back(std::abs(error_s));
      if (std::abs(t_s - 1011.0) < kPeriod_s / 2) after_10s.push_back(std::abs(error_s));
      if (std::abs(t_s - 1061.0) < kPeriod_s / 2) after_60s.push_back(std::abs(error_s));
    });
    EXPECT_EQ(mapper.counters().host_jumps, 0U) << seed;
    EXPECT_EQ(mapper.counters().counter_restarts, 0U);
    EXPECT_NEAR(mapper.skew(), node.skew, 25e-6) << seed;
  }
  ASSERT_EQ(after_1s.size(), 300U);
  ASSERT_EQ(after_60s.size(), 300U);
  RecordProperty("after_1s_q95_us", static_cast<int>(1e6 * quantile(after_1s, 0.95)));
  RecordProperty("after_10s_q95_us", static_cast<int>(1e6 * quantile(after_10s, 0.95)));
  RecordProperty("after_60s_q95_us", static_cast<int>(1e6 * quantile(after_60s, 0.95)));
  EXPECT_LT(quantile(after_1s, 0.95), 2e-3);
  EXPECT_LT(quantile(after_1s, 1.0), 5e-3);
  EXPECT_LT(quantile(after_10s, 0.95), 5e-4);
  EXPECT_LT(quantile(after_60s, 0.95), 2e-4);
  EXPECT_LT(static_cast<double>(beyond_3_sigma), 0.003 * total);
}

TEST(TimeMapper, EstimatesASkewOfTwentyPpmInASingleRun) {
  Random random(42);
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.skew = 20e-6};
  double worst_s = 0.0;
  run(mapper, node, random, 1001.0, 1200.0, [&](double t_s, const HostInstant& instant) {
    if (t_s > 1031.0) worst_s = std::max(worst_s, std::abs(instant.t_s - t_s));
  });
  EXPECT_LT(worst_s, 5e-4);
  EXPECT_NEAR(mapper.skew(), 20e-6, 20e-6);
}

TEST(TimeMapper, FollowsACrystalThatWarmsUp) {
  Random random(43);
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.jitter_s = 0.001, .burst_probability = 0.0};
  double ticks = 0.0;
  double worst_s = 0.0;
  for (double t_s = 1000.0; t_s < 1120.0; t_s += kPeriod_s) {
    const double skew = 20e-6 * std::sin((t_s - 1000.0) / 40.0);  // up to 0.5 ppm a second
    ticks += kPeriod_s * (1.0 + skew) * kDeviceTicksPerSecond;
    mapper.observe(std::llround(ticks), node.arrival(t_s, random), 0.0);
    if (t_s > 1010.0) worst_s = std::max(worst_s, std::abs(mapper.to_host(std::llround(ticks))->t_s - t_s));
  }
  EXPECT_LT(worst_s, 5e-4);
}

TEST(TimeMapper, NeverRunsBackByMoreThanItStates) {
  for (std::uint64_t seed = 0; seed < 50; ++seed) {
    Random random(1000 + seed);
    TimeMapper mapper(kDeviceTicksPerSecond);
    Node node{.skew = -35e-6, .jitter_s = 0.02, .burst_probability = 0.05};
    HostInstant last{-1e9, 0.0};
    std::uint32_t epoch = 0;
    for (double t_s = 1001.0; t_s < 1021.0; t_s += kPeriod_s) {
      mapper.observe(node.ticks(t_s), node.arrival(t_s, random), 0.0);
      const HostInstant instant = *mapper.to_host(node.ticks(t_s));
      if (mapper.epoch() == epoch) {
        ASSERT_GE(instant.t_s, last.t_s - last.sigma_s - 1e-9) << seed;
      }
      epoch = mapper.epoch();
      last = instant;
    }
  }
}

TEST(TimeMapper, RestartsWhenTheCounterRestarts) {
  Random random(7);
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.skew = 20e-6};
  run(mapper, node, random, 1001.0, 1020.0, [](double, const HostInstant&) {});
  node.start_s = 1021.0;
  const std::uint32_t epoch = mapper.epoch();
  run(mapper, node, random, 1021.5, 1031.5, [&](double t_s, const HostInstant& instant) {
    EXPECT_NEAR(instant.t_s, t_s, 0.1 + node.burst_s);
    if (t_s > 1023.0) {
      EXPECT_NEAR(instant.t_s, t_s, 5e-3);
    }
  });
  EXPECT_EQ(mapper.counters().counter_restarts, 1U);
  EXPECT_EQ(mapper.counters().host_jumps, 0U);
  EXPECT_EQ(mapper.epoch(), epoch + 1);
}

TEST(TimeMapper, FindsASetClockAndFollowsIt) {
  for (const double jump_s : {-100.0, -0.3, 0.3, 5.0, 3600.0}) {
    Random random(8);
    TimeMapper mapper(kDeviceTicksPerSecond);
    Node node{.skew = 20e-6};
    run(mapper, node, random, 1001.0, 1020.0, [](double, const HostInstant&) {});
    node.host_offset_s = jump_s;
    run(mapper, node, random, 1020.0, 1040.0, [&](double t_s, const HostInstant& instant) {
      if (t_s > 1023.0) {
        EXPECT_NEAR(instant.t_s, t_s + jump_s, 5e-3) << jump_s;
      }
    });
    EXPECT_EQ(mapper.counters().host_jumps, 1U) << jump_s;
    EXPECT_EQ(mapper.counters().counter_restarts, 0U);
  }
}

TEST(TimeMapper, IgnoresASingleEarlyMessage) {
  for (const double early_s : {0.05, 0.3, 0.95, 10.0, 100.0}) {
    Random random(12);
    TimeMapper mapper(kDeviceTicksPerSecond);
    Node node{.skew = 20e-6};
    run(mapper, node, random, 1001.0, 1010.0, [](double, const HostInstant&) {});
    const std::uint32_t epoch = mapper.epoch();
    for (double t_s = 1010.0; t_s < 1030.0; t_s += kPeriod_s) {
      const bool early_too = std::fmod(t_s, 5.0) < kPeriod_s;
      if (early_too) {
        EXPECT_EQ(mapper.observe(node.ticks(t_s + early_s), t_s, 0.0), Observation::kEarly) << early_s;
      }
      EXPECT_EQ(mapper.observe(node.ticks(t_s), node.arrival(t_s, random), 0.0), Observation::kTaken);
      EXPECT_NEAR(mapper.to_host(node.ticks(t_s))->t_s, t_s, 2e-3) << early_s;
    }
    EXPECT_EQ(mapper.epoch(), epoch);
    EXPECT_EQ(mapper.counters().counter_restarts, 0U);
    EXPECT_EQ(mapper.counters().host_jumps, 0U);
    EXPECT_GE(mapper.counters().early, 4U);
  }
}

TEST(TimeMapper, RestartsOnceEnoughEarlyMessagesAgree) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  const Node node{};
  double t_s = 1001.0;
  for (; t_s < 1010.0; t_s += kPeriod_s) mapper.observe(node.ticks(t_s), t_s, 0.0);
  // Early messages that do not agree.
  for (int i = 0; i < 20; ++i, t_s += kPeriod_s) {
    EXPECT_EQ(mapper.observe(node.ticks(t_s + 0.1 + 0.02 * i), t_s, 0.0), Observation::kEarly);
  }
  EXPECT_EQ(mapper.observe(node.ticks(t_s), t_s, 0.0), Observation::kTaken);
  for (std::uint32_t i = 1; i < TimeMapper::kJumpMessages; ++i, t_s += kPeriod_s) {
    EXPECT_EQ(mapper.observe(node.ticks(t_s + 0.3), t_s, 0.0), Observation::kEarly);
  }
  EXPECT_EQ(mapper.observe(node.ticks(t_s + 0.3), t_s, 0.0), Observation::kRestarted);
  EXPECT_NEAR(mapper.to_host(node.ticks(t_s + 0.3))->t_s, t_s, 1e-6);
}

TEST(TimeMapper, ALateFirstMessageDoesNotBlockTheNext) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  const Node node{};
  mapper.observe(node.ticks(1001.0), 1003.0, 0.0);
  EXPECT_EQ(mapper.observe(node.ticks(1003.0), 1003.0, 0.0), Observation::kRestarted);
  EXPECT_NEAR(mapper.to_host(node.ticks(1003.0))->t_s, 1003.0, 1e-6);
}

TEST(TimeMapper, AStalledReaderIsNotAJump) {
  Random random(9);
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.skew = 20e-6};
  run(mapper, node, random, 1001.0, 1020.0, [](double, const HostInstant&) {});
  // Five seconds of messages are read at once.
  for (double t_s = 1020.0; t_s < 1025.0; t_s += kPeriod_s) {
    mapper.observe(node.ticks(t_s), 1025.0, 0.0);
    EXPECT_NEAR(mapper.to_host(node.ticks(t_s))->t_s, t_s, 1e-3);
  }
  run(mapper, node, random, 1025.0, 1030.0,
      [](double t_s, const HostInstant& instant) { EXPECT_NEAR(instant.t_s, t_s, 1e-3); });
  EXPECT_EQ(mapper.counters().host_jumps, 0U);
}

TEST(TimeMapper, StatesMoreUncertaintyBeyondItsWindow) {
  Random random(10);
  TimeMapper mapper(kDeviceTicksPerSecond);
  Node node{.skew = 45e-6};
  run(mapper, node, random, 1001.0, 1003.0, [](double, const HostInstant&) {});
  for (const double ahead_s : {1.0, 10.0, 100.0}) {
    const double t_s = 1003.0 + ahead_s;
    const HostInstant instant = *mapper.to_host(node.ticks(t_s));
    EXPECT_LT(std::abs(instant.t_s - t_s), 3.0 * instant.sigma_s) << ahead_s;
    EXPECT_GT(instant.sigma_s, 20e-6 * ahead_s);
  }
}

TEST(TimeMapper, ToTicksInvertsToHost) {
  Random random(11);
  TimeMapper mapper(1e9);
  for (int i = 0; i < 500; ++i) {
    const double t_s = 1.7e9 + 0.02 * i;
    mapper.observe(std::llround(t_s * 1e6) * 1000,
                   50.0 + 0.02 * i * (1.0 + 30e-6) + random.exponential(0.002), 0.0);
  }
  for (const double host_s : {50.0, 55.5, 60.0, 61.0}) {
    const auto ticks = mapper.to_ticks(host_s);
    ASSERT_TRUE(ticks);
    EXPECT_NEAR(mapper.to_host(*ticks)->t_s, host_s, 1e-8);
  }
  EXPECT_NEAR(static_cast<double>(*mapper.to_ticks(60.0)) * 1e-9, 1.7e9 + 10.0, 1e-3);
}

TEST(TimeMapper, ResetDiscardsTheFit) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  mapper.observe(1000, 5.0, 0.0);
  mapper.reset();
  EXPECT_FALSE(mapper.to_host(1000));
  mapper.observe(10, 6.0, 0.0);
  EXPECT_EQ(mapper.counters().counter_restarts, 0U);
  EXPECT_DOUBLE_EQ(mapper.to_host(10)->t_s, 6.0);
}

// ---- requests: the delay common to all messages ---------------------------------------------------

// A link with a constant delay and jitter in each direction.
struct Link {
  double to_host_s = 0.0;
  double to_node_s = 0.0;
  double jitter_s = 0.001;
};

// Twenty messages a second and one request a second, for 30 s.
struct Outcome {
  double error_s = 0.0;  // of the last message's host time
  double sigma_s = 0.0;
  double round_trip_s = 0.0;
  double counter_error_s = 0.0;  // of the inverse
};
Outcome over(const Link& link, std::uint64_t seed, bool with_requests = true) {
  Random random(seed);
  TimeMapper mapper(kDeviceTicksPerSecond);
  const Node node{.skew = 17e-6};
  Outcome out;
  for (int i = 0; i < 600; ++i) {
    const double t_s = 1003.0 + kPeriod_s * i;
    mapper.observe(node.ticks(t_s), t_s + link.to_host_s + random.exponential(link.jitter_s), 0.0);
    if (with_requests && i % 20 == 7) {
      const double asked_s = t_s + 0.01;
      mapper.observe_request(node.ticks(asked_s + link.to_node_s + random.exponential(link.jitter_s)),
                             asked_s);
    }
    const HostInstant instant = *mapper.to_host(node.ticks(t_s));
    out.error_s = instant.t_s - t_s;
    out.sigma_s = instant.sigma_s;
    out.counter_error_s =
        static_cast<double>(*mapper.to_ticks(t_s) - node.ticks(t_s)) / kDeviceTicksPerSecond;
  }
  out.round_trip_s = mapper.round_trip_s().value_or(-1.0);
  return out;
}

TEST(TimeMapper, TheCommonDelayRemainsWithoutRequests) {
  const Outcome out = over({.to_host_s = 0.004, .to_node_s = 0.004}, 1, false);
  EXPECT_NEAR(out.error_s, 0.004, 2e-4);
  EXPECT_EQ(out.round_trip_s, -1.0);
}

TEST(TimeMapper, RequestsRemoveASymmetricDelay) {
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    const Outcome out = over({.to_host_s = 0.004, .to_node_s = 0.004}, seed);
    EXPECT_NEAR(out.round_trip_s, 0.008, 3e-4) << seed;
    EXPECT_NEAR(out.error_s, 0.0, 2e-4) << seed;
    EXPECT_NEAR(out.counter_error_s, 0.0, 2e-4) << seed;
    EXPECT_NEAR(out.sigma_s, 0.004 / std::sqrt(3.0), 2e-4) << seed;
  }
}

// Half of the difference between the two delays is not observable.
TEST(TimeMapper, HalfTheDifferenceOfAnAsymmetricDelayRemains) {
  for (const Link& link : {Link{0.006, 0.002}, Link{0.001, 0.009}, Link{0.010, 0.0}, Link{0.0, 0.010}}) {
    const Outcome out = over(link, 5);
    EXPECT_NEAR(out.round_trip_s, link.to_host_s + link.to_node_s, 4e-4);
    EXPECT_NEAR(out.error_s, 0.5 * (link.to_host_s - link.to_node_s), 3e-4);
    EXPECT_LE(std::abs(out.error_s), 0.5 * out.round_trip_s + 3e-4);
    EXPECT_LE(std::abs(out.error_s), 2.0 * out.sigma_s);
  }
}

TEST(TimeMapper, ARestartDiscardsRequests) {
  TimeMapper mapper(kDeviceTicksPerSecond);
  mapper.observe_request(5'000, 1.0);
  EXPECT_FALSE(mapper.round_trip_s());
  mapper.observe(100'000'000, 1.0, 0.0);
  mapper.observe_request(100'000'000, 0.99);
  ASSERT_TRUE(mapper.round_trip_s());
  EXPECT_NEAR(*mapper.round_trip_s(), 0.01, 1e-9);
  mapper.observe(1'000, 1.1, 0.0);
  EXPECT_FALSE(mapper.round_trip_s());
}

}  // namespace
}  // namespace groma::clock
