#include "firmware/core/mac/repeated_join.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <vector>

namespace groma::mac {
namespace {

constexpr Join kJoin{.origin = 7};

std::vector<std::uint32_t> turns(RepeatedJoin& join, std::uint32_t from, std::uint32_t until) {
  std::vector<std::uint32_t> taken;
  for (std::uint32_t number = from; number < until; ++number) {
    if (join.turn(number)) taken.push_back(number);
  }
  return taken;
}

TEST(RepeatedJoin, WindowGrowsAfterEachTransmissionUpToABound) {
  for (std::uint16_t id = 1; id < 60; ++id) {
    RepeatedJoin join(id, 0);
    join.want(kJoin, {.first_window_log2 = 0, .last_window_log2 = 3}, 1000);
    const auto taken = turns(join, 1000, 1400);
    ASSERT_GT(taken.size(), 400U / 8U);
    EXPECT_EQ(taken[0], 1000U);
    for (std::size_t i = 1; i < taken.size(); ++i) {
      EXPECT_LE(taken[i] - taken[i - 1], std::uint32_t{1} << std::min<std::size_t>(i, 3)) << id;
    }
  }
}

TEST(RepeatedJoin, StopsWhenSettledOrAfterTheRequestedTimes) {
  RepeatedJoin join(7, 0);
  EXPECT_TRUE(turns(join, 0, 20).empty());
  join.want(kJoin, {.first_window_log2 = 2, .last_window_log2 = 4, .times = 3}, 20);
  EXPECT_EQ(turns(join, 20, 200).size(), 3U);
  EXPECT_FALSE(join.pending());

  join.want(kJoin, {}, 200);
  EXPECT_TRUE(join.turn(200));
  EXPECT_TRUE(join.pending());
  join.settle();
  EXPECT_TRUE(turns(join, 201, 300).empty());
}

TEST(RepeatedJoin, AMissedTransmissionMovesToTheNextSlotAndDoesNotCount) {
  RepeatedJoin join(7, 0);
  join.want(kJoin, {.times = 2}, 0);
  EXPECT_TRUE(join.turn(0));
  join.on_sent(false);
  EXPECT_TRUE(join.turn(1));
  std::uint32_t last = 2;
  while (last < 50 && !join.turn(last)) ++last;
  ASSERT_LT(last, 50U);
  join.on_sent(false);
  EXPECT_TRUE(join.turn(last + 1)) << "also the last one";
  EXPECT_TRUE(turns(join, last + 2, 90).empty());
}

TEST(RepeatedJoin, ATakenJoinIsNotRepeatedUnlessItWasLate) {
  RepeatedJoin join(9, 0);
  EXPECT_FALSE(join.take());
  join.want(kJoin, {.first_window_log2 = 4}, 0);
  ASSERT_TRUE(join.take());
  join.on_sent(false);
  EXPECT_TRUE(join.turn(1));
  join.on_sent(true);
  EXPECT_TRUE(turns(join, 2, 90).empty());
}

TEST(RepeatedJoin, EachOwnTransmissionHasItsNonceAndARelayedOneKeepsIts) {
  RepeatedJoin join(9, 0);
  join.want(kJoin, {.last_window_log2 = 0}, 5);
  const auto first = join.turn(5);
  const auto second = join.turn(6);
  ASSERT_TRUE(first && second);
  EXPECT_NE(std::get<Join>(first->body).nonce, std::get<Join>(second->body).nonce);
  join.settle();
  const Join relayed{.origin = 8, .nonce = 77};
  join.want(relayed, {}, 7);
  const auto third = join.turn(7);
  ASSERT_TRUE(third);
  EXPECT_EQ(std::get<Join>(third->body), relayed);
}

TEST(RepeatedJoin, IsDeterministic) {
  RepeatedJoin a(300, 0);
  RepeatedJoin b(300, 0);
  for (RepeatedJoin* join : {&a, &b}) join->want(kJoin, {.first_window_log2 = 3}, 55);
  EXPECT_EQ(turns(a, 55, 500), turns(b, 55, 500));
}

// Number of open slots until each of `nodes` contenders, all starting in slot `from`, has been alone in a
// slot; 10'000 if that does not happen.
std::uint32_t slots_until_all_succeeded(std::uint16_t nodes, std::uint16_t first_id, std::uint32_t from,
                                        const Repetition& repetition) {
  std::vector<RepeatedJoin> all;
  for (std::uint16_t i = 0; i < nodes; ++i) {
    all.emplace_back(static_cast<std::uint16_t>(first_id + i), 0U);
    all.back().want(kJoin, repetition, from);
  }
  std::size_t succeeded = 0;
  for (std::uint32_t number = from; number < from + 10'000; ++number) {
    RepeatedJoin* only = nullptr;
    int senders = 0;
    for (RepeatedJoin& join : all) {
      if (!join.turn(number)) continue;
      only = &join;
      ++senders;
    }
    if (senders != 1) continue;
    only->settle();
    if (++succeeded == nodes) return number - from + 1;
  }
  return 10'000;
}

TEST(RepeatedJoin, TwoSimultaneousContendersSucceedSoon) {
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

TEST(RepeatedJoin, SixteenContendersSucceed) {
  for (std::uint32_t from = 0; from < 20; ++from) {
    EXPECT_LE(slots_until_all_succeeded(16, 1, 1000 * from, {.last_window_log2 = 6}), 400U) << from;
  }
}

TEST(RepeatedJoin, DrawsAreUniform) {
  // Chi-square over 8 slots of the first window, 8000 draws: 7 degrees of freedom, 24.3 at 0.1 %.
  std::array<int, 8> seen{};
  for (std::uint16_t id = 1; id <= 80; ++id) {
    for (std::uint32_t number = 0; number < 100; ++number) {
      RepeatedJoin join(id, 0);
      join.want(kJoin, {.first_window_log2 = 3, .times = 1}, number);
      const auto taken = turns(join, 0, 8);
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
