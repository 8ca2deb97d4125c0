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
class Cells {
 public:
  struct Node {
    std::uint16_t id;
    int cell;
    std::unique_ptr<SlotMap> slots;
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

  explicit Cells(const groma_Schedule& schedule) : schedule_(schedule) {}

  Node& add_tag(std::uint16_t id, int cell = 0) {
    Node& node = add(id, cell);
    node.tag = std::make_unique<TagMembership>(id, schedule_, *node.slots);
    return node;
  }
  Node& add_anchor(std::uint16_t id, int cell = 0) {
    Node& node = add(id, cell);
    node.anchor = std::make_unique<AnchorMembership>(id, schedule_, *node.slots);
    return node;
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
  std::vector<std::uint16_t> owners;  // slot owners in the master's last beacon

 private:
  struct Sending {
    Node* from;
    Body body;
  };

  Node& add(std::uint16_t id, int cell) {
    nodes_.push_back(
        std::make_unique<Node>(Node{.id = id, .cell = cell, .slots = std::make_unique<SlotMap>(schedule_)}));
    return *nodes_.back();
  }

  void superframe() {
    ++number;
    for (const auto& node : nodes_) {
      if (node->id == master && node->on) {
        Beacon beacon{.superframe = number, .session = 1, .master = master, .slots = kMaxTags};
        node->channel().on_beacon_out(beacon, true);
        owners.assign(beacon.owners.begin(), beacon.owners.begin() + beacon.slots);
        deliver({{node.get(), beacon}});
      }
    }
    share();
    poll();
  }

  void share() {
    std::vector<Sending> transmissions;
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
          transmissions.push_back({node.get(), relayed});
        }
      }
      if (!out) continue;
      transmissions.push_back({node.get(), out->body});
      asked.push_back(node.get());
      ++joins;
    }
    for (Node* node : asked) node->channel().on_sent(number, true);
    deliver(transmissions);
  }

  void deliver(const std::vector<Sending>& transmissions) {
    for (const auto& node : nodes_) {
      if (!node->on) continue;
      const Sending* only = nullptr;
      int audible = 0;
      bool sends = false;
      for (const Sending& s : transmissions) {
        sends = sends || s.from == node.get();
        if (std::abs(s.from->cell - node->cell) > 1) continue;
        only = &s;
        ++audible;
      }
      if (audible > 1) ++collisions;
      if (audible != 1 || sends) continue;
      const Frame frame{.source = only->from->id, .body = only->body};
      if (const auto* beacon = std::get_if<Beacon>(&only->body)) {
        if (node->id == master) continue;  // its own, relayed
        node->slots->take(*beacon);
        node->channel().on_beacon(frame, *beacon);
        node->heard = *beacon;
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

bool knows(const Cells::Node& tag, std::uint16_t anchor) {
  const auto candidates = tag.tag->anchors().candidates();
  return std::any_of(candidates.begin(), candidates.end(), [=](const auto& one) { return one.id == anchor; });
}

TEST(Membership, AnUnscheduledTagGetsASlotWithinThreeSuperframes) {
  Cells cells(schedule_with({1}, 3));
  cells.add_anchor(kMaster);
  cells.add_tag(1);
  cells.run(20);
  Cells::Node& guest = cells.add_tag(50);
  EXPECT_LE(cells.until([&] { return guest.tag->slot(cells.number).has_value(); }), 3U);
  EXPECT_EQ(cells.owners, (std::vector<std::uint16_t>{kBroadcast, 50, kNobody}));
  const int joins = cells.joins;
  cells.run(300);
  EXPECT_EQ(cells.joins, joins) << "a tag with a slot asks no more";
  EXPECT_TRUE(guest.tag->slot(cells.number));
}

TEST(Membership, TwoSimultaneousTagsGetTheirSlotsSoon) {
  std::vector<std::uint32_t> superframes;
  for (std::uint16_t id = 200; id < 300; ++id) {
    Cells cells(schedule_with({1}, 3));
    cells.add_anchor(kMaster);
    cells.run(20 + id % 7);
    Cells::Node& a = cells.add_tag(id);
    Cells::Node& b = cells.add_tag(static_cast<std::uint16_t>(id + 1000));
    superframes.push_back(
        cells.until([&] { return a.tag->slot(cells.number) && b.tag->slot(cells.number); }));
    EXPECT_NE(a.tag->slot(cells.number), b.tag->slot(cells.number));
  }
  std::sort(superframes.begin(), superframes.end());
  EXPECT_LE(superframes[50], 7U);
  EXPECT_LE(superframes[95], 16U);
  EXPECT_LT(superframes.back(), 100U);
}

TEST(Membership, AReleasedSlotGoesToAnotherTag) {
  Cells cells(schedule_with({1}, 1));
  cells.add_anchor(kMaster);
  Cells::Node& first = cells.add_tag(1);
  Cells::Node& second = cells.add_tag(50);
  cells.run(200);
  EXPECT_TRUE(first.tag->slot(cells.number));
  EXPECT_FALSE(second.tag->slot(cells.number));
  first.tag->leave();
  EXPECT_FALSE(first.tag->slot(cells.number)) << "silent at once";
  // The waiting tag now asks about every 16 superframes.
  EXPECT_LE(cells.until([&] { return second.tag->slot(cells.number).has_value(); }), 20U);
  cells.run(300);
  EXPECT_FALSE(first.tag->slot(cells.number));
  EXPECT_TRUE(second.tag->slot(cells.number));
}

TEST(Membership, ADeadTagLosesItsSlotAndRejoinsWhenItIsBack) {
  Cells cells(schedule_with({1}, 2));
  cells.add_anchor(kMaster);
  Cells::Node& dead = cells.add_tag(1);
  cells.run(20);
  dead.on = false;
  cells.add_tag(50);
  cells.run(10);
  Cells::Node& late = cells.add_tag(51);
  const std::uint32_t superframes = cells.until([&] { return late.tag->slot(cells.number).has_value(); });
  EXPECT_GT(superframes, kMapGoodFor);
  EXPECT_LE(superframes, kLease + kMapGoodFor + 20);
  EXPECT_EQ(cells.owners, (std::vector<std::uint16_t>{51, 50}));
  late.tag->leave();
  dead.on = true;
  EXPECT_LE(cells.until([&] { return dead.tag->slot(cells.number) == 0U; }), 10U);
}

TEST(Membership, ATagBeyondTheMastersReachJoinsThroughRelays) {
  // Cells in a row, the master in the first; 102 and 103 relay.
  Cells cells(schedule_with({1}, 3, {102, 103}));
  cells.add_anchor(kMaster, 0);
  cells.add_anchor(102, 1);
  cells.add_anchor(103, 2);
  cells.run(30);
  Cells::Node& guest = cells.add_tag(50, 3);
  EXPECT_LE(cells.until([&] { return guest.tag->slot(cells.number).has_value(); }), 20U);
  cells.run(1000);
  EXPECT_TRUE(guest.tag->slot(cells.number)) << "the master never hears it, and nobody else asks";
  Cells::Node& near = cells.add_tag(51, 0);
  EXPECT_LE(cells.until([&] { return near.tag->slot(cells.number).has_value(); }), 5U);
  guest.tag->leave();
  Cells::Node& next = cells.add_tag(52, 0);
  cells.run(30);
  EXPECT_TRUE(next.tag->slot(cells.number));
}

TEST(Membership, ANewMasterContinuesWithTheSlotTable) {
  Cells cells(schedule_with({1}, 3, {102}));
  Cells::Node& old = cells.add_anchor(kMaster);
  cells.add_anchor(102);
  Cells::Node& guest = cells.add_tag(50);
  cells.run(30);
  ASSERT_TRUE(guest.tag->slot(cells.number));
  old.on = false;
  cells.run(13);
  EXPECT_TRUE(guest.tag->slot(cells.number)) << "coasting";
  cells.master = 102;
  for (int i = 0; i < 100; ++i) {
    cells.run(1);
    ASSERT_TRUE(guest.tag->slot(cells.number)) << "no gap";
  }
  Cells::Node& other = cells.add_tag(51);
  EXPECT_LE(cells.until([&] { return other.tag->slot(cells.number).has_value(); }), 5U);
}

TEST(Membership, ATagThatHearsNoBeaconsFallsSilent) {
  Cells cells(schedule_with({1}, 1));
  Cells::Node& master = cells.add_anchor(kMaster);
  Cells::Node& tag = cells.add_tag(1);
  cells.run(20);
  master.on = false;
  cells.run(kMapGoodFor);
  EXPECT_TRUE(tag.tag->slot(cells.number));
  cells.run(1);
  EXPECT_FALSE(tag.tag->slot(cells.number));
  master.on = true;
  cells.run(1);
  EXPECT_TRUE(tag.tag->slot(cells.number));
}

TEST(Membership, AStartingAnchorBecomesKnownToTheTagsInReach) {
  Cells cells(schedule_with({1, 2}, 2));
  cells.add_anchor(kMaster);
  Cells::Node& tag = cells.add_tag(1);
  Cells::Node& far = cells.add_tag(2, 1);
  tag.polls = far.polls = false;  // a poll would keep the anchor from announcing itself
  cells.run(200);
  EXPECT_EQ(cells.joins, 3) << "the master's announcements";
  cells.add_anchor(900, -1);
  EXPECT_LE(cells.until([&] { return knows(tag, 900); }), 8U);
  cells.run(200);
  EXPECT_FALSE(knows(far, 900));
  EXPECT_EQ(cells.joins, 6);
  Cells::Node& late = cells.add_tag(3);
  EXPECT_LE(cells.until([&] { return knows(late, 900); }), 256U + 16U);
}

// In the open slots of a back-up that has just started.
TEST(Membership, ARelayedRequestGoesBeforeAnAnnouncementAndNoneIsForgotten) {
  const auto schedule = schedule_with({1}, 2, {102});
  for (std::uint16_t id = 200; id < 260; ++id) {
    SlotMap slots(schedule);
    groma_Schedule own = schedule;
    own.backup_ids[0] = id;
    AnchorMembership anchor(id, own, slots);
    constexpr std::uint32_t kAsked = 5;  // about when it announces itself
    std::vector<std::uint32_t> relays;
    std::size_t announcements = 0;
    for (std::uint32_t number = 0; number < 200; ++number) {
      const Join request{.origin = 1, .nonce = 9, .tag = true, .wants_slot = true};
      if (number == kAsked) anchor.on_control({.source = 1, .body = request}, number, false);
      const auto out = anchor.open_slot(number);
      if (!out) continue;
      anchor.on_sent(number, true);
      if (std::get<Join>(out->body).origin == id) {
        ++announcements;
      } else {
        relays.push_back(number);
      }
    }
    ASSERT_EQ(relays.size(), 2U) << id;
    EXPECT_LE(relays[0], kAsked + 1) << id;
    EXPECT_EQ(announcements, 3U) << id;
  }
}

TEST(Membership, PolledAnchorsDoNotCrowdTheOpenSlots) {
  Cells cells(schedule_with({1}, 1, {}, 60));
  cells.add_tag(1);
  for (std::uint16_t id = kMaster; id < kMaster + 60; ++id) cells.add_anchor(id);
  cells.run(100);
  EXPECT_EQ(cells.joins, 0) << "all started at once, and were polled at once";
}

}  // namespace
}  // namespace groma::mac
