#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <set>

#include "test/firmware/air.hpp"

namespace groma::testing {
namespace {

using mac::RangeStatus;
using mac::SyncState;

std::size_t count(const std::vector<RangeSeen>& ranges, RangeStatus status) {
  return static_cast<std::size_t>(std::count_if(
      ranges.begin(), ranges.end(), [=](const RangeSeen& r) { return r.range.status == status; }));
}

std::size_t good(const std::vector<RangeSeen>& ranges) {
  return count(ranges, RangeStatus::kOk);
}

double worst_error_m(const std::vector<RangeSeen>& ranges) {
  double worst = 0.0;
  for (const RangeSeen& r : ranges) {
    if (r.range.status != RangeStatus::kOk) continue;
    worst = std::max(worst, std::abs(static_cast<double>(r.range.flight.distance_m()) - r.truth_m));
  }
  return worst;
}

double superframes_in(const groma_Schedule& schedule, const radio::Phy& phy, double seconds) {
  const mac::Superframe superframe(schedule, phy);
  return seconds * kTicksPerSecond / static_cast<double>(superframe.duration().count());
}

double uniform(std::mt19937_64& random) {
  return static_cast<double>(random() >> 11) * 0x1p-53;
}

bool is_type(const Air::Frame& frame, std::uint8_t type) {
  return frame.bytes.size() > 9 && frame.bytes[9] == type;
}
constexpr std::uint8_t kBeaconType = 1;
constexpr std::uint8_t kPollType = 2;
constexpr std::uint8_t kResponseType = 3;
constexpr std::uint8_t kFinalType = 4;

// Flight time times clock offset (2 mm at 100 m and 20 ppm) and the rounding of six timestamps.
constexpr double kIdealError_m = 0.008;

struct Case {
  groma_RangingMethod method;
  radio::Preamble preamble;
  RadioModel radio;
};

class Network : public ::testing::TestWithParam<Case> {
 protected:
  [[nodiscard]] groma_Schedule schedule(std::size_t tags = 3, std::size_t anchors = 12) const {
    return schedule_of(tags, anchors, GetParam().method);
  }
  [[nodiscard]] Air air(const groma_Schedule& schedule) const {
    return {schedule, GetParam().preamble, GetParam().radio};
  }
  [[nodiscard]] radio::Phy phy() const { return GetParam().radio.phy_of(GetParam().preamble); }
  // In an ideal world; all six timestamps of a range may be half a tick off.
  [[nodiscard]] double ideal_error_m() const {
    return kIdealError_m + static_cast<double>(GetParam().radio.tick) * kMetresPerTick;
  }
  [[nodiscard]] bool has_final() const { return GetParam().method == groma_RangingMethod_METHOD_DS_FINAL; }
};

INSTANTIATE_TEST_SUITE_P(
    Methods, Network,
    ::testing::Values(Case{groma_RangingMethod_METHOD_DS_FINAL, radio::Preamble::k128, kDw1000},
                      Case{groma_RangingMethod_METHOD_DS_NEXT_POLL, radio::Preamble::k128, kDw1000},
                      Case{groma_RangingMethod_METHOD_DS_FINAL, radio::Preamble::k64, kDw1000},
                      Case{groma_RangingMethod_METHOD_DS_NEXT_POLL, radio::Preamble::k256, kDw1000},
                      Case{groma_RangingMethod_METHOD_DS_FINAL, radio::Preamble::k128, kOtherRadio},
                      Case{groma_RangingMethod_METHOD_DS_NEXT_POLL, radio::Preamble::k64, kOtherRadio}));

TEST_P(Network, EveryRangeCompletesAndIsCorrectInAnIdealWorld) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 1);
  air.start_all();
  air.run(2.0);
  EXPECT_EQ(air.collisions, 0U);
  EXPECT_GT(static_cast<double>(good(air.ranges)),
            // The master listens first, for at least five superframes.
            36.0 * (superframes_in(schedule(), phy(), 2.0 - 0.15) - 6.0));
  EXPECT_EQ(good(air.ranges), air.ranges.size());
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
}

TEST_P(Network, TwoPercentLossCostsTheExpectedShareAndYieldsNoWrongRange) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 2);
  std::mt19937_64 random(5);
  air.lost = [&](const Air::Frame&, std::size_t) { return uniform(random) < 0.02; };
  air.start_all();
  air.run(5.0);
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
  // A range needs POLL, RESPONSE, the closing frame and the next RESPONSE. With a FINAL it also needs the
  // next POLL, which is then not the closing frame.
  const double success = std::pow(0.98, has_final() ? 5 : 4);
  const double share = static_cast<double>(good(air.ranges)) / static_cast<double>(air.ranges.size());
  EXPECT_NEAR(share, success, 0.02);
  EXPECT_GT(good(air.ranges) / 5, 300U);
}

TEST_P(Network, ThirtyPercentLossKeepsAllNodesSynchronized) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 3);
  std::mt19937_64 random(6);
  air.lost = [&](const Air::Frame&, std::size_t) { return uniform(random) < 0.30; };
  air.start_all();
  air.run(5.0);
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
  EXPECT_GT(air.ranges.size(),
            static_cast<std::size_t>(36.0 * (superframes_in(schedule(), phy(), 5.0) - 30.0)));
  EXPECT_EQ(air.collisions, 0U);
}

// Drops each frame type in turn at its receivers: exactly the ranges that needed the frame are missing.
TEST_P(Network, AReceiverThatMissesAFrameNeverYieldsARange) {
  for (const std::uint8_t type : {kPollType, kResponseType, kFinalType}) {
    if (type == kFinalType && !has_final()) continue;
    Air air = this->air(schedule(1, 3));
    air.add_all(50.0, 20.0, 4);
    // Anchor 102 does not hear, or is not heard, in every fifth superframe.
    std::uint32_t superframe = 0;
    std::size_t dropped = 0;
    air.lost = [&](const Air::Frame& frame, std::size_t receiver) {
      if (is_type(frame, kPollType)) {
        superframe = static_cast<std::uint32_t>(frame.bytes[12] | frame.bytes[13] << 8);
      }
      if (!is_type(frame, type) || superframe % 5 != 0) return false;
      const bool from_102 = frame.source != Air::kGhost && air.id(frame.source) == 102;
      const bool hit = type == kResponseType ? from_102 : air.id(receiver) == 102;
      dropped += hit ? 1 : 0;
      return hit;
    };
    air.start_all();
    air.run(3.0);
    ASSERT_GT(dropped, 10U);
    EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
    for (const RangeSeen& r : air.ranges) {
      const std::uint32_t phase = r.superframe % 5;
      bool needed = r.anchor == 102 && phase == 0;
      // The closing timestamp comes in the next superframe's RESPONSE. Without a FINAL the closing frame is
      // the next POLL.
      if (r.anchor == 102 && phase == 4 && type != kFinalType) needed = true;
      EXPECT_EQ(r.range.status != RangeStatus::kOk, needed)
          << "type " << int{type} << " superframe " << r.superframe << " anchor " << r.anchor;
    }
  }
}

TEST_P(Network, AMissingAnchorCostsItsOwnRangesOnly) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 5);
  for (std::size_t i = 0; i < air.size(); ++i) {
    if (air.id(i) != 105 && air.id(i) != 112) air.start(i);
  }
  air.run(2.0);
  std::size_t to_missing = 0;
  for (const RangeSeen& r : air.ranges) {
    const bool missing = r.anchor == 105 || r.anchor == 112;
    to_missing += missing ? 1 : 0;
    EXPECT_EQ(r.range.status, missing ? RangeStatus::kNoResponse : RangeStatus::kOk);
  }
  EXPECT_GT(to_missing, 100U);
}

TEST_P(Network, AnAnchorMayComeAndGo) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 6);
  air.start_all();
  air.run(1.0);
  air.stop(4);
  air.run(1.0);
  air.start(4);
  air.run(1.0);
  const std::size_t before = air.ranges.size();
  air.run(1.0);
  const std::vector<RangeSeen> last(air.ranges.begin() + static_cast<std::ptrdiff_t>(before),
                                    air.ranges.end());
  EXPECT_EQ(good(last), last.size());
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
}

TEST_P(Network, TenLostBeaconsAreCoastedOver) {
  const groma_Schedule schedule = this->schedule();
  Air air = this->air(schedule);
  air.add_all(100.0, 20.0, 7);
  air.start_all();
  air.run(1.0);
  std::size_t beacons_lost = 0;
  air.lost = [&](const Air::Frame& frame, std::size_t) {
    if (!is_type(frame, kBeaconType)) return false;
    ++beacons_lost;
    return true;
  };
  const std::size_t before = air.ranges.size();
  const double gap_s = 11.0 / superframes_in(schedule, phy(), 1.0);
  air.run(gap_s);
  for (std::size_t i = 0; i < air.size(); ++i) {
    if (air.id(i) == schedule.master_id) continue;
    EXPECT_EQ(air.station(i).sync().state(), SyncState::kCoasting);
  }
  EXPECT_GE(beacons_lost, 10 * (air.size() - 1));
  const std::vector<RangeSeen> during(air.ranges.begin() + static_cast<std::ptrdiff_t>(before),
                                      air.ranges.end());
  EXPECT_GE(during.size(), 324U);
  EXPECT_EQ(good(during), during.size());
  air.lost = nullptr;
  air.run(0.2);
  for (std::size_t i = 0; i < air.size(); ++i) EXPECT_EQ(air.station(i).sync().state(), SyncState::kLocked);
  EXPECT_EQ(air.collisions, 0U);
}

TEST_P(Network, WithoutItsMasterTheNetworkFallsSilentUntilItReturns) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 8);
  air.start_all();
  air.run(1.0);
  ASSERT_EQ(air.id(0), 101);
  air.stop(0);
  air.run(20.0);
  for (std::size_t i = 1; i < air.size(); ++i)
    EXPECT_EQ(air.station(i).sync().state(), SyncState::kSearching);
  const std::size_t quiet = air.ranges.size();
  air.run(1.0);
  EXPECT_EQ(air.ranges.size(), quiet);
  air.start(0);  // counts superframes from 0 again
  air.run(1.0);
  EXPECT_GT(air.ranges.size(), quiet + 360);
  const std::vector<RangeSeen> last(air.ranges.end() - 180, air.ranges.end());
  EXPECT_EQ(good(last), last.size());
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
}

TEST_P(Network, AMasterThatRestartsAtOnceIsFollowedAgain) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 9);
  air.start_all();
  air.run(1.0);
  air.start(0);
  air.run(20.0);
  const std::size_t before = air.ranges.size();
  air.run(1.0);
  const std::vector<RangeSeen> last(air.ranges.begin() + static_cast<std::ptrdiff_t>(before),
                                    air.ranges.end());
  EXPECT_GT(last.size(), 36U * 10);
  EXPECT_EQ(good(last), last.size());
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
}

TEST_P(Network, ClocksMayDriftOnePpmPerSecond) {
  Air air = this->air(schedule());
  air.add_all(100.0, 0.0, 10);
  air.start_all();
  air.run(1.0);
  const std::size_t before = air.ranges.size();
  std::vector<double> ppm(air.size(), 0.0);
  for (int step = 0; step < 500; ++step) {
    for (std::size_t i = 0; i < air.size(); ++i) {
      ppm[i] = (i % 2 == 0 ? 1.0 : -1.0) * 0.01 * step;
      air.set_offset_ppm(i, ppm[i]);
    }
    air.run(0.01);
  }
  const std::vector<RangeSeen> during(air.ranges.begin() + static_cast<std::ptrdiff_t>(before),
                                      air.ranges.end());
  EXPECT_GT(static_cast<double>(good(during)), 0.9 * static_cast<double>(during.size()));
  EXPECT_GT(static_cast<double>(during.size()), 0.9 * 36.0 * superframes_in(schedule(), phy(), 5.0));
  // The expected error: 2 ppm/s between two nodes over 20 ms is 4 cm for a 7 ms reply.
  EXPECT_LT(worst_error_m(during), 0.1);
}

// An attacker records the site's frames and replays them at any time and from anywhere.
TEST_P(Network, ReplayedFramesYieldNoWrongRange) {
  for (const std::uint8_t type : {kBeaconType, kPollType, kResponseType, kFinalType}) {
    if (type == kFinalType && !has_final()) continue;
    Air air = this->air(schedule(2, 4));
    air.add_all(50.0, 20.0, 11 + type);
    air.start_all();
    air.run(0.5);
    std::mt19937_64 random(type);
    air.overheard = [&](const Air::Frame& frame) {
      if (frame.source == Air::kGhost || !is_type(frame, type) || uniform(random) > 0.4) return;
      const double delay_us = 300.0 * std::pow(1000.0, uniform(random));  // 0.3 to 300 ms
      air.inject(frame.rmarker + delay_us * 63'897.6, 50.0 * uniform(random), frame.bytes);
    };
    air.run(5.0);
    EXPECT_GT(air.ranges.size(), 500U);
    EXPECT_LT(worst_error_m(air.ranges), ideal_error_m()) << "type " << int{type};
    air.overheard = nullptr;
    air.run(2.0);
    const std::vector<RangeSeen> last(air.ranges.end() - 80, air.ranges.end());
    EXPECT_EQ(good(last), last.size()) << "type " << int{type};
  }
}

// A relay attack: the genuine frame is lost and its copy arrives too late. It must yield no wrong range.
TEST_P(Network, AFrameDelayedBeyondItsWindowYieldsNoRange) {
  for (const std::uint8_t type : {kPollType, kResponseType, kFinalType}) {
    if (type == kFinalType && !has_final()) continue;
    for (const double delay_us : {5.0, 25.0, 100.0}) {
      Air air = this->air(schedule(1, 3));
      air.add_all(50.0, 20.0, 20);
      air.start_all();
      air.run(0.3);
      air.ranges.clear();
      air.lost = [&](const Air::Frame& frame, std::size_t) {
        return frame.source != Air::kGhost && is_type(frame, type);
      };
      air.overheard = [&](const Air::Frame& frame) {
        if (frame.source == Air::kGhost || !is_type(frame, type)) return;
        air.inject(frame.rmarker + delay_us * 63'897.6, frame.x_m, frame.bytes);
      };
      air.run(1.0);
      // A relayed FINAL delays only the closing timestamp. The implied clock offset exposes it.
      EXPECT_LT(worst_error_m(air.ranges), ideal_error_m()) << "type " << int{type} << ' ' << delay_us;
    }
  }
}

TEST_P(Network, InvalidTimestampsYieldNoRange) {
  Air air = this->air(schedule());
  air.add_all(100.0, 20.0, 12);
  std::mt19937_64 random(13);
  air.spoil = [&](std::size_t, mac::Reception& reception) {
    if (uniform(random) > 0.1) return;
    reception.timestamp_valid = false;
    reception.timestamp += Ticks(static_cast<std::int64_t>(random() % 100'000));
  };
  air.start_all();
  air.run(3.0);
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
  EXPECT_GT(count(air.ranges, RangeStatus::kBadTimestamp), 100U);
  EXPECT_GT(good(air.ranges), air.ranges.size() / 3);
}

// A timestamp that the chip marks valid but that belongs to another frame.
TEST_P(Network, ContradictoryTimestampsAreDetected) {
  Air air = this->air(schedule(1, 4));
  air.add_all(100.0, 20.0, 14);
  air.start_all();
  air.run(0.5);
  std::mt19937_64 random(15);
  std::map<std::size_t, ClockTime> before;
  std::size_t swapped = 0;
  air.spoil = [&](std::size_t receiver, mac::Reception& reception) {
    const ClockTime own = reception.timestamp;
    if (before.contains(receiver) && uniform(random) < 0.1) {
      reception.timestamp = before[receiver];
      ++swapped;
    }
    before[receiver] = own;
  };
  air.run(3.0);
  EXPECT_GT(swapped, 100U);
  EXPECT_LT(worst_error_m(air.ranges), ideal_error_m());
  EXPECT_GT(good(air.ranges), air.ranges.size() / 4);
}

TEST_P(Network, AStaleScheduleStaysSilent) {
  const groma_Schedule current = schedule();
  groma_Schedule old = current;
  --old.epoch;
  Air air = this->air(current);
  air.add_all(100.0, 20.0, 16);
  const std::size_t stale = air.add({.id = 3, .x_m = 3.0, .offset_ppm = 1.0}, old);
  for (std::size_t i = 0; i < air.size(); ++i) {
    if (air.id(i) != 3 || i == stale) air.start(i);
  }
  air.run(1.0);
  EXPECT_EQ(air.counters(stale).frames_sent, 0U);
  EXPECT_GT(air.counters(stale).stale_frames, 5U);
  EXPECT_EQ(air.station(stale).sync().state(), SyncState::kSearching);
}

// More than 65536 exchanges of one tag: the exchange number wraps without effect.
TEST(Exchange, NumbersWrap) {
  Air air(schedule_of(1, 1, groma_RangingMethod_METHOD_DS_NEXT_POLL, 150, 50), radio::Preamble::k64);
  air.work_ticks = 20e-6 * kTicksPerSecond;
  air.add_all(50.0, 20.0, 17);
  air.start_all();
  std::size_t total = 0;
  while (total < 66'500) {
    air.run(2.0);
    ASSERT_EQ(good(air.ranges), air.ranges.size());
    ASSERT_LT(worst_error_m(air.ranges), 0.012);
    ASSERT_GT(air.ranges.size(), 0U);
    total += air.ranges.size();
    air.ranges.clear();
  }
}

// The master's beacon of superframe 42 in network 9.
mac::FrameBytes beacon_of(const groma_Schedule& schedule) {
  mac::Beacon body{.superframe = 42,
                   .session = 5,
                   .epoch = schedule.epoch,
                   .schedule_hash = mac::schedule_hash(schedule, 9, radio::Preamble::k128),
                   .master = 101,
                   .slots = static_cast<std::uint8_t>(schedule.tag_ids_count)};
  body.owners.fill(mac::kBroadcast);
  return mac::serialize({.network = 9, .destination = mac::kBroadcast, .source = 101, .body = body});
}

TEST(Anchor, AnswersOnlyAPollOfTheRightSlotSuperframeAndIds) {
  const groma_Schedule schedule = schedule_of(2, 3, groma_RangingMethod_METHOD_DS_NEXT_POLL);
  groma_Counters counters = groma_Counters_init_zero;
  const mac::Site site{.id = 102,
                       .network_id = 9,
                       .phy = dw1000::phy_of(radio::Preamble::k128),
                       .schedule = &schedule,
                       .transmit_antenna_delay = Ticks(16436)};
  const auto poll_result = [&](const mac::Poll& poll, std::uint16_t source, std::uint16_t network) {
    mac::Anchor anchor(site, counters);
    (void)anchor.start(ClockTime(1'000'000));
    const auto beacon = beacon_of(schedule);
    const ClockTime heard(5'000'000'000);
    Step step = anchor.on_received({.timestamp = heard, .timestamp_valid = true, .frame = beacon.bytes()});
    EXPECT_EQ(step.action.kind, Action::Kind::kListen);
    step = anchor.on_timeout(step.action.until);  // nobody in the shared slot
    EXPECT_EQ(step.action.kind, Action::Kind::kListen);
    const auto bytes =
        mac::serialize({.network = network, .destination = mac::kBroadcast, .source = source, .body = poll});
    const ClockTime due = heard + anchor.superframe().poll(0) - anchor.superframe().beacon();
    step = anchor.on_received({.timestamp = due, .timestamp_valid = true, .frame = bytes.bytes()});
    return step.action.kind;
  };
  const mac::Poll good_poll{.exchange = 5, .superframe = 42, .slot = 0, .count = 2, .anchors = {101, 102}};
  EXPECT_EQ(poll_result(good_poll, 1, 9), Action::Kind::kTransmit);
  mac::Poll poll = good_poll;
  poll.superframe = 41;
  EXPECT_NE(poll_result(poll, 1, 9), Action::Kind::kTransmit);
  poll = good_poll;
  poll.slot = 1;
  EXPECT_NE(poll_result(poll, 1, 9), Action::Kind::kTransmit);
  poll = good_poll;
  poll.anchors[1] = 103;
  EXPECT_NE(poll_result(poll, 1, 9), Action::Kind::kTransmit);
  EXPECT_NE(poll_result(good_poll, 2, 9), Action::Kind::kTransmit);
  poll = good_poll;
  poll.lent = true;
  EXPECT_EQ(poll_result(poll, 103, 9), Action::Kind::kTransmit);
  EXPECT_NE(poll_result(good_poll, 1, 8), Action::Kind::kTransmit);
  EXPECT_EQ(counters.foreign_frames, 1U);
  EXPECT_EQ(counters.stale_frames, 3U);
}

TEST(Station, ItsReceiverHuntsAGuardBeforeAFrameIsDue) {
  const groma_Schedule schedule = schedule_of(1, 2, groma_RangingMethod_METHOD_DS_NEXT_POLL);
  groma_Counters counters = groma_Counters_init_zero;
  const mac::Anchor anchor(
      {.id = 102, .network_id = 9, .phy = dw1000::phy_of(radio::Preamble::k128), .schedule = &schedule},
      counters);
  const mac::Superframe& superframe = anchor.superframe();
  const ClockTime due(10'000'000'000);
  const Ticks slack(1'000);
  const Action action = anchor.listen(mac::SlotKind::kPoll, due, 100, slack);
  const Ticks to_start = due - superframe.phy().before_rmarker() - superframe.guard() - slack - action.at;
  EXPECT_GE(to_start, Ticks::from_us(16));
  EXPECT_LT(to_start, Ticks::from_us(17));
  EXPECT_EQ(action.preamble_until, due + superframe.guard() + slack);
}

// A tag whose only anchor is played by the test, which supplies the RESPONSE of each exchange.
class ScriptedAnchor {
 public:
  ScriptedAnchor() : tag_(site(), counters) {
    (void)tag_.start(ClockTime(0));
    const auto beacon = beacon_of(schedule());
    step_ = tag_.on_received(
        {.timestamp = ClockTime(5'000'000'000), .timestamp_valid = true, .frame = beacon.bytes()});
  }

  // Lets the tag send its POLL and hear the RESPONSE `late` ticks after its due time.
  Step exchange(mac::Response response, Ticks late, std::uint16_t source = 101) {
    while (step_.action.kind == Action::Kind::kListen) step_ = tag_.on_timeout(step_.action.until);
    EXPECT_EQ(step_.action.kind, Action::Kind::kTransmit);
    const ClockTime sent = step_.action.at;
    (void)tag_.on_transmitted(sent);
    const Ticks due = tag_.superframe().response(0, 1);
    response.reply = due - Ticks(200);
    const auto bytes = mac::serialize({.network = 9, .destination = 1, .source = source, .body = response});
    step_ =
        tag_.on_received({.timestamp = sent + due + late, .timestamp_valid = true, .frame = bytes.bytes()});
    return step_;
  }

  groma_Counters counters = groma_Counters_init_zero;

 private:
  static const groma_Schedule& schedule() {
    static const groma_Schedule schedule = schedule_of(1, 1, groma_RangingMethod_METHOD_DS_NEXT_POLL);
    return schedule;
  }
  static mac::Site site() {
    return {.id = 1,
            .network_id = 9,
            .phy = dw1000::phy_of(radio::Preamble::k128),
            .schedule = &schedule(),
            .transmit_antenna_delay = Ticks(16436)};
  }
  mac::Tag tag_;
  Step step_;
};

TEST(Tag, AcceptsAClosingTimestampOnlyOfThePreviousExchange) {
  for (const std::uint16_t closed : {std::uint16_t{0}, std::uint16_t{1}, std::uint16_t{0xFFFF}}) {
    ScriptedAnchor script;
    EXPECT_EQ(script.exchange({.exchange = 0}, Ticks(0)).completed, nullptr);
    const Step step = script.exchange(
        {.exchange = 1, .closing_valid = true, .closed_exchange = closed, .closing = Ticks(1000)}, Ticks(0));
    ASSERT_NE(step.completed, nullptr);
    EXPECT_TRUE(step.completed->legs[0].answered);
    EXPECT_EQ(step.completed->legs[0].closing_state,
              closed == 0 ? mac::Leg::Closing::kHeld : mac::Leg::Closing::kStale);
  }
}

TEST(Tag, AcceptsAResponseOnlyOfThisExchangeAnchorAndWindow) {
  const auto answered = [](std::uint16_t number, Ticks late, std::uint16_t source) {
    ScriptedAnchor script;
    (void)script.exchange({.exchange = number}, late, source);
    const Step step = script.exchange({.exchange = 1}, Ticks(0));
    EXPECT_NE(step.completed, nullptr);
    const bool taken = step.completed != nullptr && step.completed->legs[0].answered;
    EXPECT_EQ(script.counters.stale_frames, taken ? 0U : 1U);
    return taken;
  };
  EXPECT_TRUE(answered(0, Ticks(0), 101));
  EXPECT_TRUE(answered(0, Ticks::from_us(19), 101));
  EXPECT_FALSE(answered(1, Ticks(0), 101));
  EXPECT_FALSE(answered(0xFFFF, Ticks(0), 101));
  EXPECT_FALSE(answered(0, Ticks::from_us(21), 101));
  EXPECT_FALSE(answered(0, Ticks::from_us(-21), 101));
  EXPECT_FALSE(answered(0, Ticks(0), 102));
}

TEST(Tag, PollsAfterALateTransmitWithoutClosingAcrossTheGap) {
  Air air(schedule_of(1, 2, groma_RangingMethod_METHOD_DS_NEXT_POLL), radio::Preamble::k128);
  air.add_all(50.0, 20.0, 18);
  air.start_all();
  air.run(0.5);
  air.ranges.clear();
  // Nodes occasionally take so long that the POLL after the beacon cannot be armed in time.
  for (int i = 0; i < 200; ++i) {
    air.work_ticks = (i % 7 == 0 ? 3000e-6 : 100e-6) * kTicksPerSecond;
    air.run(0.003);
  }
  air.work_ticks = 100e-6 * kTicksPerSecond;
  std::uint32_t late = 0;
  for (std::size_t i = 0; i < air.size(); ++i) late += air.counters(i).late_transmits;
  EXPECT_GT(late, 5U);
  EXPECT_LT(worst_error_m(air.ranges), kIdealError_m);
  air.ranges.clear();
  air.run(0.5);
  EXPECT_GT(air.ranges.size(), 50U);
  EXPECT_EQ(good(air.ranges), air.ranges.size());
}

}  // namespace
}  // namespace groma::testing
