#include "firmware/core/mac/open_slot_queue.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <vector>

namespace groma::mac {
namespace {

// A JOIN that shows its purpose by its origin.
Join join_of(Purpose purpose) {
  return {.origin = static_cast<std::uint16_t>(100 + static_cast<int>(purpose))};
}

std::optional<Purpose> purpose_sent(OpenSlotQueue& queue, std::uint32_t number) {
  const auto join = queue.turn(number);
  if (!join) return std::nullopt;
  return static_cast<Purpose>(join->origin - 100);
}

std::vector<std::uint32_t> turns(OpenSlotQueue& queue, std::uint32_t from, std::uint32_t until) {
  std::vector<std::uint32_t> taken;
  for (std::uint32_t number = from; number < until; ++number) {
    if (queue.turn(number)) taken.push_back(number);
  }
  return taken;
}

TEST(OpenSlotQueue, WindowGrowsAfterEachTransmissionUpToABound) {
  for (std::uint16_t id = 1; id < 60; ++id) {
    OpenSlotQueue queue(id);
    queue.want(Purpose::kJoin, join_of(Purpose::kJoin), {.first_window_log2 = 0, .last_window_log2 = 3},
               1000);
    const auto taken = turns(queue, 1000, 1400);
    ASSERT_GT(taken.size(), 400U / 8U);
    EXPECT_EQ(taken[0], 1000U);
    for (std::size_t i = 1; i < taken.size(); ++i) {
      EXPECT_LE(taken[i] - taken[i - 1], std::uint32_t{1} << std::min<std::size_t>(i, 3)) << id;
    }
  }
}

TEST(OpenSlotQueue, StopsWhenSettledOrAfterTheRequestedTimes) {
  OpenSlotQueue queue(7);
  EXPECT_TRUE(turns(queue, 0, 20).empty());
  queue.want(Purpose::kAnnounce, join_of(Purpose::kAnnounce),
             {.first_window_log2 = 2, .last_window_log2 = 4, .times = 3}, 20);
  EXPECT_EQ(turns(queue, 20, 200).size(), 3U);
  EXPECT_FALSE(queue.pending(Purpose::kAnnounce));

  queue.want(Purpose::kJoin, join_of(Purpose::kJoin), {}, 200);
  EXPECT_EQ(purpose_sent(queue, 200), Purpose::kJoin);
  EXPECT_TRUE(queue.pending(Purpose::kJoin));
  queue.settle(Purpose::kJoin);
  EXPECT_TRUE(turns(queue, 201, 300).empty());
}

TEST(OpenSlotQueue, AMissedTransmissionMovesToTheNextSlotAndDoesNotCount) {
  OpenSlotQueue queue(7);
  queue.want(Purpose::kAnnounce, join_of(Purpose::kAnnounce), {.times = 2}, 0);
  EXPECT_EQ(purpose_sent(queue, 0), Purpose::kAnnounce);
  queue.on_sent(false);
  EXPECT_EQ(purpose_sent(queue, 1), Purpose::kAnnounce);
  std::uint32_t last = 2;
  while (last < 50 && !queue.turn(last)) ++last;
  ASSERT_LT(last, 50U);
  queue.on_sent(false);
  EXPECT_EQ(purpose_sent(queue, last + 1), Purpose::kAnnounce) << "also the last one";
  EXPECT_TRUE(turns(queue, last + 2, 90).empty());
}

TEST(OpenSlotQueue, SendsThePurposesInOrderAndForgetsNone) {
  OpenSlotQueue queue(9);
  queue.want(Purpose::kAnnounce, join_of(Purpose::kAnnounce), {.times = 1}, 0);
  queue.want(Purpose::kLeave, join_of(Purpose::kLeave), {.times = 1}, 0);
  EXPECT_EQ(purpose_sent(queue, 0), Purpose::kLeave);
  EXPECT_EQ(purpose_sent(queue, 1), Purpose::kAnnounce);
  EXPECT_EQ(queue.turn(2), std::nullopt);
}

TEST(OpenSlotQueue, ATakenJoinIsNotRepeatedUnlessItWasLate) {
  OpenSlotQueue queue(9);
  EXPECT_FALSE(queue.take(Purpose::kPassOn));
  queue.want(Purpose::kPassOn, join_of(Purpose::kPassOn), {.first_window_log2 = 4}, 0);
  ASSERT_TRUE(queue.take(Purpose::kPassOn));
  queue.on_sent(false);
  EXPECT_EQ(purpose_sent(queue, 1), Purpose::kPassOn);
  queue.on_sent(true);
  EXPECT_TRUE(turns(queue, 2, 90).empty());
}

TEST(OpenSlotQueue, EachOwnTransmissionHasItsNonceAndARelayedOneKeepsIts) {
  OpenSlotQueue queue(9);
  queue.want(Purpose::kJoin, join_of(Purpose::kJoin), {.last_window_log2 = 0}, 5);
  const auto first = queue.turn(5);
  const auto second = queue.turn(6);
  ASSERT_TRUE(first && second);
  EXPECT_NE(first->nonce, second->nonce);
  queue.settle(Purpose::kJoin);
  Join relayed = join_of(Purpose::kPassOn);
  relayed.nonce = 77;
  queue.want(Purpose::kPassOn, relayed, {}, 7);
  EXPECT_EQ(queue.turn(7), relayed);
}

TEST(OpenSlotQueue, IsDeterministic) {
  OpenSlotQueue a(300);
  OpenSlotQueue b(300);
  for (OpenSlotQueue* queue : {&a, &b})
    queue->want(Purpose::kJoin, join_of(Purpose::kJoin), {.first_window_log2 = 3}, 55);
  EXPECT_EQ(turns(a, 55, 500), turns(b, 55, 500));
}

// Number of open slots until each of `nodes` contenders, all starting in slot `from`, has been alone in a
// slot; 10'000 if that does not happen.
std::uint32_t slots_until_all_succeeded(std::uint16_t nodes, std::uint16_t first_id, std::uint32_t from,
                                        const Repetition& repetition) {
  std::vector<OpenSlotQueue> all;
  for (std::uint16_t i = 0; i < nodes; ++i) {
    all.emplace_back(static_cast<std::uint16_t>(first_id + i));
    all.back().want(Purpose::kJoin, join_of(Purpose::kJoin), repetition, from);
  }
  std::size_t succeeded = 0;
  for (std::uint32_t number = from; number < from + 10'000; ++number) {
    OpenSlotQueue* only = nullptr;
    int senders = 0;
    for (OpenSlotQueue& queue : all) {
      if (!queue.turn(number)) continue;
      only = &queue;
      ++senders;
    }
    if (senders != 1) continue;
    only->settle(Purpose::kJoin);
    if (++succeeded == nodes) return number - from + 1;
  }
  return 10'000;
}

TEST(OpenSlotQueue, TwoSimultaneousContendersSucceedSoon) {
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

TEST(OpenSlotQueue, SixteenContendersSucceed) {
  for (std::uint32_t from = 0; from < 20; ++from) {
    EXPECT_LE(slots_until_all_succeeded(16, 1, 1000 * from, {.last_window_log2 = 6}), 400U) << from;
  }
}

TEST(OpenSlotQueue, DrawsAreUniform) {
  // Chi-square over 8 slots of the first window, 8000 draws: 7 degrees of freedom, 24.3 at 0.1 %.
  std::array<int, 8> seen{};
  for (std::uint16_t id = 1; id <= 80; ++id) {
    for (std::uint32_t number = 0; number < 100; ++number) {
      OpenSlotQueue queue(id);
      queue.want(Purpose::kAnnounce, join_of(Purpose::kAnnounce), {.first_window_log2 = 3, .times = 1},
                 number);
      const auto taken = turns(queue, 0, 8);
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
