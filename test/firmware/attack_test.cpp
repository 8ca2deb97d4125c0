// A keyed network on an ideal channel, and an attacker without the key. He hears every frame, sends any frame
// at any time, and keeps genuine frames from any receiver.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <map>
#include <optional>
#include <set>
#include <vector>

#include "test/firmware/air.hpp"

namespace groma::testing {
namespace {

using mac::Body;

constexpr security::Key kKey = {0xA0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

enum Kind : std::size_t { kBeacon, kPoll, kResponse, kFinal, kJoin, kData };

mac::Frame frame_of(std::span<const std::uint8_t> bytes) {
  const auto parsed = mac::parse(bytes);
  EXPECT_TRUE(parsed.frame.has_value());
  return parsed.frame.value_or(mac::Frame{});
}

// What the attacker makes of a genuine frame that he has just heard.
enum class Forgery { kReplayed, kReplayedLongAfter, kWrongMic, kChanged, kWithoutMic, kOtherKey };

constexpr std::array kForgeries = {Forgery::kReplayed, Forgery::kReplayedLongAfter, Forgery::kWrongMic,
                                   Forgery::kChanged,  Forgery::kWithoutMic,        Forgery::kOtherKey};

// Alternates JOIN and DATA in its open slots, and counts the control frames and beacons that it receives.
class Chatter final : public mac::ControlChannel {
 public:
  explicit Chatter(std::uint16_t id) : id_(id) {}
  std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override {
    if (!talks) return std::nullopt;
    if (number / 2 % 2 == 0)
      return Outgoing{.body = mac::Join{.origin = id_, .nonce = number, .wants_slot = true}};
    return Outgoing{.body = mac::Data{.origin = id_, .target = 1, .fragments = 1, .size = 5}};
  }
  void on_sent(std::uint32_t, bool) noexcept override {}
  void on_control(const mac::Frame&, std::uint32_t, bool) noexcept override { ++received; }
  void on_beacon(const mac::Frame&, const mac::Beacon&) noexcept override { ++beacons; }
  void on_beacon_out(mac::Beacon&, bool) noexcept override {}
  bool talks = false;
  std::size_t received = 0;
  std::size_t beacons = 0;

 private:
  std::uint16_t id_;
};

class AttackTest : public ::testing::Test {
 protected:
  AttackTest() {
    schedule.backup_ids_count = 1;
    schedule.backup_ids[0] = 102;
    air.emplace(schedule, radio::Preamble::k128);
    air->key = kKey;
    air->add_all(30.0, 15.0, 5);
    for (std::size_t i = 0; i < air->size(); ++i) {
      chatter.push_back(std::make_unique<Chatter>(air->id(i)));
      air->attach(i, *chatter.back());
    }
    air->overheard = [this](const Air::Frame& frame) { hear(frame); };
  }

  void hear(const Air::Frame& frame) {
    if (frame.source == Air::kGhost) return;
    const mac::Frame parsed = frame_of(frame.bytes);
    EXPECT_TRUE(parsed.secured);
    heard[parsed.body.index()].push_back(frame);
    if (on_frame) on_frame(frame, parsed);
  }

  [[nodiscard]] double duration() const {
    return static_cast<double>(air->station(0).superframe().duration().count());
  }
  void run_superframes(double count) { air->run(count * duration() / kTicksPerSecond); }
  [[nodiscard]] std::uint32_t dropped() const {
    std::uint32_t count = 0;
    for (std::size_t i = 0; i < air->size(); ++i) {
      count += air->counters(i).forged_frames + air->counters(i).unsecured_frames;
    }
    return count;
  }
  [[nodiscard]] std::size_t received_in_shared_slots() const {
    std::size_t count = 0;
    for (const auto& one : chatter) count += one->received;
    return count;
  }
  [[nodiscard]] std::size_t good_ranges(std::uint16_t tag = 0, std::uint16_t anchor = 0) const {
    return static_cast<std::size_t>(
        std::count_if(air->ranges.begin(), air->ranges.end(), [=](const auto& seen) {
          return seen.range.status == mac::RangeStatus::kOk && (tag == 0 || seen.tag == tag) &&
                 (anchor == 0 || seen.anchor == anchor);
        }));
  }
  void expect_true_ranges() const {
    for (const RangeSeen& seen : air->ranges) {
      if (seen.range.status != mac::RangeStatus::kOk) continue;
      EXPECT_NEAR(static_cast<double>(seen.range.flight.distance_m()), seen.truth_m, 0.1);
    }
  }
  void expect_no_forged_range(std::uint16_t anchor) const {
    EXPECT_TRUE(std::none_of(air->ranges.begin(), air->ranges.end(), [&](const RangeSeen& seen) {
      return seen.range.status == mac::RangeStatus::kOk && seen.anchor == anchor &&
             attacked.count({seen.tag, seen.superframe}) != 0;
    }));
  }
  [[nodiscard]] bool all_fresh() const {
    for (std::size_t i = 0; i < air->size(); ++i) {
      if (!air->station(i).fresh() || air->station(i).sync().state() == mac::SyncState::kSearching)
        return false;
    }
    return true;
  }
  void start_network() {
    air->start_all();
    run_superframes(60);
    ASSERT_TRUE(all_fresh());
    ASSERT_EQ(dropped(), 0U);
    for (std::size_t i = 0; i < air->size(); ++i) chatter[i]->talks = air->id(i) == 104;
  }
  void expect_full_rate(double superframes = 20) {
    const std::size_t before = good_ranges();
    run_superframes(superframes);
    EXPECT_GE(good_ranges() - before, static_cast<std::size_t>((superframes - 1) * 8));
    expect_true_ranges();
  }

  // ---- the attacker ------------------------------------------------------------------------------------
  [[nodiscard]] std::vector<std::uint8_t> forge(Forgery forgery, const Air::Frame& frame,
                                                const mac::Frame& parsed) {
    std::vector<std::uint8_t> bytes = frame.bytes;
    const auto& known = heard[parsed.body.index()];
    const auto last_of = [&](auto&& good) {
      return std::find_if(known.rbegin() + 1, known.rend(), [&](const Air::Frame& other) {
        return other.source == frame.source && frame_of(other.bytes).destination == parsed.destination &&
               good(other);
      });
    };
    switch (forgery) {
      case Forgery::kReplayed:
        return last_of([](const auto&) { return true; })->bytes;
      case Forgery::kReplayedLongAfter:
        return last_of(
                   [&](const Air::Frame& other) { return other.rmarker < frame.rmarker - 40 * duration(); })
            ->bytes;
      case Forgery::kWrongMic:
        bytes.back() ^= 0x10;
        return bytes;
      case Forgery::kChanged:
        bytes[mac::kHeaderBytes] ^= 0x01;
        return bytes;
      case Forgery::kWithoutMic:
        bytes.resize(bytes.size() - mac::kCodeBytes);
        bytes[mac::kHeaderBytes - 1] &= 0x7F;
        return bytes;
      case Forgery::kOtherKey:
        break;
    }
    constexpr security::Key kOwn = {1};
    mac::SignedPlaces signed_places;
    mac::FrameAuthenticator authenticator(&aes, kOwn, &signed_places);
    mac::Place place{air->station(0).superframe_number(), mac::Place::kShared};
    authenticator.enter(air->station(0).election().session());
    if (const auto* beacon = std::get_if<mac::Beacon>(&parsed.body)) place = mac::place_of(*beacon);
    if (const auto* poll = std::get_if<mac::Poll>(&parsed.body)) place = {poll->superframe, poll->slot};
    auto signed_bytes = mac::serialize(parsed);
    sign(authenticator, signed_bytes, parsed.body, place);
    return {signed_bytes.bytes().begin(), signed_bytes.bytes().end()};
  }

  // Jams each genuine frame of that kind from that sender and sends the forgery in its place.
  void replace(Kind kind, std::uint16_t sender, Forgery forgery) {
    air->jammed = [=, this](const Air::Frame& frame) {
      return frame.source != Air::kGhost && air->id(frame.source) == sender &&
             frame_of(frame.bytes).body.index() == kind;
    };
    on_frame = [=, this](const Air::Frame& frame, const mac::Frame& parsed) {
      if (parsed.source != sender || parsed.body.index() != kind) return;
      ghost = forge(forgery, frame, parsed);
      const double shorter = static_cast<double>(
          (air->phy().after_rmarker(frame.bytes.size() + 2) - air->phy().after_rmarker(ghost.size() + 2))
              .count());
      air->inject(frame.rmarker + shorter + 64.0, air->x_m(frame.source), ghost);
      if (ghosts_sent++ == 0) first_ghost = frame.rmarker;
      last_ghost = frame.rmarker;
      attacked.emplace(parsed.destination, air->station(frame.source).superframe_number());
    };
    air->spoil = [this](std::size_t receiver, mac::Reception& reception) {
      if (!std::equal(ghost.begin(), ghost.end(), reception.frame.begin(), reception.frame.end())) return;
      const mac::Frame parsed = frame_of(ghost);
      const bool for_all = parsed.destination == mac::kBroadcast;
      if (for_all || parsed.destination == air->id(receiver)) ++ghosts_heard;
    };
  }
  // Replays the beacons from superframe `from` on, for `superframes`, to a node that starts. All others are
  // off.
  void replay_to(std::size_t victim, const std::vector<Air::Frame>& beacons, std::uint32_t from,
                 double superframes) {
    for (std::size_t i = 0; i < air->size(); ++i) air->stop(i);
    const auto first = std::find_if(beacons.begin(), beacons.end(), [&](const Air::Frame& frame) {
      const mac::Frame parsed = frame_of(frame.bytes);
      const auto* beacon = std::get_if<mac::Beacon>(&parsed.body);
      return beacon != nullptr && beacon->superframe >= from;
    });
    ASSERT_NE(first, beacons.end());
    const double later = air->now() - first->rmarker + 4 * duration();
    const double last = first->rmarker + superframes * duration();
    for (auto frame = first; frame != beacons.end() && frame->rmarker < last; ++frame) {
      air->inject(frame->rmarker + later, frame->x_m, frame->bytes);
    }
    air->start(victim);
    run_superframes(superframes + 4);
    air->stop(victim);
  }
  void cease() {
    air->jammed = nullptr;
    air->spoil = nullptr;
    on_frame = nullptr;
  }

  groma_Schedule schedule = schedule_of(2, 4, groma_RangingMethod_METHOD_DS_FINAL);
  std::optional<Air> air;
  std::vector<std::unique_ptr<Chatter>> chatter;
  std::map<std::size_t, std::vector<Air::Frame>> heard;  // by kind
  std::function<void(const Air::Frame&, const mac::Frame&)> on_frame;
  std::vector<std::uint8_t> ghost;
  std::set<std::pair<std::uint16_t, std::uint32_t>> attacked;  // addressee and superframe
  double first_ghost = 0.0;
  double last_ghost = 0.0;
  std::size_t ghosts_sent = 0;
  std::size_t ghosts_heard = 0;
  sim::Aes aes;
};

TEST_F(AttackTest, AKeyedNetworkStartsAndRanges) {
  start_network();
  expect_full_rate(50);
  EXPECT_EQ(dropped(), 0U);
  EXPECT_FALSE(heard[kJoin].empty());
  EXPECT_GT(received_in_shared_slots(), 20U);
}

struct Replacement {
  Kind kind;
  std::uint16_t sender;
  const char* name;
};

class Replaced : public AttackTest, public ::testing::WithParamInterface<Replacement> {};

TEST_P(Replaced, ForgedFramesAreDroppedAndCounted) {
  const Kind kind = GetParam().kind;
  const std::uint16_t sender = GetParam().sender;
  start_network();
  run_superframes(20);
  // Not between a POLL and its RESPONSEs.
  const std::size_t answered = heard[kResponse].size();
  while (heard[kResponse].size() < answered + 8) air->run(0.0001);
  for (const Forgery forgery : kForgeries) {
    SCOPED_TRACE(static_cast<int>(forgery));
    const std::uint32_t dropped_before = dropped();
    const std::size_t shared_before = received_in_shared_slots();
    const std::size_t ranges_before = air->ranges.size();
    ghosts_sent = ghosts_heard = 0;
    replace(kind, sender, forgery);
    // An unanswered tag polls only in some superframes and listens for other networks in the rest.
    run_superframes(kind == kPoll ? 24 : 8);
    cease();
    EXPECT_GE(ghosts_sent, kind >= kJoin ? 1U : 7U);
    EXPECT_GE(ghosts_heard, ghosts_sent);
    EXPECT_EQ(dropped() - dropped_before, ghosts_heard);
    const auto since = std::span(air->ranges).subspan(ranges_before);
    const auto good = [&](std::uint16_t tag, std::uint16_t anchor) {
      return std::count_if(since.begin(), since.end(), [=](const RangeSeen& seen) {
        return seen.range.status == mac::RangeStatus::kOk && (tag == 0 || seen.tag == tag) &&
               (anchor == 0 || seen.anchor == anchor);
      });
    };
    const auto to_attacked_tag = [&] {
      return std::count_if(heard[kResponse].begin(), heard[kResponse].end(), [&](const Air::Frame& frame) {
        return frame.rmarker > first_ghost && frame.rmarker < last_ghost &&
               frame_of(frame.bytes).destination == sender;
      });
    };
    switch (kind) {
      case kBeacon:
        // The others coast and keep ranging.
        EXPECT_GE(good(0, 0), 7 * 8);
        EXPECT_TRUE(all_fresh());
        break;
      case kPoll:
        EXPECT_EQ(to_attacked_tag(), 0);
        EXPECT_LE(good(sender, 0), 4);  // of the previous exchange
        EXPECT_GE(good(2, 0), 23 * 4);
        break;
      case kResponse:
        EXPECT_LE(good(0, sender), 2);
        EXPECT_GE(good(0, 101) + good(0, 102) + good(0, 104), 7 * 6);
        break;
      case kFinal:
        EXPECT_LE(good(sender, 0), 4);
        EXPECT_GE(good(2, 0), 7 * 4);
        break;
      case kJoin:
      case kData:
        // The remaining frames are of the other kind.
        EXPECT_LE(received_in_shared_slots() - shared_before, 3 * (air->size() - 1));
        EXPECT_GE(good(0, 0), 7 * 8);
        break;
    }
    run_superframes(4);
    if (kind == kResponse) {
      // Later frames do not complete an attacked exchange either.
      expect_no_forged_range(sender);
    }
    expect_full_rate();
  }
}

INSTANTIATE_TEST_SUITE_P(EachKind, Replaced,
                         ::testing::Values(Replacement{kBeacon, 101, "Beacon"}, Replacement{kPoll, 1, "Poll"},
                                           Replacement{kResponse, 103, "Response"},
                                           Replacement{kFinal, 1, "Final"}, Replacement{kJoin, 104, "Join"},
                                           Replacement{kData, 104, "Data"}),
                         [](const auto& one) { return one.param.name; });

TEST_F(AttackTest, AForgedChallengeGetsNoAnswer) {
  start_network();
  run_superframes(60);
  for (const auto& one : chatter) one->talks = false;
  constexpr std::size_t kStarting = 5;
  for (const Forgery forgery : kForgeries) {
    SCOPED_TRACE(static_cast<int>(forgery));
    air->stop(kStarting);
    run_superframes(4);
    const std::uint32_t dropped_before = dropped();
    const std::size_t beacons_before = heard[kBeacon].size();
    ghosts_sent = ghosts_heard = 0;
    replace(kJoin, air->id(kStarting), forgery);
    air->start(kStarting);
    run_superframes(40);
    cease();
    EXPECT_GE(ghosts_sent, 3U);
    EXPECT_EQ(ghosts_heard, ghosts_sent * (air->size() - 1));
    EXPECT_EQ(dropped() - dropped_before, ghosts_heard);
    EXPECT_FALSE(air->station(kStarting).fresh());
    for (const Air::Frame& frame : std::span(heard[kBeacon]).subspan(beacons_before)) {
      const mac::Frame parsed = frame_of(frame.bytes);
      EXPECT_FALSE(std::get<mac::Beacon>(parsed.body).challenge_response.has_value());
    }
    run_superframes(60);
    EXPECT_TRUE(all_fresh());
  }
  expect_full_rate();
}

// The next genuine RESPONSE closes the exchange that was attacked.
TEST_F(AttackTest, OneForgedResponseMakesNoRange) {
  start_network();
  run_superframes(20);
  for (const std::uint16_t anchor : std::array<std::uint16_t, 4>{101, 102, 103, 104}) {
    for (const Forgery forgery : kForgeries) {
      SCOPED_TRACE(static_cast<int>(forgery));
      attacked.clear();
      ghosts_sent = ghosts_heard = 0;
      replace(kResponse, anchor, forgery);
      while (attacked.empty()) air->run(0.0001);
      run_superframes(0.5);
      cease();
      EXPECT_GE(ghosts_heard, 1U);
      run_superframes(6);
      expect_no_forged_range(anchor);
      air->ranges.clear();
    }
  }
}

// A caller that forgets a call besides the events must not make a tag use a forged RESPONSE.
TEST_F(AttackTest, EventsAloneVerifyEachResponse) {
  air->only_events = true;
  start_network();
  run_superframes(20);
  for (const Forgery forgery : kForgeries) {
    SCOPED_TRACE(static_cast<int>(forgery));
    const std::uint32_t dropped_before = dropped();
    attacked.clear();
    ghosts_sent = ghosts_heard = 0;
    replace(kResponse, 103, forgery);
    run_superframes(8);
    cease();
    EXPECT_GE(ghosts_heard, 7U);
    run_superframes(4);
    expect_no_forged_range(103);
    EXPECT_GE(dropped() - dropped_before, ghosts_heard);
  }
  expect_full_rate();
}

// Anchor 103 surveys in the slot of tag 1, which is silent at first and then polls too. No nonce may be used
// by two nodes, or twice.
TEST_F(AttackTest, ASurveyPollsWithNoncesOfItsOwn) {
  start_network();
  for (const auto& one : chatter) one->talks = false;
  constexpr std::size_t kSurveyor = 2;
  constexpr std::size_t kLender = 4;
  ASSERT_EQ(air->id(kSurveyor), 103);
  ASSERT_EQ(air->id(kLender), 1);
  std::map<std::size_t, std::size_t> polls;  // of each node
  std::map<std::array<std::uint32_t, 3>, std::vector<std::uint8_t>> polls_of_nonce;
  on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
    EXPECT_EQ(parsed.source, air->id(frame.source));
    const auto* poll = std::get_if<mac::Poll>(&parsed.body);
    if (poll == nullptr) return;
    ++polls[frame.source];
    const auto [found, first] =
        polls_of_nonce.try_emplace({parsed.source, poll->superframe, poll->slot}, frame.bytes);
    EXPECT_TRUE(first || found->second == frame.bytes) << "superframe " << poll->superframe;
  };
  air->stop(kLender);
  air->survey(kSurveyor, 1);
  // Longer than the master leaves a slot to a tag that does not poll.
  run_superframes(2.0 * mac::kLease);
  EXPECT_GT(polls[kSurveyor], mac::kLease);
  const std::size_t polls_before = polls[kSurveyor];
  run_superframes(20);
  EXPECT_GE(polls[kSurveyor] - polls_before, 15U);
  for (const std::uint16_t anchor : std::array<std::uint16_t, 3>{101, 102, 104})
    EXPECT_GT(good_ranges(103, anchor), mac::kLease / 2);
  expect_true_ranges();
  air->start(kLender);
  run_superframes(80);
  EXPECT_GT(polls[kLender], 4U);
}

// Anchor 104's RESPONSE is jammed, and 103's of the same slot is replayed in its window.
TEST_F(AttackTest, AReplayedResponseInAnotherAnchorsWindowIsStale) {
  start_network();
  std::optional<Air::Frame> of_103;
  air->jammed = [this](const Air::Frame& frame) {
    return frame.source != Air::kGhost && air->id(frame.source) == 104 &&
           frame_of(frame.bytes).body.index() == kResponse;
  };
  on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
    if (parsed.body.index() != kResponse) return;
    if (parsed.source == 103) of_103 = frame;
    if (parsed.source == 104) air->inject(frame.rmarker + 64.0, 0.0, of_103->bytes);
  };
  std::size_t stale = 0;
  for (std::size_t i = 0; i < air->size(); ++i) stale += air->counters(i).stale_frames;
  const std::size_t before = good_ranges(0, 104);
  run_superframes(20);
  EXPECT_LE(good_ranges(0, 104) - before, 2U);
  for (std::size_t i = 0; i < air->size(); ++i) stale -= air->counters(i).stale_frames;
  EXPECT_LE(static_cast<std::ptrdiff_t>(stale), -38);
  expect_true_ranges();
}

// Replays the master's beacon in the shared slot of the same superframe or of the next one.
TEST_F(AttackTest, AReplayedBeaconIsRejected) {
  start_network();
  const double shared = static_cast<double>(
      (air->station(0).superframe().shared() - air->station(0).superframe().beacon()).count());
  // Jams the genuine traffic in the shared slots.
  air->jammed = [this](const Air::Frame& frame) {
    const auto kind = frame_of(frame.bytes).body.index();
    return frame.source != Air::kGhost &&
           (kind == kJoin || kind == kData || (kind == kBeacon && air->id(frame.source) != 101));
  };
  std::size_t seen = 0;
  std::size_t sent = 0;
  on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
    if (parsed.body.index() != kBeacon || parsed.source != 101) return;
    if (++seen % 3 == 0) return;
    const bool next = seen % 3 == 2;
    ++sent;
    air->inject(frame.rmarker + shared + (next ? duration() : 0.0), air->x_m(frame.source), frame.bytes);
  };
  run_superframes(30);
  // The master and the other five nodes hear it, except a node that was transmitting.
  EXPECT_GE(dropped(), sent * 4);
  EXPECT_TRUE(all_fresh());
  expect_full_rate();
}

// Replays recorded traffic to a node that has just started, with no genuine node on the air.
TEST_F(AttackTest, AStartingNodeRejectsARecording) {
  start_network();
  run_superframes(60);
  for (const auto& one : chatter) one->talks = false;
  std::vector<Air::Frame> recording;
  for (const auto& [kind, frames] : heard) recording.insert(recording.end(), frames.begin(), frames.end());
  for (const std::uint16_t victim : {std::uint16_t{1}, std::uint16_t{103}}) {
    SCOPED_TRACE(victim);
    std::size_t index = 0;
    for (std::size_t i = 0; i < air->size(); ++i) {
      air->stop(i);
      if (air->id(i) == victim) index = i;
    }
    heard.clear();
    run_superframes(10);
    const std::size_t ranges = good_ranges();
    const double later = air->now() - recording.front().rmarker + 4 * duration();
    for (const Air::Frame& frame : recording) {
      if (air->id(frame.source) != victim) air->inject(frame.rmarker + later, frame.x_m, frame.bytes);
    }
    const std::uint32_t beacons = air->counters(index).beacons_received;
    const std::size_t beacons_before = chatter[index]->beacons;
    air->start(index);
    run_superframes(100);
    // It hears the beacons and sends challenges, but no other frame, and reports no beacon to its control
    // channel.
    EXPECT_GT(air->counters(index).beacons_received, beacons + 10);
    EXPECT_GE(heard[kJoin].size(), 3U);
    EXPECT_EQ(heard[kPoll].size() + heard[kResponse].size() + heard[kData].size() + heard[kFinal].size(), 0U);
    EXPECT_EQ(chatter[index]->beacons, beacons_before);
    EXPECT_FALSE(air->station(index).fresh());
    EXPECT_EQ(good_ranges(), ranges);
    // The genuine nodes come back, and it joins them again.
    run_superframes(40);
    for (std::size_t i = 0; i < air->size(); ++i) {
      if (i != index) air->start(i);
    }
    run_superframes(120);
    EXPECT_TRUE(all_fresh());
    expect_full_rate();
  }
}

// A tag coasts until its clock is too uncertain, then hears the beacons that it missed, replayed. By their
// count the slot that it had is valid, but the tag must not poll before its challenge is answered.
TEST_F(AttackTest, ATagThatLostItsNetworkDoesNotPollOnReplayedBeacons) {
  start_network();
  for (const auto& one : chatter) one->talks = false;
  std::size_t tag = 0;
  while (air->id(tag) != 1) ++tag;
  heard.clear();
  air->lost = [tag](const Air::Frame& frame, std::size_t receiver) {
    return receiver == tag && frame.source != Air::kGhost;
  };
  run_superframes(mac::kMapGoodFor - 4.0);
  const std::vector<Air::Frame> missed = heard[kBeacon];
  for (int i = 0; i < 200 && air->station(tag).sync().state() != mac::SyncState::kSearching; ++i)
    run_superframes(1);
  ASSERT_EQ(air->station(tag).sync().state(), mac::SyncState::kSearching);
  for (std::size_t i = 0; i < air->size(); ++i) {
    if (i != tag) air->stop(i);
  }

  heard.clear();
  const double later = air->now() - missed.front().rmarker + duration();
  for (const Air::Frame& frame : missed) air->inject(frame.rmarker + later, frame.x_m, frame.bytes);
  const std::uint32_t beacons = air->counters(tag).beacons_received;
  run_superframes(mac::kMapGoodFor);
  EXPECT_GT(air->counters(tag).beacons_received, beacons + 10);
  EXPECT_GE(heard[kJoin].size(), 1U) << "it sends a challenge";
  EXPECT_TRUE(heard[kPoll].empty());
}

// Replays a whole earlier session to the running network, once as an older session, to which a genuine
// network would yield, and once as a younger one. The replay is in shared slots, where all nodes hear it.
class OldSession : public AttackTest, public ::testing::WithParamInterface<bool> {};

TEST_P(OldSession, ChangesNothingAndCostsHardlyAnyRange) {
  const bool older = GetParam();
  std::vector<Air::Frame> recording;
  on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
    if (parsed.body.index() == kBeacon) recording.push_back(frame);
  };
  start_network();
  if (older) {
    run_superframes(900);
    recording.clear();
  }
  run_superframes(200);
  // A restarted node's challenge puts responses into the recording.
  for (auto& one : chatter) one->talks = false;
  air->stop(5);
  run_superframes(20);
  air->start(5);
  run_superframes(120);
  on_frame = nullptr;
  ASSERT_TRUE(std::any_of(recording.begin(), recording.end(), [](const Air::Frame& frame) {
    const mac::Frame parsed = frame_of(frame.bytes);
    const auto* beacon = std::get_if<mac::Beacon>(&parsed.body);
    return beacon != nullptr && beacon->challenge_response.has_value();
  }));
  const std::uint64_t old_session = air->station(0).election().session();
  for (std::size_t i = 0; i < air->size(); ++i) air->stop(i);
  run_superframes(older ? 20 : 1'500);
  air->start_all();
  run_superframes(80);
  if (!older) run_superframes(1'500);
  ASSERT_TRUE(all_fresh());
  const std::uint64_t session = air->station(0).election().session();
  ASSERT_NE(session, old_session);
  const std::uint32_t number = air->station(0).superframe_number();
  const mac::Frame last = frame_of(recording.back().bytes);
  if (const auto* beacon = std::get_if<mac::Beacon>(&last.body)) {
    ASSERT_EQ(beacon->superframe > number, older);
  }

  constexpr int kSuperframes = 1'000;
  const auto rate_of = [&] {
    const std::size_t before = good_ranges();
    run_superframes(kSuperframes);
    return static_cast<double>(good_ranges() - before) / kSuperframes;
  };
  const double undisturbed = rate_of();
  const std::uint32_t dropped_before = dropped();
  std::size_t next = 0;
  std::vector<std::uint8_t> replayed;
  const double shared = static_cast<double>(
      (air->station(0).superframe().shared() - air->station(0).superframe().beacon()).count());
  on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
    const auto* beacon = std::get_if<mac::Beacon>(&parsed.body);
    if (beacon == nullptr || beacon->hop != 0 || beacon->shared || beacon->superframe % 2 != 0) return;
    const Air::Frame& old = recording[next++ % recording.size()];
    replayed = old.bytes;
    air->inject(frame.rmarker + shared + 64.0, old.x_m, replayed);
    ++ghosts_sent;
  };
  air->spoil = [&](std::size_t receiver, mac::Reception& reception) {
    if (!std::equal(replayed.begin(), replayed.end(), reception.frame.begin(), reception.frame.end())) return;
    const auto destination = frame_of(replayed).destination;
    if (destination == mac::kBroadcast || destination == air->id(receiver)) ++ghosts_heard;
  };
  const double under_attack = rate_of();
  cease();
  EXPECT_GE(ghosts_sent, 490U);
  EXPECT_GE(ghosts_heard, 5 * ghosts_sent) << "six hear it, except one about to send a merge request";
  EXPECT_EQ(dropped() - dropped_before, ghosts_heard);
  EXPECT_TRUE(all_fresh());
  for (std::size_t i = 0; i < air->size(); ++i) EXPECT_EQ(air->station(i).election().session(), session);
  EXPECT_TRUE(air->station(0).election().leads());
  // Master and back-up, two of the four anchors, send merge requests ever less often.
  EXPECT_GT(under_attack, 0.975 * undisturbed);
  expect_full_rate();
}

INSTANTIATE_TEST_SUITE_P(Ages, OldSession, ::testing::Bool(),
                         [](const auto& older) { return older.param ? "Older" : "Younger"; });

// A station that neither polls nor answers.
class SilentStation final : public mac::Station {
 public:
  SilentStation(const mac::Site& site, groma_Counters& counters) : Station(site, counters) {}
  using Station::accept;
  using Station::overhear;
  using Station::transmit;

 private:
  std::optional<Action> slot_action(ClockTime /*now*/) noexcept override {
    end_superframe();
    return std::nullopt;
  }
  [[nodiscard]] mac::Place slot_place() const noexcept override { return {}; }
  Step slot_transmitted(ClockTime timestamp) noexcept override { return plan(timestamp); }
  Step slot_received(const mac::Reception& reception) noexcept override { return plan(reception.timestamp); }
  void forget_exchanges() noexcept override {}
};

// A master accepts a recorded beacon of another session, which it may answer but must not obey, and a genuine
// one before it handles the first.
TEST(KeyedStation, ARecordedBeaconStaysUnverifiedWhateverIsHeardNext) {
  groma_Schedule schedule = schedule_of(2, 4, groma_RangingMethod_METHOD_DS_FINAL);
  schedule.backup_ids_count = 1;
  schedule.backup_ids[0] = 102;
  groma_Counters counters = groma_Counters_init_zero;
  std::uint16_t sessions = 0;
  std::uint32_t nonces = 0;
  mac::SignedPlaces own_places;
  sim::Aes aes;
  const mac::Site site{.id = 101,
                       .network_id = 0x55AA,
                       .phy = dw1000::phy_of(radio::Preamble::k128),
                       .schedule = &schedule,
                       .boot_count = 1,
                       .sessions = &sessions,
                       .network_key = kKey,
                       .cipher = &aes,
                       .nonces = &nonces,
                       .signed_places = &own_places};
  SilentStation station(site, counters);
  Step step = station.start(ClockTime(0));
  for (int i = 0; i < 100 && step.action.kind == Action::Kind::kListenNow; ++i)
    step = station.on_timeout(step.action.until);
  ASSERT_TRUE(station.election().leads());

  const auto signed_bytes = [&](const mac::Beacon& beacon) {
    mac::SignedPlaces signed_places;
    mac::FrameAuthenticator sender(&aes, kKey, &signed_places);
    sender.enter(beacon.session);
    auto bytes = mac::serialize({.network = site.network_id,
                                 .destination = mac::kBroadcast,
                                 .source = 102,
                                 .secured = true,
                                 .body = beacon});
    sign(sender, bytes, beacon, mac::place_of(beacon));
    return bytes;
  };
  mac::Beacon beacon{.superframe = 5'000,
                     .session = std::uint64_t{102} << 48 | 1U << 16,
                     .epoch = schedule.epoch,
                     .schedule_hash = mac::schedule_hash(schedule, 0x55AA, radio::Preamble::k128),
                     .master = 102,
                     .slots = 2};
  const auto recorded_bytes = signed_bytes(beacon);
  beacon.superframe = station.superframe_number();
  beacon.session = station.election().session();
  beacon.master = 101;
  beacon.hop = 1;
  beacon.shared = true;
  const auto genuine_bytes = signed_bytes(beacon);
  const ClockTime shared = station.sync().start(beacon.superframe) + station.superframe().shared();
  const mac::Reception recording{
      .timestamp = shared, .timestamp_valid = true, .frame = recorded_bytes.bytes()};
  const auto recorded = station.accept(recording, {});
  ASSERT_TRUE(recorded.has_value());
  EXPECT_EQ(counters.forged_frames, 1U);
  ASSERT_TRUE(
      station.accept({.timestamp = shared, .timestamp_valid = true, .frame = genuine_bytes.bytes()}, {}));
  EXPECT_EQ(counters.forged_frames, 1U);
  (void)station.overhear(*recorded, recording);
  EXPECT_FALSE(station.election().dissolving()) << "it gives up its session for a recording";
}

// The beacons of a session, and the superframes in which each node (index) sent a JOIN.
struct Recording {
  std::vector<Air::Frame> beacons;
  std::map<std::size_t, std::set<std::uint32_t>> joins;
};

class Nonces : public AttackTest {
 protected:
  void record(Recording& recording) {
    on_frame = [&](const Air::Frame& frame, const mac::Frame& parsed) {
      if (parsed.body.index() == kBeacon) recording.beacons.push_back(frame);
      if (parsed.body.index() == kJoin)
        recording.joins[frame.source].insert(air->station(frame.source).superframe_number());
    };
  }
  // Leads the node back to some of the superframes in which it has sent a JOIN, after `prepare`. Returns in
  // how many it sends one again.
  std::size_t lead_back(std::size_t victim, const Recording& recording,
                        const std::function<void()>& prepare) {
    constexpr int kTrials = 4;
    const auto joins = recording.joins.find(victim);
    if (joins == recording.joins.end()) return 0;
    std::size_t again = 0;
    int trials = 0;
    for (const std::uint32_t number : joins->second) {
      if (++trials > kTrials) break;
      prepare();
      on_frame = [&](const Air::Frame&, const mac::Frame& parsed) {
        const std::uint32_t at = air->station(victim).superframe_number();
        if (parsed.body.index() == kJoin && joins->second.contains(at)) ++again;
      };
      replay_to(victim, recording.beacons, number, 12);
      on_frame = nullptr;
    }
    return again;
  }
};

// A recording of the present session, from before a node was reset, leads it to places in which it has
// signed.
TEST_F(Nonces, ANodeThatWasResetUsesNoneAgain) {
  Recording recording;
  record(recording);
  start_network();
  run_superframes(40);
  on_frame = nullptr;
  std::size_t again = 0;
  for (std::size_t victim = 0; victim < air->size(); ++victim)
    again += lead_back(victim, recording, [&] { air->reset(victim); });
  EXPECT_GE(again, 10U);
  EXPECT_EQ(air->nonces().repeats(), 0U);
  EXPECT_EQ(air->nonces().unsigned_frames(), 0U);
}

// A node hears a recording of a former session, in which it signs challenges, and then one of its own
// session.
TEST_F(Nonces, ARecordingOfAnotherSessionLeadsToNoneOfBefore) {
  Recording former;
  record(former);
  start_network();
  const std::uint64_t session = air->station(0).election().session();
  for (auto& one : chatter) one->talks = false;  // it would mask the challenges
  for (std::size_t i = 0; i < air->size(); ++i) air->stop(i);
  air->reset(0);
  Recording present;
  record(present);
  air->start_all();
  run_superframes(100);
  on_frame = nullptr;
  ASSERT_TRUE(all_fresh());
  ASSERT_NE(air->station(0).election().session(), session);
  std::size_t again = 0;
  for (std::size_t victim = 0; victim < air->size(); ++victim)
    again += lead_back(victim, present, [&] { replay_to(victim, former.beacons, 0, 12); });
  EXPECT_GE(again, 10U);
  EXPECT_EQ(air->nonces().repeats(), 0U);
  EXPECT_EQ(air->nonces().unsigned_frames(), 0U);
  air->start_all();
  run_superframes(100);
  EXPECT_TRUE(all_fresh());
  expect_full_rate();
}

// A recording of a former session takes a node away from its own for a while.
TEST_F(Nonces, ANodeThatComesBackToItsSessionSignsOn) {
  Recording former;
  record(former);
  start_network();
  for (auto& one : chatter) one->talks = false;  // it would mask the challenges
  for (std::size_t i = 0; i < air->size(); ++i) air->stop(i);
  air->start_all();
  on_frame = nullptr;
  run_superframes(100);
  ASSERT_TRUE(all_fresh());
  const std::uint64_t session = air->station(0).election().session();
  for (const std::size_t victim : {std::size_t{1}, std::size_t{2}, std::size_t{4}}) {
    SCOPED_TRACE(air->id(victim));
    // Nobody else hears the recording, or the node.
    air->reach = [=](std::size_t a, std::size_t b) { return (a == victim) == (b == victim); };
    air->lost = [=](const Air::Frame& frame, std::size_t receiver) {
      return frame.source == Air::kGhost && receiver != victim;
    };
    const double later = air->now() - former.beacons.front().rmarker + 4 * duration();
    for (const Air::Frame& frame : former.beacons) {
      if (frame.rmarker + later < air->now() + 30 * duration())
        air->inject(frame.rmarker + later, frame.x_m, frame.bytes);
    }
    air->start(victim);
    run_superframes(30);
    EXPECT_NE(air->station(victim).election().session(), session);
    EXPECT_FALSE(air->station(victim).fresh());
    air->reach = nullptr;
    air->lost = nullptr;
    run_superframes(100);
    EXPECT_EQ(air->station(victim).election().session(), session);
    EXPECT_TRUE(all_fresh());
  }
  EXPECT_EQ(air->nonces().unsigned_frames(), 0U);
  expect_full_rate();
}

// A node that has heard one beacon, which may be recorded.
TEST(KeyedStation, SignsOnlyAChallengeBeforeAReplayIsExcluded) {
  const groma_Schedule schedule = schedule_of(2, 4, groma_RangingMethod_METHOD_DS_FINAL);
  groma_Counters counters = groma_Counters_init_zero;
  std::uint32_t nonces = 0;
  mac::SignedPlaces own_places;
  sim::Aes aes;
  SilentStation station({.id = 1,
                         .network_id = 0x55AA,
                         .phy = dw1000::phy_of(radio::Preamble::k128),
                         .schedule = &schedule,
                         .boot_count = 1,
                         .network_key = kKey,
                         .cipher = &aes,
                         .nonces = &nonces,
                         .signed_places = &own_places},
                        counters);
  EXPECT_EQ(station.start(ClockTime(0)).action.kind, Action::Kind::kListenNow);
  const mac::Beacon beacon{.superframe = 5'000,
                           .session = std::uint64_t{101} << 48 | 1U << 16,
                           .epoch = schedule.epoch,
                           .schedule_hash = mac::schedule_hash(schedule, 0x55AA, radio::Preamble::k128),
                           .master = 101,
                           .slots = 2};
  mac::SignedPlaces places;
  mac::FrameAuthenticator master(&aes, kKey, &places);
  master.enter(beacon.session);
  auto bytes = mac::serialize(
      {.network = 0x55AA, .destination = mac::kBroadcast, .source = 101, .secured = true, .body = beacon});
  sign(master, bytes, beacon, mac::place_of(beacon));
  const mac::Reception reception{
      .timestamp = ClockTime(1'000'000'000), .timestamp_valid = true, .frame = bytes.bytes()};
  (void)station.on_received(reception);
  ASSERT_EQ(station.sync().state(), mac::SyncState::kLocked);
  ASSERT_FALSE(station.fresh());

  const mac::Place place{5'000, mac::Place::kShared};
  const auto code_of = [&](const mac::Body& body, const mac::MergeTarget& target = {}) {
    const auto action = station.transmit(ClockTime(2'000'000'000), mac::kBroadcast, body, place, target);
    station.finish_signing();
    return std::vector<std::uint8_t>(action.frame.end() - mac::kCodeBytes, action.frame.end());
  };
  const std::vector<std::uint8_t> none(mac::kCodeBytes);
  mac::Join join{.origin = 1, .nonce = std::uint64_t{1} << 40, .wants_challenge_response = true};
  EXPECT_NE(code_of(join), none);
  join.wants_challenge_response = false;
  EXPECT_EQ(code_of(join), none);
  EXPECT_EQ(code_of(mac::Data{.origin = 1, .fragments = 1}), none);
  mac::Beacon request = beacon;
  request.shared = request.merge_request = true;
  EXPECT_EQ(code_of(request, {beacon.session + 1, 70}), none);
}

// An open node and a keyed network ignore each other's frames.
TEST_F(AttackTest, AnOpenNodeIgnoresAKeyedNetwork) {
  start_network();
  air->key.reset();
  const std::size_t open = air->add({.id = 2, .x_m = 3.0});
  air->stop(5);
  ASSERT_EQ(air->id(5), 2);
  air->start(open);
  run_superframes(30);
  EXPECT_EQ(air->station(open).sync().state(), mac::SyncState::kSearching);
  EXPECT_GT(air->counters(open).foreign_frames, 20U);
  EXPECT_EQ(air->counters(open).beacons_received, 0U);
}

}  // namespace
}  // namespace groma::testing
