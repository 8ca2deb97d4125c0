#include "firmware/core/mac/membership.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

namespace groma::mac {
namespace {

constexpr std::uint16_t kMaster = 101;

groma_Schedule schedule_with(const std::vector<std::uint16_t>& tags, std::uint32_t slots,
                             const std::vector<std::uint16_t>& backups = {}, std::uint16_t anchors = 6) {
  groma_Schedule schedule = groma_Schedule_init_zero;
  schedule.master_id = kMaster;
  for (const std::uint16_t tag : tags) schedule.tag_ids[schedule.tag_ids_count++] = tag;
  for (std::uint16_t id = kMaster; id < kMaster + anchors; ++id) {
    schedule.anchor_ids[schedule.anchor_ids_count++] = id;
  }
  for (const std::uint16_t id : backups) schedule.backup_ids[schedule.backup_ids_count++] = id;
  schedule.slots = slots;
  return schedule;
}

// Superframes of beacon and shared slot, without radio and clocks. Nodes hear senders of their own and the
// adjacent cells; simultaneous transmissions collide. Back-ups relay the last beacon that they heard.
class Sea {
 public:
  struct Node {
    std::uint16_t id;
    int cell;
    std::unique_ptr<TagMembership> tag{};
    std::unique_ptr<AnchorMembership> anchor{};
    std::optional<Beacon> heard{};
    bool on = true;
    bool polls = true;

    [[nodiscard]] ControlChannel& channel() const {
      if (tag) return *tag;
      return *anchor;
    }
  };

  explicit Sea(const groma_Schedule& schedule) : schedule_(schedule) {}

  Node& add_tag(std::uint16_t id, int cell = 0) {
    nodes_.push_back(std::make_unique<Node>(Node{.id = id, .cell = cell}));
    nodes_.back()->tag = std::make_unique<TagMembership>(id, schedule_);
    return *nodes_.back();
  }
  Node& add_anchor(std::uint16_t id, int cell = 0) {
    nodes_.push_back(std::make_unique<Node>(Node{.id = id, .cell = cell}));
    nodes_.back()->anchor = std::make_unique<AnchorMembership>(id, schedule_);
    return *nodes_.back();
  }

  void run(std::uint32_t superframes) {
    for (std::uint32_t i = 0; i < superframes; ++i) superframe();
  }
  // Superframes until `holds`, or `most` if it never does.
  std::uint32_t until(const std::function<bool()>& holds, std::uint32_t most = 400) {
    for (std::uint32_t i = 0; i < most; ++i) {
      if (holds()) return i;
      superframe();
    }
    return most;
  }

  std::uint32_t number = 0;
  std::uint16_t master = kMaster;
  int collisions = 0;
  int joins = 0;
  std::vector<std::uint16_t> holders;  // slot owners in the master's last beacon

 private:
  struct Sending {
    Node* from;
    Body body;
  };

  void superframe() {
    ++number;
    for (const auto& node : nodes_) {
      if (node->id == master && node->on) {
        Beacon beacon{.superframe = number, .session = 1, .master = master, .slots = kMaxTags};
        node->channel().on_beacon_out(beacon, true);
        holders.assign(beacon.holders.begin(), beacon.holders.begin() + beacon.slots);
        deliver({{node.get(), beacon}});
      }
    }
    share();
    poll();
  }

  void share() {
    std::vector<Sending> sent;
    const std::uint32_t turn = number % (schedule_.backup_ids_count + 1U);
    std::vector<Node*> asked;
    for (const auto& node : nodes_) {
      if (!node->on || (!node->heard && node->id != master)) continue;
      std::optional<ControlChannel::Outgoing> out;
      if (turn == 0) {
        out = node->channel().open_slot(number);
      } else if (schedule_.backup_ids[turn - 1] == node->id && node->id != master) {
        out = node->channel().own_turn(number);
        if (!out) {
          Beacon relayed = *node->heard;
          relayed.age = static_cast<std::uint8_t>(relayed.age + number - relayed.superframe);
          relayed.superframe = number;
          ++relayed.hop;
          node->channel().on_beacon_out(relayed, false);
          sent.push_back({node.get(), relayed});
        }
      }
      if (!out) continue;
      sent.push_back({node.get(), out->body});
      asked.push_back(node.get());
      ++joins;
    }
    for (Node* node : asked) node->channel().on_sent(number, true);
    deliver(sent);
  }

  void deliver(const std::vector<Sending>& sent) {
    for (const auto& node : nodes_) {
      if (!node->on) continue;
      const Sending* only = nullptr;
      int audible = 0;
      bool sends = false;
      for (const Sending& s : sent) {
        sends = sends || s.from == node.get();
        if (std::abs(s.from->cell - node->cell) > 1) continue;
        only = &s;
        ++audible;
      }
      if (audible > 1) ++collisions;
      if (audible != 1 || sends) continue;
      const Frame frame{.source = only->from->id, .body = only->body};
      if (const auto* beacon = std::get_if<Beacon>(&only->body)) {
        node->channel().on_beacon(frame, *beacon);
        if (node->id != master) node->heard = *beacon;
      } else {
        node->channel().on_control(frame, number, node->id == master);
      }
    }
  }

  void poll() {
    for (const auto& node : nodes_) {
      if (!node->tag || !node->on || !node->polls) continue;
      const auto slot = node->tag->slot(number);
      if (!slot) continue;
      for (const auto& other : nodes_) {
        if (other->anchor && other->on && std::abs(other->cell - node->cell) <= 1) {
          other->anchor->on_poll(node->id, *slot, true);
        }
      }
    }
  }

  groma_Schedule schedule_;
  std::vector<std::unique_ptr<Node>> nodes_;
};

bool knows(const Sea::Node& tag, std::uint16_t anchor) {
  for (std::size_t i = 0; i < tag.tag->anchors().size(); ++i) {
    if (tag.tag->anchors().at(i).id == anchor) return true;
  }
  return false;
}

TEST(Membership, ATagThatTheScheduleDoesNotNameHasASlotWithinThreeSuperframes) {
  Sea sea(schedule_with({1}, 3));
  sea.add_anchor(kMaster);
  sea.add_tag(1);
  sea.run(20);
  Sea::Node& guest = sea.add_tag(50);
  EXPECT_LE(sea.until([&] { return guest.tag->slot(sea.number).has_value(); }), 3U);
  EXPECT_EQ(sea.holders, (std::vector<std::uint16_t>{kBroadcast, 50, kNobody}));
  const int joins = sea.joins;
  sea.run(300);
  EXPECT_EQ(sea.joins, joins) << "who has a slot asks no more";
  EXPECT_TRUE(guest.tag->slot(sea.number));
}

TEST(Membership, TwoAtOnceHaveTheirSlotsSoon) {
  std::vector<std::uint32_t> took;
  for (std::uint16_t id = 200; id < 300; ++id) {
    Sea sea(schedule_with({1}, 3));
    sea.add_anchor(kMaster);
    sea.run(20 + id % 7);
    Sea::Node& a = sea.add_tag(id);
    Sea::Node& b = sea.add_tag(static_cast<std::uint16_t>(id + 1000));
    took.push_back(sea.until([&] { return a.tag->slot(sea.number) && b.tag->slot(sea.number); }));
    EXPECT_NE(a.tag->slot(sea.number), b.tag->slot(sea.number));
  }
  std::sort(took.begin(), took.end());
  EXPECT_LE(took[50], 7U);
  EXPECT_LE(took[95], 16U);
  EXPECT_LT(took.back(), 100U);
}

TEST(Membership, ASlotThatATagLeavesServesAnother) {
  Sea sea(schedule_with({1}, 1));
  sea.add_anchor(kMaster);
  Sea::Node& first = sea.add_tag(1);
  Sea::Node& second = sea.add_tag(50);
  sea.run(200);
  EXPECT_TRUE(first.tag->slot(sea.number));
  EXPECT_FALSE(second.tag->slot(sea.number));
  first.tag->leave();
  EXPECT_FALSE(first.tag->slot(sea.number)) << "silent at once";
  // The waiting tag now asks about every 16 superframes.
  EXPECT_LE(sea.until([&] { return second.tag->slot(sea.number).has_value(); }), 20U);
  sea.run(300);
  EXPECT_FALSE(first.tag->slot(sea.number));
  EXPECT_TRUE(second.tag->slot(sea.number));
}

TEST(Membership, ATagThatDiesLosesItsSlotAndAConfiguredOneJoinsAnewWhenItIsBack) {
  Sea sea(schedule_with({1}, 2));
  sea.add_anchor(kMaster);
  Sea::Node& dead = sea.add_tag(1);
  sea.run(20);
  dead.on = false;
  sea.add_tag(50);
  sea.run(10);
  Sea::Node& late = sea.add_tag(51);
  const std::uint32_t took = sea.until([&] { return late.tag->slot(sea.number).has_value(); });
  EXPECT_GT(took, kTableGoodFor);
  EXPECT_LE(took, kLease + kTableGoodFor + 20);
  EXPECT_EQ(sea.holders, (std::vector<std::uint16_t>{51, 50}));
  late.tag->leave();
  dead.on = true;
  EXPECT_LE(sea.until([&] { return dead.tag->slot(sea.number) == 0U; }), 10U);
}

TEST(Membership, ATagBeyondTheMastersReachJoinsOverRelays) {
  // Cells in a row, the master in the first; 102 and 103 relay.
  Sea sea(schedule_with({1}, 3, {102, 103}));
  sea.add_anchor(kMaster, 0);
  sea.add_anchor(102, 1);
  sea.add_anchor(103, 2);
  sea.run(30);
  Sea::Node& guest = sea.add_tag(50, 3);
  EXPECT_LE(sea.until([&] { return guest.tag->slot(sea.number).has_value(); }), 20U);
  sea.run(1000);
  EXPECT_TRUE(guest.tag->slot(sea.number)) << "the master never hears it, and nobody else asks";
  Sea::Node& near = sea.add_tag(51, 0);
  EXPECT_LE(sea.until([&] { return near.tag->slot(sea.number).has_value(); }), 5U);
  guest.tag->leave();
  Sea::Node& next = sea.add_tag(52, 0);
  sea.run(30);
  EXPECT_TRUE(next.tag->slot(sea.number));
}

TEST(Membership, ANewMasterGoesOnWithTheTable) {
  Sea sea(schedule_with({1}, 3, {102}));
  Sea::Node& old = sea.add_anchor(kMaster);
  sea.add_anchor(102);
  Sea::Node& guest = sea.add_tag(50);
  sea.run(30);
  ASSERT_TRUE(guest.tag->slot(sea.number));
  old.on = false;
  sea.run(13);
  EXPECT_TRUE(guest.tag->slot(sea.number)) << "coasting";
  sea.master = 102;
  for (int i = 0; i < 100; ++i) {
    sea.run(1);
    ASSERT_TRUE(guest.tag->slot(sea.number)) << "no gap";
  }
  Sea::Node& other = sea.add_tag(51);
  EXPECT_LE(sea.until([&] { return other.tag->slot(sea.number).has_value(); }), 5U);
}

TEST(Membership, ATagThatHearsNoBeaconsFallsSilent) {
  Sea sea(schedule_with({1}, 1));
  Sea::Node& master = sea.add_anchor(kMaster);
  Sea::Node& tag = sea.add_tag(1);
  sea.run(20);
  master.on = false;
  sea.run(kTableGoodFor);
  EXPECT_TRUE(tag.tag->slot(sea.number));
  sea.run(1);
  EXPECT_FALSE(tag.tag->slot(sea.number));
  master.on = true;
  sea.run(1);
  EXPECT_TRUE(tag.tag->slot(sea.number));
}

TEST(Membership, AnAnchorThatStartsIsKnownToTheTagsInReach) {
  Sea sea(schedule_with({1, 2}, 2));
  sea.add_anchor(kMaster);
  Sea::Node& tag = sea.add_tag(1);
  Sea::Node& far = sea.add_tag(2, 1);
  tag.polls = far.polls = false;  // a poll would keep the anchor from announcing itself
  sea.run(200);
  EXPECT_EQ(sea.joins, 3) << "the master's";
  sea.add_anchor(900, -1);
  EXPECT_LE(sea.until([&] { return knows(tag, 900); }), 8U);
  sea.run(200);
  EXPECT_FALSE(knows(far, 900));
  EXPECT_EQ(sea.joins, 6);
  Sea::Node& late = sea.add_tag(3);
  EXPECT_LE(sea.until([&] { return knows(late, 900); }), 256U + 16U);
}

TEST(Membership, AnchorsThatArePolledDoNotCrowdTheOpenSlots) {
  Sea sea(schedule_with({1}, 1, {}, 60));
  sea.add_tag(1);
  for (std::uint16_t id = kMaster; id < kMaster + 60; ++id) sea.add_anchor(id);
  sea.run(100);
  EXPECT_EQ(sea.joins, 0) << "all started at once, and were polled at once";
}

}  // namespace
}  // namespace groma::mac
