#include "firmware/core/mac/superframe.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <string_view>
#include <vector>

#include "firmware/core/dw1000/driver.hpp"
#include "test/firmware/air.hpp"

namespace groma::mac {
namespace {

using dw1000::phy_of;
using radio::Phy;
using radio::Preamble;
using ranging::Ticks;
using testing::schedule_of;

double us(Ticks t) {
  return static_cast<double>(t.count()) / 63'897.6;
}

TEST(AirTime, MatchesTheReferenceTable) {
  const std::size_t bytes[] = {12, 20, 32, 64, 100, 127};
  const int expected_us[3][6] = {
      {113, 122, 134, 173, 216, 250}, {178, 187, 199, 238, 281, 315}, {309, 317, 329, 368, 411, 445}};
  const Preamble preambles[] = {Preamble::k64, Preamble::k128, Preamble::k256};
  for (std::size_t p = 0; p < 3; ++p) {
    for (std::size_t n = 0; n < 6; ++n) {
      EXPECT_NEAR(us(phy_of(preambles[p]).air_time(bytes[n])), expected_us[p][n], 0.6)
          << dw1000::preamble_symbols(preambles[p]) << " symbols, " << bytes[n] << " bytes";
    }
  }
}

TEST(AirTime, AgreesWithTheFormulaForEveryLength) {
  for (std::size_t n = 0; n <= radio::kMaxFrameBytes; ++n) {
    const double bits = 8.0 * static_cast<double>(n);
    const double formula_us =
        (128 + 8) * 1.01763 + 21 * 1.02564 + (bits + 48.0 * std::ceil(bits / 330.0)) * 0.128205;
    EXPECT_NEAR(us(phy_of(Preamble::k128).air_time(n)), formula_us, 0.01) << n;
  }
}

struct Span {
  Ticks from;
  Ticks to;
};

// Each frame of a superframe as it is on the air, in order.
std::vector<Span> frames_of(const groma_Schedule& schedule, const Superframe& superframe) {
  const Phy phy = superframe.phy();
  const std::size_t anchors = schedule.anchor_ids_count;
  std::vector<Span> spans;
  const auto add = [&](Ticks rmarker, std::size_t bytes) {
    spans.push_back({rmarker - phy.before_rmarker(), rmarker + phy.after_rmarker(bytes)});
  };
  add(superframe.beacon(), superframe.control_bytes());
  add(superframe.shared(), superframe.control_bytes());
  for (std::size_t slot = 0; slot < schedule.tag_ids_count; ++slot) {
    const Ticks poll = superframe.poll(slot);
    add(poll, poll_bytes(anchors));
    for (std::size_t i = 0; i < anchors; ++i) add(poll + superframe.response(i, anchors), kResponseBytes);
    if (superframe.has_final()) add(poll + superframe.final(anchors), kFinalBytes);
  }
  return spans;
}

TEST(Superframe, NoFrameOverlapsAnotherAndEachGapIsKept) {
  for (const auto method : {groma_RangingMethod_METHOD_DS_FINAL, groma_RangingMethod_METHOD_DS_NEXT_POLL}) {
    for (const Phy& phy : {phy_of(Preamble::k64), phy_of(Preamble::k128), phy_of(Preamble::k256),
                           testing::other_phy_of(Preamble::k128)}) {
      for (const std::size_t tags : {1U, 3U, 16U}) {
        for (const std::size_t anchors : {1U, 4U, 12U, 16U}) {
          for (const std::uint32_t gap_us : {50U, 290U, 2000U}) {
            const groma_Schedule schedule = schedule_of(tags, anchors, method, 300, gap_us);
            ASSERT_STREQ(fault_of(schedule), "");
            const Superframe superframe(schedule, phy);
            const auto spans = frames_of(schedule, superframe);
            const Ticks guard = superframe.guard();
            EXPECT_GE(spans.front().from, guard);
            const Ticks least = std::min(Ticks::from_us(gap_us), Ticks::from_us(300));
            for (std::size_t i = 1; i < spans.size(); ++i) {
              ASSERT_GE(spans[i].from - spans[i - 1].to, least) << i;
            }
            ASSERT_GE(superframe.duration() + spans.front().from - spans.back().to, least + guard);
          }
        }
      }
    }
  }
}

// A node that relays a beacon, or polls after a relay, must first process a beacon.
TEST(Superframe, LeavesTimeToProcessABeacon) {
  for (const bool secured : {false, true}) {
    for (const std::uint32_t gap_us : {50U, 160U, 700U}) {
      const groma_Schedule schedule =
          schedule_of(3, 12, groma_RangingMethod_METHOD_DS_NEXT_POLL, 300, gap_us);
      const Superframe superframe(schedule, phy_of(Preamble::k128), secured);
      const Ticks frame = superframe.phy().air_time(superframe.control_bytes());
      const double before_relay_us =
          us(superframe.shared() - superframe.beacon() - frame - superframe.guard());
      // In a keyed network a message's MIC is computed after the beacon's has been verified.
      EXPECT_NEAR(before_relay_us, std::max<std::uint32_t>(gap_us, 300) + (secured ? 400.0 : 100.0), 0.1);
      const double before_poll_us = us(superframe.poll(0) - superframe.shared() - frame - superframe.guard());
      EXPECT_NEAR(before_poll_us, secured ? 700.0 : 400.0, 0.1);
    }
  }
}

// After a FINAL an anchor must be ready for the next POLL, and the master must prepare its beacon.
TEST(Superframe, LeavesTheTurnaroundAfterAFinal) {
  for (const bool secured : {false, true}) {
    for (const std::uint32_t gap_us : {50U, 120U, 150U, 200U, 250U, 300U, 700U}) {
      const groma_Schedule schedule = schedule_of(3, 12, groma_RangingMethod_METHOD_DS_FINAL, 300, gap_us);
      const Superframe superframe(schedule, phy_of(Preamble::k128), secured);
      const auto silence_us = [&](std::size_t slot, Ticks next) {
        const Ticks end = superframe.poll(slot) + superframe.final(12) +
                          superframe.phy().after_rmarker(superframe.on_air(kFinalBytes));
        return us(next - superframe.phy().before_rmarker() - end - superframe.guard());
      };
      EXPECT_NEAR(silence_us(0, superframe.poll(1)), std::max<std::uint32_t>(gap_us, 300U), 0.05) << gap_us;
      const double mic_us = secured ? 300.0 : 0.0;
      EXPECT_NEAR(silence_us(2, superframe.duration() + superframe.beacon()),
                  std::max<std::uint32_t>(gap_us, 300U) + mic_us, 0.05)
          << gap_us;
    }
  }
}

TEST(Superframe, EveryTransmissionLiesOnTheGrid) {
  for (const std::uint32_t odd_us : {151U, 299U, 653U}) {
    groma_Schedule schedule = schedule_of(3, 12, groma_RangingMethod_METHOD_DS_FINAL, odd_us, odd_us);
    schedule.guard_us = 17;
    const Superframe superframe(schedule, phy_of(Preamble::k128));
    EXPECT_EQ(superframe.duration().count() % 512, 0);
    EXPECT_EQ(superframe.beacon().count() % 512, 0);
    EXPECT_EQ(superframe.poll(2).count() % 512, 0);
    EXPECT_EQ(superframe.final(12).count() % 512, 0);
    for (std::size_t i = 0; i < 12; ++i) EXPECT_EQ(superframe.response(i, 12).count() % 512, 0);
  }
}

TEST(Superframe, ThreeTagsAndTwelveAnchorsGetWellOverAThousandRangesASecond) {
  const auto rate = [](groma_RangingMethod method, std::uint32_t turnaround_us, std::uint32_t gap_us) {
    const Superframe superframe(schedule_of(3, 12, method, turnaround_us, gap_us), phy_of(Preamble::k128));
    return 36.0 / (us(superframe.duration()) * 1e-6);
  };
  EXPECT_GT(rate(groma_RangingMethod_METHOD_DS_NEXT_POLL, 650, 290), 1550.0);
  EXPECT_GT(rate(groma_RangingMethod_METHOD_DS_FINAL, 650, 290), 1350.0);
  EXPECT_GT(rate(groma_RangingMethod_METHOD_DS_NEXT_POLL, 300, 100), 2500.0);
  // The air time limits the rate.
  EXPECT_LT(rate(groma_RangingMethod_METHOD_DS_NEXT_POLL, 650, 290), 1900.0);
}

TEST(Superframe, ReplyIntervalsFitTheirFieldAndWindowsTheReceiversTimeout) {
  groma_Schedule schedule = schedule_of(16, 16, groma_RangingMethod_METHOD_DS_FINAL, 5000, 2000);
  schedule.guard_us = 1000;
  ASSERT_STREQ(fault_of(schedule), "");
  const Superframe superframe(schedule, phy_of(Preamble::k256));
  EXPECT_LT(superframe.response(15, 16).count() + 1'000'000, std::int64_t{1} << 32);
  EXPECT_LT(superframe.duration(), kMaxClosing);
}

TEST(Schedule, ItsLowerLimitsAreThoseOfTheFastestRadio) {
  EXPECT_EQ(kLeastTurnaround_us, dw1000::least_turnaround_us(poll_bytes(1) - radio::kFrameCheckBytes,
                                                             kResponseBytes - radio::kFrameCheckBytes));
  EXPECT_EQ(kLeastGap_us, dw1000::kLeastGap_us);
}

TEST(Schedule, EachFaultIsFoundAndNamed) {
  const groma_Schedule good = schedule_of(3, 12, groma_RangingMethod_METHOD_DS_FINAL);
  EXPECT_STREQ(fault_of(good), "");
  const auto expect = [&](std::string_view fault, auto&& spoil) {
    groma_Schedule schedule = good;
    spoil(schedule);
    EXPECT_EQ(fault_of(schedule), fault);
    EXPECT_LT(fault.size(), 64U);
  };
  expect("schedule.tag_ids: 1 to 16 tags", [](auto& s) { s.tag_ids_count = 0; });
  expect("schedule.tag_ids: 1 to 16 tags", [](auto& s) { s.tag_ids_count = 17; });
  expect("schedule.anchor_ids: 1 to 64 anchors", [](auto& s) { s.anchor_ids_count = 0; });
  expect("schedule: ids are 1 to 65534", [](auto& s) { s.tag_ids[1] = 0; });
  expect("schedule: ids are 1 to 65534", [](auto& s) { s.anchor_ids[11] = 0xFFFF; });
  expect("schedule: each id once, over tags and anchors together",
         [](auto& s) { s.anchor_ids[5] = s.tag_ids[0]; });
  expect("schedule: each id once, over tags and anchors together",
         [](auto& s) { s.tag_ids[2] = s.tag_ids[0]; });
  expect("schedule.master_id: one of anchor_ids", [](auto& s) { s.master_id = 1; });
  expect("schedule.master_id: one of anchor_ids", [](auto& s) { s.master_id = 65536 + 101; });
  expect("schedule.method: not known to this node",
         [](auto& s) { std::memset(&s.method, 9, sizeof s.method); });
  expect("schedule.turn_round_us: 90 to 5000", [](auto& s) { s.turn_round_us = 89; });
  expect("schedule.turn_round_us: 90 to 5000", [](auto& s) { s.turn_round_us = 5001; });
  expect("schedule.response_gap_us: 35 to 2000", [](auto& s) { s.response_gap_us = 34; });
  expect("schedule.response_gap_us: 35 to 2000", [](auto& s) { s.response_gap_us = 0xFFFFFFFF; });
  expect("schedule.guard_us: 2 to 1000", [](auto& s) { s.guard_us = 1; });
}

TEST(Schedule, IdsMayComeInAnyOrderWithoutRepetition) {
  groma_Schedule schedule = schedule_of(16, 64, groma_RangingMethod_METHOD_DS_FINAL);
  schedule.backup_ids_count = 0;
  std::reverse(std::begin(schedule.tag_ids), std::end(schedule.tag_ids));
  // 27 and 64 are coprime: each place occurs once, far from where it was.
  const groma_Schedule sorted = schedule;
  for (std::size_t i = 0; i < 64; ++i) schedule.anchor_ids[i] = sorted.anchor_ids[27 * i % 64];
  EXPECT_STREQ(fault_of(schedule), "");
  for (std::size_t i = 0; i < 80; ++i) {
    const auto at = [&](groma_Schedule& s, std::size_t k) -> std::uint16_t& {
      return k < 16 ? s.tag_ids[k] : s.anchor_ids[k - 16];
    };
    groma_Schedule twice = schedule;
    at(twice, i) = at(twice, (i + 31) % 80);
    EXPECT_STREQ(fault_of(twice), "schedule: each id once, over tags and anchors together") << i;
    groma_Schedule bad = schedule;
    at(bad, i) = 0;
    EXPECT_STREQ(fault_of(bad), "schedule: ids are 1 to 65534") << i;
    at(bad, i) = 0xFFFF;
    EXPECT_STREQ(fault_of(bad), "schedule: ids are 1 to 65534") << i;
  }
}

TEST(Schedule, TheHashReflectsEveryDifference) {
  const groma_Schedule base = schedule_of(3, 12, groma_RangingMethod_METHOD_DS_FINAL);
  const std::uint32_t hash = schedule_hash(base, 1, Preamble::k128);
  EXPECT_EQ(hash, schedule_hash(base, 1, Preamble::k128));
  EXPECT_NE(hash, schedule_hash(base, 2, Preamble::k128));
  EXPECT_NE(hash, schedule_hash(base, 1, Preamble::k64));
  const auto changed = [&](auto&& change) {
    groma_Schedule schedule = base;
    change(schedule);
    return schedule_hash(schedule, 1, Preamble::k128);
  };
  EXPECT_NE(hash, changed([](auto& s) { ++s.epoch; }));
  EXPECT_NE(hash, changed([](auto& s) { ++s.master_id; }));
  EXPECT_NE(hash, changed([](auto& s) { std::swap(s.tag_ids[0], s.tag_ids[1]); }));
  EXPECT_NE(hash, changed([](auto& s) { --s.anchor_ids_count; }));
  EXPECT_NE(hash, changed([](auto& s) { s.method = groma_RangingMethod_METHOD_DS_NEXT_POLL; }));
  EXPECT_NE(hash, changed([](auto& s) { ++s.turn_round_us; }));
  EXPECT_NE(hash, changed([](auto& s) { ++s.response_gap_us; }));
  EXPECT_NE(hash, changed([](auto& s) { ++s.guard_us; }));
  // Entries beyond the lists' counts do not matter.
  EXPECT_EQ(hash, changed([](auto& s) { s.tag_ids[9] = 77; }));
}

}  // namespace
}  // namespace groma::mac
