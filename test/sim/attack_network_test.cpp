// Whole nodes of a keyed network, and a transmitter without the key that replays and forges frames.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <map>
#include <optional>
#include <vector>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/frame_authenticator.hpp"
#include "firmware/sim/aes.hpp"
#include "firmware/sim/dw1000_air_time.hpp"
#include "firmware/sim/transmitter.hpp"
#include "test/sim/site_bench.hpp"
#include "test/support/frames.hpp"

namespace groma::sim {
namespace {

constexpr security::Key kKey = {0x5A, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
constexpr std::uint16_t kAttacker = 900;
enum Kind : std::size_t { kBeacon, kPoll, kResponse, kFinal, kJoin, kData };

SiteSettings keyed() {
  return {.tags = 2, .anchors = 4, .network_key = kKey};
}

struct Heard {
  SimTime rmarker = 0;
  SimTime preamble_start = 0;
  std::uint16_t source = 0;
  mac::Frame frame;
  std::vector<std::uint8_t> bytes;
};

// Records each genuine frame with its bytes as sent.
class Recorder final : public Witness {
 public:
  explicit Recorder(Medium& medium) : medium_(medium) { medium.set_witness(this); }
  void announced(const AirFrame& frame) override {
    if (medium_.id_of(frame.source) == kAttacker) return;
    const std::span<const std::uint8_t> bytes(frame.data.data(), frame.length - 2U);
    const auto parsed = mac::parse(bytes);
    if (!parsed.frame) {
      ++unparsed;
      return;
    }
    frames.push_back({frame.rmarker,
                      frame.preamble_start,
                      medium_.id_of(frame.source),
                      *parsed.frame,
                      {bytes.begin(), bytes.end()}});
  }
  [[nodiscard]] std::size_t count(Kind kind, std::uint16_t source, SimTime from = 0) const {
    return static_cast<std::size_t>(std::count_if(frames.begin(), frames.end(), [=](const Heard& heard) {
      return heard.frame.body.index() == kind && (source == 0 || heard.source == source) &&
             heard.rmarker >= from;
    }));
  }
  [[nodiscard]] const Heard* last(Kind kind, SimTime before = kNever) const {
    const auto found = std::find_if(frames.rbegin(), frames.rend(), [=](const Heard& heard) {
      return heard.frame.body.index() == kind && heard.rmarker < before;
    });
    return found == frames.rend() ? nullptr : &*found;
  }

  std::vector<Heard> frames;
  int unparsed = 0;

 private:
  Medium& medium_;
};

struct Stage {
  explicit Stage(const SiteSettings& settings) : site(settings), recorder(site.network.medium()) {
    site.space.put(kAttacker, {2.0, 2.0, 1.5});
  }
  [[nodiscard]] SimTime duration() const { return site.superframe().duration().count() * kUnitsPerTick; }
  void run_for(SimTime t) { site.run_until(to_seconds(site.network.now() + t)); }
  void refresh_counters() {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_get_counters_tag;
    for (std::size_t i = 0; i < site.network.size(); ++i) (void)site.network.send(i, frame_of(command));
    run_for(20 * kUnitsPerMillisecond);
  }
  // Summed over all nodes, by their last reports.
  [[nodiscard]] std::uint32_t dropped() const {
    std::uint32_t sum = 0;
    for (const Listener& listener : site.listeners)
      sum += listener.counters.forged_frames + listener.counters.unsecured_frames;
    return sum;
  }
  void expect_true_ranges() const {
    site.each_range([&](const groma_SlotReport& report, const groma_Range& range) {
      if (range.status != groma_RangeStatus_RANGE_OK) return;
      const double truth = site.space.distance_m(static_cast<std::uint16_t>(report.tag_id),
                                                 static_cast<std::uint16_t>(range.anchor_id));
      EXPECT_NEAR(static_cast<double>(range.range_m), truth, 0.15);
    });
  }

  SiteBench site;
  Recorder recorder;
};

TEST(KeyedSite, RangesLikeAnOpenSite) {
  Stage stage(keyed());
  stage.site.run_until(4.0);
  stage.refresh_counters();
  const double rate = 8.0 / to_seconds(stage.duration());
  EXPECT_GT(stage.site.good_ranges(2.0), 0.97 * 2.0 * rate);
  stage.expect_true_ranges();
  EXPECT_EQ(stage.dropped(), 0U);
  EXPECT_EQ(stage.recorder.unparsed, 0);
  for (const Heard& heard : stage.recorder.frames) EXPECT_TRUE(heard.frame.secured);
  for (const Listener& listener : stage.site.listeners) {
    EXPECT_EQ(listener.counters.late_transmits, 0U);
    EXPECT_EQ(listener.counters.foreign_frames, 0U);
    EXPECT_EQ(listener.status.state, groma_SyncState_SYNC_LOCKED);
  }
}

// Replayed and forged frames in the shared slot, where nobody else sends.
TEST(KeyedSite, CountsAnAttackersFramesAndKeepsRanging) {
  Stage undisturbed(keyed());
  undisturbed.site.run_until(6.0);
  undisturbed.refresh_counters();

  Stage stage(keyed());
  Transmitter attacker(kAttacker, stage.site.network.medium());
  Aes aes;
  const security::Key another_key{9, 9, 9};
  mac::SignedPlaces signed_places;
  mac::FrameAuthenticator authenticator(&aes, another_key, &signed_places);
  stage.site.run_until(2.0);
  stage.refresh_counters();
  ASSERT_EQ(stage.dropped(), 0U);
  const Heard* const long_ago = stage.recorder.last(kPoll);
  ASSERT_NE(long_ago, nullptr);
  const auto old_frames = stage.recorder.frames;
  const auto shared =
      (stage.site.superframe().shared() - stage.site.superframe().beacon()).count() * kUnitsPerTick;

  std::array<int, 6> sent{};
  std::uint32_t expected = 0;
  int turn = 0;
  std::size_t next_of_old = 0;
  while (stage.site.network.now() < from_seconds(5.5)) {
    const Heard* const beacon = stage.recorder.last(kBeacon);
    ASSERT_NE(beacon, nullptr);
    const Kind kind = static_cast<Kind>(turn % 5);  // no DATA is on the air here
    const Heard* heard = stage.recorder.last(kind);
    ASSERT_NE(heard, nullptr);
    std::vector<std::uint8_t> bytes = heard->bytes;
    switch (turn / 5 % 5) {
      case 0:  // the last one of its kind, of this superframe or the one before
        break;
      case 1:  // one from seconds ago
        while (old_frames[next_of_old % old_frames.size()].frame.body.index() != kind) ++next_of_old;
        bytes = old_frames[next_of_old++ % old_frames.size()].bytes;
        break;
      case 2:
        bytes.back() ^= 1;
        break;
      case 3:
        bytes.resize(bytes.size() - mac::kCodeBytes);
        bytes[mac::kHeaderBytes - 1] &= 0x7F;
        break;
      default: {
        const auto& current = std::get<mac::Beacon>(beacon->frame.body);
        authenticator.enter(current.session);
        auto made = mac::serialize(heard->frame);
        sign(authenticator, made, heard->frame.body, {current.superframe + 1, mac::Place::kShared});
        bytes.assign(made.bytes().begin(), made.bytes().end());
        break;
      }
    }
    // Into the shared slot of the superframe after the next beacon's.
    const SimTime at = beacon->preamble_start + shared + 2 * stage.duration();
    attacker.send(at, bytes);
    const auto parsed = mac::parse(bytes).frame;
    ASSERT_TRUE(parsed.has_value());
    const bool for_one = parsed->destination != mac::kBroadcast;
    expected += for_one ? 1U : 6U;
    ++sent[kind];
    ++turn;
    stage.site.run_until(to_seconds(at + stage.duration() / 2));
  }
  stage.site.run_until(6.0);
  stage.refresh_counters();
  for (const Kind kind : {kBeacon, kPoll, kResponse, kFinal, kJoin}) EXPECT_GT(sent.at(kind), 5);
  EXPECT_EQ(stage.dropped(), expected);
  EXPECT_EQ(stage.site.good_ranges(2.2), undisturbed.site.good_ranges(2.2));
  stage.expect_true_ranges();
}

// Replays frames in place of a genuine node's, which are jammed: none is accepted.
TEST(KeyedSite, AcceptsNoReplayInAGenuineFramesPlace) {
  for (const Kind kind : {kBeacon, kPoll, kResponse, kFinal}) {
    SCOPED_TRACE(kind);
    Stage stage(keyed());
    Transmitter attacker(kAttacker, stage.site.network.medium());
    stage.site.run_until(2.0);
    stage.refresh_counters();
    ASSERT_EQ(stage.dropped(), 0U);
    const std::uint16_t sender = kind == kBeacon ? 101 : kind == kResponse ? 103 : 1;
    const SimTime from = stage.site.network.now() + 2 * stage.duration();
    // An unanswered tag sometimes skips a POLL to listen.
    const int superframes = kind == kPoll ? 12 : 8;
    const SimTime until = from + superframes * stage.duration() - stage.duration() / 10;
    stage.site.network.medium().add_fade(
        {.from = from,
         .until = until,
         .silent = true,
         .hits =
             [=](const AirFrame& frame, std::uint16_t transmitter, std::uint16_t) {
               const auto parsed = mac::parse(std::span(frame.data).first(frame.length - 2U)).frame;
               return transmitter == sender && parsed && parsed->body.index() == kind;
             }},
        stage.site.network.now());
    // The next frame of its kind comes a superframe later.
    std::uint32_t sent = 0;
    std::map<SimTime, bool> done;
    while (stage.site.network.now() < until) {
      std::vector<Heard> due;
      for (const Heard& heard : stage.recorder.frames) {
        const SimTime at = heard.preamble_start + stage.duration();
        if (heard.source != sender || heard.frame.body.index() != kind || done[heard.preamble_start])
          continue;
        if (at < from || at > until || at < stage.site.network.now() + 2 * kUnitsPerMillisecond) continue;
        if (heard.frame.destination != mac::kBroadcast && heard.frame.destination != 1) continue;
        due.push_back(heard);
      }
      for (const Heard& heard : due) {
        done[heard.preamble_start] = true;
        attacker.send(heard.preamble_start + stage.duration() + kUnitsPerMicrosecond, heard.bytes);
        ++sent;
      }
      stage.run_for(stage.duration() / 8);
    }
    const double first_s = to_seconds(from);
    const double last_s = to_seconds(until);
    stage.run_for(2 * stage.duration());
    stage.refresh_counters();
    EXPECT_GE(sent, 6U);
    EXPECT_GE(stage.dropped(), sent);
    stage.expect_true_ranges();
    if (kind == kPoll) {
      // Nobody answers the replayed POLLs of tag 1. A genuine POLL just before may still be answered.
      const SimTime answered = from + stage.duration() / 2;
      const auto answers =
          std::count_if(stage.recorder.frames.begin(), stage.recorder.frames.end(), [&](const Heard& heard) {
            return heard.frame.body.index() == kResponse && heard.frame.destination == 1 &&
                   heard.rmarker > answered && heard.rmarker < until;
          });
      EXPECT_EQ(answers, 0);
    }
    if (kind == kResponse) {
      int good = 0;
      stage.site.each_range(
          [&](const groma_SlotReport& report, const groma_Range& range) {
            good += report.tag_id == 1 && range.anchor_id == 103 && range.status == groma_RangeStatus_RANGE_OK
                        ? 1
                        : 0;
          },
          first_s + 2 * to_seconds(stage.duration()));
      int later = 0;
      stage.site.each_range(
          [&](const groma_SlotReport& report, const groma_Range& range) {
            later +=
                report.tag_id == 1 && range.anchor_id == 103 && range.status == groma_RangeStatus_RANGE_OK
                    ? 1
                    : 0;
          },
          last_s);
      EXPECT_EQ(good, later);
    }
    const double settled_s = to_seconds(stage.site.network.now()) + 10 * to_seconds(stage.duration());
    stage.site.run_until(settled_s + 1.0);
    EXPECT_GT(stage.site.good_ranges(settled_s), 0.95 * 8.0 / to_seconds(stage.duration()));
  }
}

// A node that was switched off and on again, and hears only a recording from a minute ago.
TEST(KeyedSite, ARebootedNodeRejectsARecording) {
  Stage stage(keyed());
  Transmitter attacker(kAttacker, stage.site.network.medium());
  stage.site.run_until(3.0);
  std::vector<Heard> recording;
  for (const Heard& heard : stage.recorder.frames)
    if (heard.rmarker > from_seconds(1.0) && heard.source != 1) recording.push_back(heard);
  for (std::size_t i = 0; i < stage.site.network.size(); ++i) stage.site.network.set_power(i, false);
  stage.site.run_until(60.0);
  stage.recorder.frames.clear();
  const int ranges = stage.site.good_ranges();
  const SimTime later = from_seconds(61.0) - recording.front().preamble_start;
  stage.site.network.set_power(0, true);
  stage.site.run_until(60.9);
  for (const Heard& heard : recording) {
    const SimTime at = heard.preamble_start + later;
    if (at > stage.site.network.now() + 10 * kUnitsPerMillisecond) {
      stage.site.run_until(to_seconds(at - 5 * kUnitsPerMillisecond));
    }
    attacker.send(at, heard.bytes);
  }
  stage.site.run_until(63.2);
  EXPECT_GT(stage.site.listeners[0].counters.beacons_received, 10U);
  EXPECT_GE(stage.recorder.count(kJoin, 1), 2U);
  EXPECT_EQ(stage.recorder.count(kPoll, 1), 0U);
  EXPECT_EQ(stage.site.good_ranges(), ranges);
  // The others are back.
  for (std::size_t i = 1; i < stage.site.network.size(); ++i) stage.site.network.set_power(i, true);
  stage.site.run_until(70.0);
  EXPECT_GT(stage.site.good_ranges(68.0), 0.95 * 2.0 * 8.0 / to_seconds(stage.duration()));
  stage.expect_true_ranges();
}

}  // namespace
}  // namespace groma::sim
