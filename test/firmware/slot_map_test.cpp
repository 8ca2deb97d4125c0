#include "firmware/core/mac/slot_map.hpp"

#include <gtest/gtest.h>

#include <map>
#include <memory>
#include <random>
#include <set>
#include <vector>

namespace groma::mac {
namespace {

using Claim = SlotMap::Claim;

groma_Schedule schedule_of_slots(const std::vector<std::uint16_t>& tags, std::uint32_t slots) {
  groma_Schedule schedule = groma_Schedule_init_zero;
  for (const std::uint16_t tag : tags) schedule.tag_ids[schedule.tag_ids_count++] = tag;
  schedule.slots = slots;
  return schedule;
}

Beacon beacon_of(const SlotMap& table, std::uint32_t superframe, std::uint64_t session = 1) {
  Beacon beacon{.superframe = superframe, .session = session};
  table.fill(beacon);
  return beacon;
}

// The beacon of the master that has this map.
Beacon lead(SlotMap& table, std::uint32_t superframe, std::uint64_t session = 1) {
  Beacon beacon{.superframe = superframe, .session = session};
  table.lead(beacon);
  return beacon;
}

std::vector<std::uint16_t> slot_owners(const SlotMap& table) {
  return {table.owners().begin(), table.owners().end()};
}

using Ids = std::vector<std::uint16_t>;

// ---- the table ----------------------------------------------------------------------------------------

TEST(SlotMap, StartsFromTheSchedule) {
  auto schedule = schedule_of_slots({1, 2, 3}, 5);
  SlotMap table(schedule);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast, kBroadcast, kNobody, kNobody}));
  EXPECT_TRUE(table.may_poll(2, 1));
  EXPECT_FALSE(table.may_poll(2, 0));
  EXPECT_FALSE(table.may_poll(9, 3));
  EXPECT_FALSE(table.may_poll(kNobody, 3)) << "kNobody is not a tag";
  EXPECT_FALSE(table.may_poll(1, 16));

  schedule.tag_slots_count = 3;
  schedule.tag_slots[0] = schedule.tag_slots[1] = 4;
  schedule.tag_slots[2] = 0;
  SlotMap shared(schedule);
  EXPECT_EQ(slot_owners(shared), (Ids{kBroadcast, kNobody, kNobody, kNobody, kBroadcast}));
  EXPECT_TRUE(shared.may_poll(1, 4) && shared.may_poll(2, 4) && shared.may_poll(3, 0));
}

TEST(SlotMap, GrantsAFreeSlotAtOnceAndConfirmsItWhenAskedAgain) {
  const auto schedule = schedule_of_slots({1}, 3);
  SlotMap table(schedule);
  EXPECT_EQ(table.claim(50), Claim::kGranted);
  EXPECT_EQ(table.claim(50), Claim::kHeld);
  EXPECT_EQ(table.claim(1), Claim::kHeld);
  EXPECT_EQ(table.claim(60), Claim::kGranted);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, 50, 60}));
  EXPECT_EQ(table.claim(70), Claim::kWait);
  EXPECT_TRUE(table.may_poll(60, 2));
}

TEST(SlotMap, AReleasedSlotIsGrantedAtOnce) {
  const auto schedule = schedule_of_slots({1}, 2);
  SlotMap table(schedule);
  EXPECT_EQ(table.claim(50), Claim::kGranted);
  table.advance(1);
  table.leave(50);
  EXPECT_EQ(table.claim(60), Claim::kGranted);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, 60}));
  table.leave(1);
  EXPECT_EQ(slot_owners(table), (Ids{kNobody, 60})) << "a scheduled slot too";
  EXPECT_EQ(table.claim(70), Claim::kGranted);
  EXPECT_EQ(table.claim(1), Claim::kWait);
  table.leave(60);
  EXPECT_EQ(table.claim(1), Claim::kGranted) << "another tag owns its slot: it gets the free one";
  EXPECT_EQ(slot_owners(table), (Ids{70, 1}));
}

TEST(SlotMap, ASharedSlotStaysWithTheOthers) {
  auto schedule = schedule_of_slots({1, 2}, 2);
  schedule.tag_slots_count = 2;
  SlotMap table(schedule);
  table.leave(1);
  EXPECT_TRUE(table.may_poll(2, 0));
}

TEST(SlotMap, ASilentTagLosesItsSlotWhichIsGrantedOnlyAfterAPause) {
  const auto schedule = schedule_of_slots({1, 2}, 2);
  SlotMap table(schedule);
  std::uint32_t t = 0;
  const auto step = [&] {
    table.advance(++t);
    table.hear(1, 0);
    if (t <= 10) table.hear(2, 1);
    table.reclaim();
  };
  while (t < 10 + kLease - 1) step();
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast}));
  step();
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kNobody}));
  const std::uint32_t reclaimed_at = t;
  while (table.claim(50) == Claim::kWait) step();
  EXPECT_EQ(t, reclaimed_at + kMapGoodFor + 1);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, 50}));
}

TEST(SlotMap, AReclaimedSlotReturnsToItsOwnerOnRequest) {
  const auto schedule = schedule_of_slots({1, 2}, 3);
  SlotMap table(schedule);
  EXPECT_EQ(table.claim(50), Claim::kGranted);
  table.hear(50, 2);
  table.hear(1, 0);
  for (std::uint32_t t = 1; t <= kLease; ++t) {
    table.advance(t);
    table.hear(2, 1);
  }
  table.reclaim();
  EXPECT_EQ(slot_owners(table), (Ids{kNobody, kBroadcast, kNobody}));
  EXPECT_EQ(table.claim(60), Claim::kWait) << "too early";
  EXPECT_EQ(table.claim(50), Claim::kHeld);
  EXPECT_EQ(table.claim(1), Claim::kHeld);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast, 50}));
}

TEST(SlotMap, AMasterThatHearsNobodyReclaimsNothing) {
  const auto schedule = schedule_of_slots({1, 2}, 2);
  SlotMap table(schedule);
  table.hear(1, 0);
  table.hear(2, 1);
  for (std::uint32_t t = 1; t < 10 * kLease; ++t) {
    table.advance(t);
    table.reclaim();
  }
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast}));
  // Back in reach, hearing one tag does not cost the others their slots.
  table.hear(2, 1);
  table.reclaim();
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast}));
  // From then on silence counts.
  for (std::uint32_t t = 10 * kLease; t < 12 * kLease; ++t) {
    table.advance(t);
    table.hear(2, 1);
    table.reclaim();
  }
  EXPECT_EQ(slot_owners(table), (Ids{kNobody, kBroadcast}));
}

TEST(SlotMap, ATagTheMasterNeverHeardKeepsItsSlotUntilAnotherAsks) {
  const auto schedule = schedule_of_slots({1, 2}, 2);
  SlotMap table(schedule);
  for (std::uint32_t t = 1; t < 1000; ++t) {
    table.advance(t);
    table.hear(1, 0);
    table.reclaim();
  }
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast}));
  EXPECT_EQ(table.claim(50), Claim::kWait);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kNobody}));
  EXPECT_EQ(table.claim(51), Claim::kWait);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kNobody})) << "one at a time";
  EXPECT_EQ(table.claim(2), Claim::kHeld) << "it was only out of the master's reach";
  EXPECT_EQ(table.claim(50), Claim::kWait);
  EXPECT_EQ(slot_owners(table), (Ids{kBroadcast, kBroadcast})) << "and is not reclaimed again for a lease";
}

// Three forged JOINs have filled the table; the scheduled tags find no free slot.
TEST(SlotMap, AClaimantThatNeverPollsSoonLosesItsSlot) {
  const auto schedule = schedule_of_slots({1, 2}, 3);
  SlotMap table(schedule);
  lead(table, 1, 7);
  table.leave(1);
  table.leave(2);
  for (std::uint16_t ghost = 60; ghost < 63; ++ghost) EXPECT_EQ(table.claim(ghost), Claim::kGranted);
  std::uint32_t t = 2;
  for (; t < 200 && !(table.slot_of(1) && table.slot_of(2)); ++t) {
    table.advance(t);
    if (t % 8 == 0) (void)table.claim(1);
    if (t % 8 == 4) (void)table.claim(2);
    table.reclaim();
  }
  EXPECT_LE(t, kFirstLease + kMapGoodFor + 12);
  // A tag that polls keeps its slot, however many others ask.
  SlotMap full(schedule);
  lead(full, 1, 7);
  EXPECT_EQ(full.claim(60), Claim::kGranted);
  for (t = 2; t < 500; ++t) {
    full.advance(t);
    for (const std::uint16_t tag : {std::uint16_t{1}, std::uint16_t{2}, std::uint16_t{60}})
      full.hear(tag, *full.slot_of(tag));
    EXPECT_EQ(full.claim(61), Claim::kWait);
    full.reclaim();
    ASSERT_TRUE(full.may_poll(60, 2));
  }
}

// A slot map from a beacon with a forged count does not outrank the true one.
TEST(SlotMap, AMapFromTheFutureIsReplacedByTheNext) {
  const auto schedule = schedule_of_slots({1}, 2);
  SlotMap map(schedule);
  Beacon beacon{.superframe = 1'000'000, .session = 7, .slots = 2, .owners = {50, kNobody}};
  map.take(beacon);
  EXPECT_FALSE(map.slot_of(1));
  beacon.superframe = 100;
  beacon.owners = {kBroadcast, kNobody};
  map.take(beacon);
  EXPECT_TRUE(map.slot_of(1));
  EXPECT_EQ(map.valid_slot_of(1, 101), std::size_t{0});
}

// A node whose own count was ahead follows the site's again.
TEST(SlotMap, AnAdoptedTimelineReplacesTheFormerCount) {
  const auto schedule = schedule_of_slots({1}, 2);
  SlotMap map(schedule);
  Beacon beacon{.superframe = 200, .session = 7, .slots = 2, .owners = {50, kNobody}};
  map.take(beacon);
  beacon.superframe = 100;
  beacon.owners = {kBroadcast, kNobody};
  map.take(beacon);
  EXPECT_FALSE(map.slot_of(1)) << "an older map";
  map.take(beacon, true);
  EXPECT_EQ(map.valid_slot_of(1, 101), std::size_t{0});
}

TEST(SlotMap, ACopyFollowsTheMastersNewestTable) {
  const auto schedule = schedule_of_slots({1}, 3);
  SlotMap master(schedule);
  SlotMap copy(schedule);
  copy.take(beacon_of(master, 10));
  const Beacon old = beacon_of(master, 10);
  EXPECT_EQ(master.claim(50), Claim::kGranted);
  copy.take(beacon_of(master, 11));
  EXPECT_EQ(slot_owners(copy), slot_owners(master));
  Beacon relayed = old;
  relayed.superframe = 13;
  relayed.age = 3;
  copy.take(relayed);
  EXPECT_EQ(slot_owners(copy), slot_owners(master)) << "of superframe 10";
  Beacon other = old;
  other.session = 2;
  other.superframe = 3;
  copy.take(other);
  EXPECT_EQ(slot_owners(copy), (Ids{kBroadcast, kNobody, kNobody}))
      << "the counts of two sessions do not compare";
}

TEST(SlotMap, ANewMasterContinuesWithItsCopyAndHoldsFreeSlotsBack) {
  const auto schedule = schedule_of_slots({1}, 3);
  SlotMap master(schedule);
  EXPECT_EQ(master.claim(50), Claim::kGranted);
  SlotMap next(schedule);
  next.advance(100);
  next.take(beacon_of(master, 100));
  lead(next, 113);
  EXPECT_EQ(slot_owners(next), (Ids{kBroadcast, 50, kNobody}));
  EXPECT_EQ(next.claim(50), Claim::kHeld);
  next.advance(113 + kMapGoodFor);
  EXPECT_EQ(next.claim(60), Claim::kWait);
  next.advance(113 + kMapGoodFor + 1);
  EXPECT_EQ(next.claim(60), Claim::kGranted);
}

// ---- the tag's side -----------------------------------------------------------------------------------

TEST(SlotMap, IsTheNewestOneHeard) {
  const auto schedule = schedule_of_slots({1, 2}, 3);
  SlotMap map(schedule);
  EXPECT_FALSE(map.valid_slot_of(2, 0));
  EXPECT_FALSE(map.outdated(1'000)) << "it knows nothing yet";
  Beacon beacon{.superframe = 100, .session = 5, .slots = 3};
  beacon.owners = {kBroadcast, kBroadcast, kNobody};
  map.take(beacon);
  EXPECT_EQ(map.valid_slot_of(2, 100), 1U);
  EXPECT_EQ(map.valid_slot_of(2, 100 + kMapGoodFor), 1U);
  EXPECT_FALSE(map.valid_slot_of(2, 101 + kMapGoodFor));
  EXPECT_TRUE(map.slot_of(2));

  Beacon taken = beacon;
  taken.superframe = 110;
  taken.owners[1] = 77;
  map.take(taken);
  EXPECT_FALSE(map.valid_slot_of(2, 110));
  EXPECT_FALSE(map.slot_of(2));
  Beacon relayed = beacon;
  relayed.superframe = 112;
  relayed.age = 3;
  map.take(relayed);
  EXPECT_FALSE(map.valid_slot_of(2, 112));
  relayed.superframe = 120;
  map.take(relayed);
  EXPECT_EQ(map.valid_slot_of(2, 117 + kMapGoodFor), 1U);
  EXPECT_FALSE(map.valid_slot_of(2, 118 + kMapGoodFor)) << "the map is of superframe 117";

  Beacon given = beacon;
  given.superframe = 130;
  given.owners[1] = kNobody;
  given.owners[2] = 2;
  map.take(given);
  EXPECT_EQ(map.valid_slot_of(2, 130), 2U);
}

TEST(SlotMap, AGuestHasOnlyAGrantedSlot) {
  const auto schedule = schedule_of_slots({1}, 2);
  SlotMap map(schedule);
  Beacon beacon{.superframe = 1, .slots = 2};
  beacon.owners = {kBroadcast, kNobody};
  map.take(beacon);
  EXPECT_FALSE(map.slot_of(9));
  beacon.superframe = 0;
  beacon.session = 99;
  beacon.owners[1] = 9;
  map.take(beacon);
  EXPECT_EQ(map.valid_slot_of(9, 0), 1U) << "another session";
}

// ---- never two in one slot ----------------------------------------------------------------------------

struct Player {
  std::uint16_t id;
  std::optional<SlotMap> map{};  // while it is on
  bool heard = false;            // a beacon
  double hears = 1.0;            // share of beacons
  std::uint32_t back_at = 0;
};

struct Head {
  std::unique_ptr<SlotMap> table;
  bool on = true;
  std::uint32_t copied_at = 0;
};

// Masters die and come back; tags join, leave, die, miss beacons or are not heard; relays deliver beacons
// late. No two tags ever poll in one slot.
TEST(Slots, NeverHaveTwoOwners) {
  std::uint64_t polls = 0;
  std::uint64_t moves = 0;
  for (std::uint64_t seed = 1; seed <= 60; ++seed) {
    std::mt19937_64 random(seed);
    const auto chance = [&](double p) { return static_cast<double>(random() >> 11) * 0x1p-53 < p; };
    const auto schedule = schedule_of_slots({1, 2, 3}, 4);
    std::vector<Player> players;
    for (const std::uint16_t id : Ids{1, 2, 3, 50, 51, 52, 53}) players.push_back({.id = id});
    std::vector<Head> heads(3);
    for (Head& head : heads) head.table = std::make_unique<SlotMap>(schedule);
    std::size_t leader = 0;
    std::map<std::size_t, std::uint16_t> last;
    std::vector<Beacon> past;
    for (std::uint32_t t = 1; t < 3000; ++t) {
      for (Head& head : heads) head.table->advance(t);
      // The master dies; another node that heard it recently takes over 13 superframes later.
      if (chance(0.005)) {
        heads[leader].on = false;
        std::size_t next = leader;
        for (std::size_t i = 0; i < heads.size(); ++i) {
          if (i != leader && heads[i].on && t - heads[i].copied_at <= 3) next = i;
        }
        if (next == leader) {
          heads[leader].on = true;
        } else {
          leader = next;
          t += 13;
        }
      }
      SlotMap& table = *heads[leader].table;
      const Beacon beacon = lead(table, t);
      past.push_back(beacon);
      for (std::size_t i = 0; i < heads.size(); ++i) {
        if (i == leader) continue;
        if (!heads[i].on) {
          // A restarted node copies the table from the air before it may lead.
          if (!chance(0.02)) continue;
          heads[i].on = true;
          heads[i].table = std::make_unique<SlotMap>(schedule);
          heads[i].table->take(beacon);
          heads[i].copied_at = t;
        } else if (chance(0.7)) {
          heads[i].table->take(beacon);
          heads[i].copied_at = t;
        }
      }
      std::map<std::size_t, std::uint16_t> owners;
      for (Player& player : players) {
        if (!player.map) {
          if (t > player.back_at && chance(0.02)) {
            player.map.emplace(schedule);
            player.heard = false;
            player.hears = chance(0.4) ? 0.02 : 0.9;
          }
          continue;
        }
        if (chance(player.hears)) {
          player.map->take(beacon);
          player.heard = true;
        }
        if (chance(player.hears / 2)) {  // by a relay, late
          const auto late = static_cast<std::size_t>(random() % std::min<std::size_t>(past.size(), 13));
          Beacon relayed = past[past.size() - 1 - late];
          const std::uint32_t age = t - relayed.superframe;
          relayed.superframe = t;
          relayed.age = static_cast<std::uint8_t>(std::min<std::uint32_t>(age, 255));
          player.map->take(relayed);
          player.heard = true;
        }
        if (const auto slot = player.map->valid_slot_of(player.id, t)) {
          ++polls;
          const auto [other, alone] = owners.emplace(*slot, player.id);
          ASSERT_TRUE(alone) << "seed " << seed << ", superframe " << t << ", slot " << *slot << ": "
                             << other->second << " and " << player.id;
          if (chance(0.5)) {
            for (Head& head : heads) head.table->hear(player.id, *slot);
          }
          if (last[*slot] != player.id) {
            ++moves;
            last[*slot] = player.id;
          }
        } else if (player.heard && !player.map->slot_of(player.id) && chance(0.2)) {
          (void)table.claim(player.id);
        }
        if (chance(0.003)) {
          if (chance(0.5)) table.leave(player.id);  // else it dies, or its JOIN is lost
          player.map.reset();
          player.back_at = t + kMapGoodFor;
        }
      }
    }
  }
  EXPECT_GT(polls, 100'000U);
  EXPECT_GT(moves, 1'000U) << "slots do change owners";
}

}  // namespace
}  // namespace groma::mac
