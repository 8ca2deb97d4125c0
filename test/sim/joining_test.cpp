// Nodes that join and leave a running site: native nodes on the chip model and the medium.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <set>
#include <vector>

#include "test/sim/site_bench.hpp"

namespace groma::sim {
namespace {

constexpr std::uint16_t kMaster = 101;

struct JoiningSettings {
  std::vector<std::uint16_t> tags{1, 2};  // the schedule's
  std::vector<std::uint16_t> anchors{101, 102, 103, 104};
  std::vector<std::uint16_t> backups{};
  std::uint32_t slots = 0;
  std::uint32_t responses = 0;
  groma_RangingMethod method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  double loss = 0.0;
};

// A schedule, and nodes that the test switches on, listed in the schedule or not.
class Yard {
 public:
  explicit Yard(const JoiningSettings& settings)
      : settings_(settings),
        network(space,
                {.timestamp_noise_s = 0.0, .carrier_noise_ppm = 0.0, .loss_probability = settings.loss}, 1) {
    for (const std::uint16_t id : settings.anchors) add(id);
    for (const std::uint16_t id : settings.tags) add(id);
  }

  // Adds a node that is on from now.
  void add(std::uint16_t id, std::uint32_t epoch = 1) {
    const bool tag = id < 100;
    const Place place = place_of(id);
    space.put(id, place);
    NodeSpec spec;
    spec.chip.id = id;
    spec.chip.clock.offset_ppm = std::fmod(id * 0.618034, 1.0) * 40.0 - 20.0;
    spec.chip.clock.first_tick = id * std::uint64_t{0x1234'5678'9A};
    spec.uart.bits_per_s = 2'000'000;
    spec.power_on = from_seconds(now_s + 1e-6 + 1e-3 * static_cast<double>(index_.size() % 5));
    groma_Config config = config_of(id, tag ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR);
    config.schedule.epoch = epoch;
    EXPECT_STREQ(node::fault_of(config), "");
    std::array<std::uint8_t, node::kMaxConfigBytes> blob{};
    const std::size_t size = node::encode_config(config, blob);
    spec.stored_config.assign(blob.begin(), blob.begin() + static_cast<std::ptrdiff_t>(size));
    index_[id] = network.add_native(spec);
    listeners.resize(network.size());
  }
  void set_power(std::uint16_t id, bool on) { network.set_power(index_.at(id), on); }
  void send(std::uint16_t id, const groma_HostToNode& command) {
    network.send(index_.at(id), frame_of(command));
  }

  void run(double seconds) {
    now_s += seconds;
    network.run_until(from_seconds(now_s));
    std::vector<TimedByte> bytes;
    for (std::size_t i = 0; i < network.size(); ++i) {
      bytes.clear();
      network.take(i, bytes);
      listeners[i].take(bytes);
    }
  }
  void run_superframes(double count) { run(count * superframe_s()); }

  [[nodiscard]] double superframe_s() const {
    const groma_Config config = config_of(1, groma_Role_ROLE_TAG);
    const mac::Superframe superframe(config.schedule, dw1000::phy_of(node::radio_settings(config).preamble));
    return seconds_of(superframe);
  }
  [[nodiscard]] const Listener& of(std::uint16_t id) const { return listeners[index_.at(id)]; }

  // Good ranges of a tag with an anchor (0: any) since `from_s`. Each must be correct.
  [[nodiscard]] int good(std::uint16_t tag, std::uint16_t anchor, double from_s) const {
    int count = 0;
    for (const Listener::Report& report : of(tag).reports) {
      if (to_seconds(report.t) < from_s) continue;
      for (pb_size_t k = 0; k < report.body.ranges_count; ++k) {
        const groma_Range& range = report.body.ranges[k];
        if (range.status != groma_RangeStatus_RANGE_OK || (anchor != 0 && range.anchor_id != anchor))
          continue;
        const double truth_m = space.distance_m(tag, static_cast<std::uint16_t>(range.anchor_id));
        EXPECT_NEAR(static_cast<double>(range.range_m), truth_m, 0.02) << tag << " to " << range.anchor_id;
        ++count;
      }
    }
    return count;
  }
  // Superframes until a report of the tag has that many good ranges (with that anchor; 0: any); 1000: never.
  [[nodiscard]] double superframes_until(std::uint16_t tag, int ranges, double from_s,
                                         std::uint16_t anchor = 0) const {
    for (const Listener::Report& report : of(tag).reports) {
      if (to_seconds(report.t) < from_s) continue;
      int count = 0;
      for (pb_size_t k = 0; k < report.body.ranges_count; ++k) {
        const groma_Range& range = report.body.ranges[k];
        if (range.status == groma_RangeStatus_RANGE_OK && (anchor == 0 || range.anchor_id == anchor)) ++count;
      }
      if (count >= ranges) return (to_seconds(report.t) - from_s) / superframe_s();
    }
    return 1000.0;
  }
  // No two tags report the same slot of one superframe.
  void expect_one_owner_per_slot() const {
    std::map<std::pair<std::uint32_t, std::uint32_t>, std::uint32_t> owners;
    for (const Listener& listener : listeners) {
      for (const Listener::Report& report : listener.reports) {
        const auto [owner, alone] =
            owners.emplace(std::pair(report.body.superframe, report.body.slot), report.body.tag_id);
        EXPECT_TRUE(alone || owner->second == report.body.tag_id)
            << "superframe " << report.body.superframe << ", slot " << report.body.slot;
      }
    }
  }

 private:
  JoiningSettings settings_;

  [[nodiscard]] static Place place_of(std::uint16_t id) {
    const double angle = 2.4 * id;
    return id < 100 ? Place{2.0 * std::cos(angle), 2.0 * std::sin(angle), 0.5}
                    : Place{14.0 * std::cos(angle), 9.0 * std::sin(angle), 2.7};
  }

  [[nodiscard]] groma_Config config_of(std::uint16_t id, groma_Role role) const {
    groma_Config config = groma_Config_init_zero;
    config.role = role;
    config.id = id;
    config.network_id = 7;
    config.has_schedule = true;
    config.transmit_antenna_delay_dtu = 16436;
    config.receive_antenna_delay_dtu = 16436;
    groma_Schedule& schedule = config.schedule;
    schedule.epoch = 1;
    schedule.master_id = kMaster;
    for (const std::uint16_t tag : settings_.tags) schedule.tag_ids[schedule.tag_ids_count++] = tag;
    for (const std::uint16_t anchor : settings_.anchors) {
      schedule.anchor_ids[schedule.anchor_ids_count++] = anchor;
    }
    for (const std::uint16_t anchor : settings_.backups) {
      schedule.backup_ids[schedule.backup_ids_count++] = anchor;
    }
    schedule.slots = settings_.slots;
    schedule.responses = settings_.responses;
    schedule.method = settings_.method;
    schedule.turn_round_us = mac::kUsualTurnaround_us;
    schedule.response_gap_us = mac::usual_gap_us(false, false);
    schedule.guard_us = mac::kUsualGuard_us;
    return config;
  }

  std::map<std::uint16_t, std::size_t> index_;

 public:
  double now_s = 0.0;
  FreeSpace space;
  Network network;
  std::vector<Listener> listeners;
};

constexpr double kSettled_s = 1.5;

class Methods : public ::testing::TestWithParam<groma_RangingMethod> {};
INSTANTIATE_TEST_SUITE_P(Joining, Methods,
                         ::testing::Values(groma_RangingMethod_METHOD_DS_FINAL,
                                           groma_RangingMethod_METHOD_DS_NEXT_POLL));

// Synchronization takes a superframe, and the report of an exchange comes one superframe later.
TEST_P(Methods, AnUnscheduledTagHasItsFullRateWithinTenSuperframes) {
  Yard yard({.slots = 4, .method = GetParam()});
  yard.run(kSettled_s);
  const double from_s = yard.now_s;
  yard.add(50);
  yard.run_superframes(10);
  EXPECT_LE(yard.superframes_until(50, 4, from_s), 10.0);
  const double joined_s = yard.now_s;
  yard.run_superframes(100);
  EXPECT_GE(yard.good(50, 0, joined_s), 4 * 98) << "full rate";
  EXPECT_GE(yard.good(1, 0, from_s), 4 * 105) << "at no other tag's cost";
  yard.expect_one_owner_per_slot();
  yard.run(1.1);
  EXPECT_TRUE(yard.of(50).status.has_slot);
  EXPECT_EQ(yard.of(50).status.slot, 2U);
  EXPECT_EQ(yard.of(50).status.candidates, 4U);
  EXPECT_EQ(yard.of(50).status.answering, 4U);
  const groma_NetworkStatus& master = yard.of(kMaster).status;
  ASSERT_EQ(master.holders_count, 4);
  EXPECT_EQ(master.holders[0], 65535);
  EXPECT_EQ(master.holders[2], 50);
  EXPECT_EQ(master.holders[3], 0);
}

TEST(Joining, TwoSimultaneousTagsBothGetASlot) {
  Yard yard({.slots = 4});
  yard.run(kSettled_s);
  const double from_s = yard.now_s;
  yard.add(50);
  yard.add(51);
  yard.run_superframes(25);
  EXPECT_LE(yard.superframes_until(50, 4, from_s), 20.0);
  EXPECT_LE(yard.superframes_until(51, 4, from_s), 20.0);
  yard.expect_one_owner_per_slot();
}

TEST(Joining, AReleasedSlotGoesToTheNextTag) {
  Yard yard({.slots = 2});
  yard.run(kSettled_s);
  yard.add(50);
  yard.run(1.0);
  EXPECT_EQ(yard.good(50, 0, 0.0), 0) << "no slot is free";
  groma_HostToNode leave = groma_HostToNode_init_zero;
  leave.which_body = groma_HostToNode_leave_network_tag;
  const double from_s = yard.now_s;
  yard.send(1, leave);
  yard.run(1.0);
  ASSERT_EQ(yard.of(1).replies.size(), 1U);
  EXPECT_EQ(yard.of(1).replies[0].result, groma_Result_RESULT_OK);
  EXPECT_LE(yard.superframes_until(50, 4, from_s), 24.0) << "by then it asks about every 16 superframes";
  EXPECT_EQ(yard.good(1, 0, from_s + 0.1), 0);
  EXPECT_GT(yard.good(2, 0, from_s + 0.1), 0);
  yard.expect_one_owner_per_slot();
}

TEST(Joining, ADeadTagsSlotGoesToAnotherAndItRejoinsWhenItIsBack) {
  Yard yard({.slots = 3});
  yard.run(kSettled_s);
  yard.add(50);
  yard.run(0.5);
  yard.set_power(1, false);
  yard.run_superframes(70);
  yard.add(51);
  const double from_s = yard.now_s;
  yard.run_superframes(60);
  EXPECT_LE(yard.superframes_until(51, 4, from_s), 50.0) << "the lease is over; the slot stays vacant for 33";
  groma_HostToNode leave = groma_HostToNode_init_zero;
  leave.which_body = groma_HostToNode_leave_network_tag;
  yard.send(50, leave);
  yard.run_superframes(6);
  yard.set_power(1, true);
  const double back_s = yard.now_s;
  yard.run_superframes(15);
  EXPECT_LE(yard.superframes_until(1, 4, back_s), 12.0);
  yard.expect_one_owner_per_slot();
}

TEST(Joining, AnUnscheduledAnchorIsRangedWithinTenSuperframes) {
  Yard yard({.responses = 8});
  yard.run(kSettled_s);
  const double from_s = yard.now_s;
  yard.add(150);
  yard.run_superframes(40);
  for (const std::uint16_t tag : {std::uint16_t{1}, std::uint16_t{2}}) {
    EXPECT_LE(yard.superframes_until(tag, 1, from_s, 150), 12.0) << "10, and the time to synchronize";
  }
  yard.run(1.1);
  EXPECT_EQ(yard.of(1).status.candidates, 5U);
  EXPECT_EQ(yard.of(1).status.answering, 5U);
}

TEST(Joining, AnAnchorThatDiesAndComesBackCostsItsOwnRangesOnly) {
  Yard yard({.anchors = {101, 102, 103, 104, 105, 106}, .responses = 4});
  yard.run(kSettled_s);
  yard.set_power(103, false);
  yard.run_superframes(12);
  double from_s = yard.now_s;
  yard.run_superframes(100);
  EXPECT_GE(yard.good(1, 0, from_s), 4 * 100 * 8 / 10) << "five anchors for four places, less the trials";
  EXPECT_EQ(yard.good(1, 103, from_s), 0);
  from_s = yard.now_s;
  yard.set_power(103, true);
  yard.run_superframes(30);
  EXPECT_LE(yard.superframes_until(1, 1, from_s, 103), 12.0);
}

TEST(Joining, TheTwelveReachableOfThirtyCandidatesAreAlwaysPolled) {
  JoiningSettings settings{.tags = {1}, .anchors = {}, .responses = 16};
  for (std::uint16_t id = 101; id < 131; ++id) settings.anchors.push_back(id);
  Yard yard(settings);
  // 101 to 112 stay; the others are far away.
  for (std::uint16_t id = 113; id < 131; ++id) yard.space.put(id, {500.0, 10.0 * id, 3.0});
  yard.run(kSettled_s);
  const double from_s = yard.now_s;
  yard.run_superframes(100);
  EXPECT_GE(yard.good(1, 0, from_s), 12 * 98);
  yard.run(1.1);
  EXPECT_EQ(yard.of(1).status.candidates, 30U);
  EXPECT_EQ(yard.of(1).status.answering, 12U);
  // The robot is elsewhere: 12 other anchors are in reach.
  const double moved_s = yard.now_s;
  for (std::uint16_t id = 101; id < 131; ++id) {
    yard.space.put(id, id < 118 ? Place{500.0, 10.0 * id, 3.0} : Place{10.0, 0.5 * id - 60.0, 3.0});
  }
  yard.space.put(kMaster, {10.0, 10.0, 3.0});
  yard.run(1.0);
  EXPECT_LE(yard.superframes_until(1, 13, moved_s) * yard.superframe_s(), 1.0);
}

TEST(Joining, AHostsHintPutsAnAnchorIntoThePoll) {
  JoiningSettings settings{.tags = {1}, .anchors = {}, .responses = 4};
  for (std::uint16_t id = 101; id < 113; ++id) settings.anchors.push_back(id);
  Yard yard(settings);
  yard.run(kSettled_s);
  groma_HostToNode hint = groma_HostToNode_init_zero;
  hint.which_body = groma_HostToNode_prefer_anchors_tag;
  groma_AnchorPreference& prefer = hint.body.prefer_anchors;
  for (const std::uint16_t id : {std::uint16_t{110}, std::uint16_t{111}}) {
    prefer.ids[prefer.ids_count++] = id;
    prefer.weights[prefer.weights_count++] = 255;
  }
  yard.send(1, hint);
  yard.run_superframes(60);
  const double from_s = yard.now_s;
  yard.run_superframes(100);
  EXPECT_GT(yard.good(1, 110, from_s), 95);
  EXPECT_GT(yard.good(1, 111, from_s), 95);
  prefer.weights_count = 1;
  yard.send(1, hint);
  yard.run(0.1);
  ASSERT_EQ(yard.of(1).replies.size(), 2U);
  EXPECT_EQ(yard.of(1).replies[0].result, groma_Result_RESULT_OK);
  EXPECT_EQ(yard.of(1).replies[1].result, groma_Result_RESULT_INVALID);
}

TEST(Joining, AGuestKeepsItsSlotOverATakeover) {
  Yard yard({.backups = {102}, .slots = 3});
  yard.run(kSettled_s);
  yard.add(50);
  yard.run(1.0);
  yard.set_power(kMaster, false);
  const double from_s = yard.now_s;
  yard.run_superframes(200);
  EXPECT_GE(yard.good(50, 0, from_s), 3 * 195) << "three anchors are left, and there is no gap";
  const double late_s = yard.now_s;
  yard.add(51);
  yard.run_superframes(60);
  EXPECT_EQ(yard.superframes_until(51, 1, late_s), 1000.0) << "no slot is free";
  yard.expect_one_owner_per_slot();
}

TEST(Joining, ANodeWithAnOldScheduleStaysSilentAndCountsWhatItHears) {
  Yard yard({.slots = 4});
  yard.run(kSettled_s);
  yard.add(50, 0);
  yard.add(150, 0);
  const double from_s = yard.now_s;
  yard.run_superframes(200);
  yard.run(1.1);
  for (const std::uint16_t id : {std::uint16_t{50}, std::uint16_t{150}}) {
    EXPECT_EQ(yard.of(id).counters.frames_sent, 0U) << id;
    EXPECT_GT(yard.of(id).counters.stale_frames, 0U) << id;
    EXPECT_FALSE(yard.of(id).status.has_slot);
  }
  EXPECT_GE(yard.good(1, 0, from_s), 4 * 199) << "nobody is disturbed";
}

TEST(Joining, ATagJoinsAtThirtyPercentLoss) {
  Yard yard({.slots = 4, .loss = 0.3});
  yard.run(kSettled_s);
  const double from_s = yard.now_s;
  yard.add(50);
  yard.run_superframes(100);
  EXPECT_LE(yard.superframes_until(50, 1, from_s), 40.0);
  yard.expect_one_owner_per_slot();
}

}  // namespace
}  // namespace groma::sim
