#include "firmware/core/mac/access.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <vector>

namespace groma::mac {
namespace {

std::vector<std::uint32_t> turns(Access& access, std::uint32_t from, std::uint32_t until) {
  std::vector<std::uint32_t> taken;
  for (std::uint32_t number = from; number < until; ++number) {
    if (access.turn(number)) taken.push_back(number);
  }
  return taken;
}

TEST(Access, WindowGrowsAfterEachTransmissionUpToABound) {
  for (std::uint16_t id = 1; id < 60; ++id) {
    Access access(id);
    access.want(Purpose::kJoin, {.first_window_log2 = 0, .last_window_log2 = 3}, 1000);
    const auto taken = turns(access, 1000, 1400);
    ASSERT_GT(taken.size(), 400U / 8U);
    EXPECT_EQ(taken[0], 1000U);
    for (std::size_t i = 1; i < taken.size(); ++i) {
      EXPECT_LE(taken[i] - taken[i - 1], std::uint32_t{1} << std::min<std::size_t>(i, 3)) << id;
    }
  }
}

TEST(Access, StopsWhenSettledOrAfterTheRequestedTimes) {
  Access access(7);
  EXPECT_TRUE(turns(access, 0, 20).empty());
  access.want(Purpose::kAnnounce, {.first_window_log2 = 2, .last_window_log2 = 4, .times = 3}, 20);
  EXPECT_EQ(turns(access, 20, 200).size(), 3U);
  EXPECT_FALSE(access.pending(Purpose::kAnnounce));

  access.want(Purpose::kJoin, {}, 200);
  EXPECT_EQ(access.turn(200), Purpose::kJoin);
  EXPECT_TRUE(access.pending(Purpose::kJoin));
  access.settle(Purpose::kJoin);
  EXPECT_TRUE(turns(access, 201, 300).empty());
}

TEST(Access, AMissedTransmissionMovesToTheNextSlotAndDoesNotCount) {
  Access access(7);
  access.want(Purpose::kAnnounce, {.times = 2}, 0);
  EXPECT_EQ(access.turn(0), Purpose::kAnnounce);
  access.missed(Purpose::kAnnounce);
  EXPECT_EQ(access.turn(1), Purpose::kAnnounce);
  const auto rest = turns(access, 2, 50);
  ASSERT_EQ(rest.size(), 1U);
  access.missed(Purpose::kAnnounce);
  EXPECT_EQ(access.turn(50), Purpose::kAnnounce) << "also the last one";
  EXPECT_TRUE(turns(access, 51, 90).empty());
}

TEST(Access, SendsThePurposesInOrderAndForgetsNone) {
  Access access(9);
  access.want(Purpose::kAnnounce, {.times = 1}, 0);
  access.want(Purpose::kLeave, {.times = 1}, 0);
  EXPECT_EQ(access.turn(0), Purpose::kLeave);
  EXPECT_EQ(access.turn(1), Purpose::kAnnounce);
  EXPECT_EQ(access.turn(2), std::nullopt);
}

TEST(Access, IsDeterministic) {
  Access a(300);
  Access b(300);
  for (Access* access : {&a, &b}) access->want(Purpose::kJoin, {.first_window_log2 = 3}, 55);
  EXPECT_EQ(turns(a, 55, 500), turns(b, 55, 500));
}

// Number of open slots until each of `nodes` contenders, all starting in slot `from`, has been alone in a
// slot; 10'000 if that does not happen.
std::uint32_t slots_until_all_succeeded(std::uint16_t nodes, std::uint16_t first_id, std::uint32_t from,
                                        const Persistence& persistence) {
  std::vector<Access> all;
  for (std::uint16_t i = 0; i < nodes; ++i) {
    all.emplace_back(static_cast<std::uint16_t>(first_id + i));
    all.back().want(Purpose::kJoin, persistence, from);
  }
  std::size_t succeeded = 0;
  for (std::uint32_t number = from; number < from + 10'000; ++number) {
    Access* only = nullptr;
    int senders = 0;
    for (Access& access : all) {
      if (!access.turn(number)) continue;
      only = &access;
      ++senders;
    }
    if (senders != 1) continue;
    only->settle(Purpose::kJoin);
    if (++succeeded == nodes) return number - from + 1;
  }
  return 10'000;
}

TEST(Access, TwoSimultaneousContendersSucceedSoon) {
  // After the first collision both draw from 2 slots, then 4, 8, ... With the probabilities 1/2, 3/4, 7/8 of
  // being alone, the expected duration is about 5 slots.
  std::vector<std::uint32_t> slots;
  for (std::uint16_t id = 1; id <= 100; ++id) {
    for (std::uint32_t from = 0; from < 10; ++from) {
      slots.push_back(slots_until_all_succeeded(2, id, 77 * from, {}));
    }
  }
  std::sort(slots.begin(), slots.end());
  EXPECT_LE(slots[slots.size() / 2], 5U);
  EXPECT_LE(slots[slots.size() * 95 / 100], 14U);
  EXPECT_LE(slots.back(), 60U);
}

TEST(Access, SixteenContendersSucceed) {
  for (std::uint32_t from = 0; from < 20; ++from) {
    EXPECT_LE(slots_until_all_succeeded(16, 1, 1000 * from, {.last_window_log2 = 6}), 400U) << from;
  }
}

TEST(Access, DrawsAreUniform) {
  // Chi-square over 8 slots of the first window, 8000 draws: 7 degrees of freedom, 24.3 at 0.1 %.
  std::array<int, 8> seen{};
  for (std::uint16_t id = 1; id <= 80; ++id) {
    for (std::uint32_t number = 0; number < 100; ++number) {
      Access access(id);
      access.want(Purpose::kAnnounce, {.first_window_log2 = 3, .times = 1}, number);
      const auto taken = turns(access, 0, 8);
      ASSERT_EQ(taken.size(), 1U);
      ++seen[taken[0]];
    }
  }
  double chi2 = 0.0;
  for (const int n : seen) chi2 += (n - 1000.0) * (n - 1000.0) / 1000.0;
  EXPECT_LT(chi2, 24.3);
}

}  // namespace
}  // namespace groma::mac
