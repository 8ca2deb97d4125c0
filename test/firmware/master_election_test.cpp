#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <vector>

#include "firmware/core/mac/coexistence.hpp"
#include "test/firmware/air.hpp"

namespace groma::mac {
namespace {

using ranging::ClockTime;
using ranging::Ticks;
using testing::schedule_of;

constexpr Ticks kDuration = Ticks::from_us(20'000);
constexpr Ticks kGuard = Ticks::from_us(20);
constexpr std::uint32_t kHash = 0xABCD;
constexpr std::uint64_t kSession = 1'000;

groma_Schedule schedule_of_backups(std::size_t backups) {
  groma_Schedule schedule = schedule_of(2, 10, groma_RangingMethod_METHOD_DS_NEXT_POLL);
  schedule.backup_ids_count = static_cast<pb_size_t>(backups);
  for (std::size_t i = 0; i < backups; ++i) schedule.backup_ids[i] = static_cast<std::uint16_t>(102 + i);
  return schedule;
}

ClockTime at_s(double t_s) {
  return ClockTime(std::llround(t_s * 63'897.6e6));
}

// A single node; the test hands it the beacons that it hears.
struct Node {
  explicit Node(std::uint16_t id, std::size_t backups = 3) : schedule(schedule_of_backups(backups)) {
    site.id = id;
    site.schedule = &schedule;
    site.boot_count = 7;
    site.sessions = &sessions;
    election = std::make_unique<MasterElection>(site, kDuration, kGuard);
    coexistence = std::make_unique<Coexistence>(site, *election, kHash);
    coexistence->search(ClockTime(0));
  }
  [[nodiscard]] Beacon beacon(std::uint32_t number, std::uint16_t master = 101, std::uint8_t hop = 0,
                              std::uint8_t age = 0) const {
    return {.superframe = number,
            .session = kSession,
            .epoch = schedule.epoch,
            .schedule_hash = kHash,
            .master = master,
            .hop = hop,
            .age = age,
            .shared = hop != 0};
  }
  Verdict hear(std::uint16_t source, const Beacon& beacon, Ticks ahead = Ticks(0)) {
    return coexistence->judge(source, beacon, ahead, at_s(1.0));
  }
  // Synchronizes by two beacons, the second of superframe `number`.
  void synchronize(std::uint32_t number, std::uint16_t master = 101) {
    EXPECT_EQ(hear(master, beacon(number - 1, master)), Verdict::kAdopt);
    EXPECT_EQ(hear(master, beacon(number, master)), Verdict::kMeasure);
  }
  // Number of silent superframes until it takes over; 1001 if it does not within 1000.
  std::uint32_t silent_until_takeover(std::uint32_t from) {
    for (std::uint32_t n = 1; n <= 1'000; ++n) {
      if (coexistence->begin(from + n) == Duty::kTakeOver) return n;
    }
    return 1'001;
  }
  MasterElection& operator*() { return *election; }
  MasterElection* operator->() { return election.get(); }

  groma_Schedule schedule;
  std::uint16_t sessions = 0;
  Site site{.phy = dw1000::phy_of(radio::Preamble::k128)};
  std::unique_ptr<MasterElection> election;
  std::unique_ptr<Coexistence> coexistence;
};

TEST(MasterElection, ListensFirstAndStartsInOrderOfRank) {
  ClockTime before;
  for (std::uint16_t id = 101; id <= 104; ++id) {
    Node node(id);
    ASSERT_TRUE(node->lead_at());
    EXPECT_GE(*node->lead_at() - before, Ticks::from_us(60'000)) << id;
    before = *node->lead_at();
  }
  EXPECT_EQ(*Node(101)->lead_at(), at_s(0.1)) << "a new site starts quickly";
  EXPECT_FALSE(Node(105)->lead_at()) << "no rank";
  EXPECT_FALSE(Node(1)->lead_at()) << "a tag";
}

TEST(MasterElection, TrafficDelaysTheStartButNotForEver) {
  Node node(101);
  const ClockTime first = *node->lead_at();
  double t_s = 0.0;
  while (at_s(t_s) < *node->lead_at()) {
    node.coexistence->on_traffic(at_s(t_s));
    t_s += 0.01;
    ASSERT_LT(t_s, 10.0);
  }
  EXPECT_GT(at_s(t_s), first + Ticks::from_us(500'000));
}

TEST(MasterElection, EachSessionHasAUniqueId) {
  std::set<std::uint64_t> ids;
  for (const std::uint16_t id : std::vector<std::uint16_t>{101, 102}) {
    for (const std::uint32_t boot : {7U, 8U, 0x10007U}) {
      Node node(id);
      node.site.boot_count = boot;
      for (int i = 0; i < 3; ++i) {
        node.coexistence->found();
        ids.insert(node->session());
        node.coexistence->search(ClockTime(0));
      }
    }
  }
  EXPECT_EQ(ids.size(), 18U);
}

TEST(MasterElection, AKeyedNetworkStartsNoSessionWhoseIdMayHaveBeenUsed) {
  constexpr std::array<std::uint8_t, 16> kKey = {1};
  Node node(101);
  node.site.network_key = kKey;
  node.sessions = 0xFFFE;
  ASSERT_TRUE(node->lead_at());
  node->found();
  EXPECT_EQ(node->session(), 0x65'0000'0007'FFFEU);
  node.coexistence->search(ClockTime(0));
  EXPECT_FALSE(node->lead_at()) << "the count within the boot would wrap";
  node.sessions = 0;
  node.site.boot_count = 0;
  EXPECT_FALSE(node->lead_at()) << "the boot was not counted";
  node.site.boot_count = 7;
  node.site.sessions = nullptr;
  EXPECT_FALSE(node->lead_at()) << "nothing counts the sessions";
  node.site.network_key = {};
  EXPECT_TRUE(node->lead_at()) << "an open network";
}

TEST(MasterElection, BackUpsTakeOverAfterTwelveSuperframesInOrderOfRank) {
  std::uint32_t before = 0;
  for (std::uint16_t id = 102; id <= 104; ++id) {
    Node node(id);
    node.synchronize(100);
    // The other back-ups are alive.
    for (std::uint16_t other = 102; other <= 104; ++other) {
      if (other == id) continue;
      EXPECT_EQ(node.hear(other, node.beacon(100, 101, 1)), Verdict::kKnown);
    }
    const std::uint32_t silent = node.silent_until_takeover(100);
    EXPECT_EQ(silent, 13 + (id - 102) * 6) << id;
    EXPECT_GT(silent, before + 4);
    before = silent;
    EXPECT_TRUE(node->leads());
    EXPECT_EQ(node->session(), kSession);
    EXPECT_EQ(node->hop(), 0);
  }
}

TEST(MasterElection, ABackUpDoesNotWaitForADeadBackUp) {
  Node node(104);
  node.synchronize(100);
  EXPECT_EQ(node.silent_until_takeover(100), 13U);
}

TEST(MasterElection, OnlyABackUpTakesOver) {
  Node node(107);
  node.synchronize(100);
  EXPECT_EQ(node.silent_until_takeover(100), 1'001U);
}

TEST(MasterElection, AnIdleOrphanListensMostOfTheTime) {
  constexpr std::uint32_t kLast = 100;
  constexpr std::uint32_t kOrphaned = 64;
  for (const bool idle : {true, false}) {
    for (const std::uint16_t id : {std::uint16_t{1}, std::uint16_t{103}}) {
      Node node(id);
      node.synchronize(kLast);
      int listening = 0;
      for (std::uint32_t n = 1; n <= MasterElection::kPatience + kOrphaned; ++n) {
        node.coexistence->on_lack(false, idle);
        const bool listens = node.coexistence->begin(kLast + n) == Duty::kLongSilence;
        EXPECT_TRUE(!listens || n > MasterElection::kPatience) << n;
        listening += listens ? 1 : 0;
      }
      // In five of eight superframes; in the others it listens for its own network's beacon.
      const int expected = idle && id == 1 ? kOrphaned * 5 / 8 : 0;
      EXPECT_NEAR(listening, expected, 0.25 * expected) << id << (idle ? ", idle" : "");
    }
  }
}

TEST(MasterElection, ASessionKnownFromOneBeaconIsNotTakenOverAndSoonAbandoned) {
  Node node(102);
  EXPECT_EQ(node.hear(101, node.beacon(100)), Verdict::kAdopt);
  std::uint32_t n = 101;
  for (; n < 200; ++n) {
    EXPECT_NE(node.coexistence->begin(n), Duty::kTakeOver);
    if (node->orphaned_after_one_beacon(n)) break;
  }
  EXPECT_EQ(n, 100 + MasterElection::kPatience + 2 * 4 + 1);
}

TEST(MasterElection, RelaysDoNotKeepADeadMasterAlive) {
  Node a(102);
  Node b(103);
  a.synchronize(100);
  b.synchronize(100);
  std::uint32_t n = 101;
  for (; n < 200 && !a->leads(); ++n) {
    (void)a.coexistence->begin(n);
    (void)b.coexistence->begin(n);
    const auto relayed = [&](Node& node) {
      return node.beacon(n, 101, node->hop(), static_cast<std::uint8_t>(node->age(n)));
    };
    if (a->has_shared_turn(n)) (void)b.hear(102, relayed(a));
    if (b->has_shared_turn(n)) (void)a.hear(103, relayed(b));
    EXPECT_LE(a->hop(), 2);
    EXPECT_LE(b->hop(), 2);
  }
  EXPECT_EQ(n, 114U);
  EXPECT_FALSE(b->leads());
}

TEST(MasterElection, OfTwoMastersOfASessionTheBetterRankWins) {
  Node better(102);
  Node worse(103);
  for (Node* node : {&better, &worse}) {
    node->synchronize(100);
    (void)node->silent_until_takeover(100);
    ASSERT_TRUE((*node)->leads());
  }
  EXPECT_EQ(better.hear(103, better.beacon(140, 103)), Verdict::kIgnore);
  EXPECT_TRUE(better->leads());
  EXPECT_EQ(worse.hear(102, worse.beacon(140, 102)), Verdict::kSwitch);
  EXPECT_FALSE(worse->leads());
  EXPECT_EQ(worse->master(), 102);
  // If their times differ by more than the guard it dissolves, so that its nodes leave it.
  Node far(103);
  far.synchronize(100);
  (void)far.silent_until_takeover(100);
  EXPECT_EQ(far.hear(102, far.beacon(140, 102), 2 * kGuard), Verdict::kIgnore);
  EXPECT_TRUE(far->dissolving());
  EXPECT_TRUE(far.coexistence->on_led(at_s(1.02)));
  EXPECT_EQ(far->role(), Role::kSearching);
}

TEST(MasterElection, AFollowerSwitchesToTheBetterMasterAndIgnoresOldBeacons) {
  Node node(107);
  EXPECT_EQ(node.hear(102, node.beacon(100, 102)), Verdict::kAdopt);
  EXPECT_EQ(node.hear(103, node.beacon(101, 103)), Verdict::kIgnore) << "a worse rank";
  EXPECT_EQ(node.hear(101, node.beacon(60, 101), -40 * kDuration), Verdict::kIgnore) << "outdated";
  EXPECT_EQ(node.hear(104, node.beacon(101, 101, 1, 13)), Verdict::kIgnore) << "relayed too late";
  EXPECT_EQ(node.hear(101, node.beacon(101, 101)), Verdict::kSwitch);
  EXPECT_EQ(node->master(), 101);
  // Once the better master has fallen silent the worse one is accepted.
  EXPECT_EQ(node.hear(103, node.beacon(114, 103)), Verdict::kSwitch);
}

// Exactly one of the two nodes yields, whatever their times.
TEST(MasterElection, OfTwoSessionsOneYieldsAndBothAgreeWhich) {
  std::mt19937_64 random(3);
  const auto uniform = [&](double low, double high) {
    return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
  };
  int by_age = 0;
  for (int i = 0; i < 20'000; ++i) {
    Node a(101);
    Node b(102);
    a.coexistence->found();
    b.coexistence->found();
    const double apart = std::pow(10.0, uniform(-6.0, 6.0)) * (random() % 2 == 0 ? 1.0 : -1.0);
    if (std::abs(std::abs(apart) - 1e-3) < 1e-5) continue;
    const Ticks ahead(std::llround(apart * static_cast<double>(kDuration.count())));
    Beacon of_a = a.beacon(500, 101);
    of_a.session = a->session();
    Beacon of_b = b.beacon(500, 102);
    of_b.session = b->session();
    (void)a.hear(102, of_b, ahead);
    (void)b.hear(101, of_a, -ahead);
    ASSERT_NE(a->dissolving(), b->dissolving()) << apart;
    if (std::abs(apart) > 1e-3) {  // the guard as a fraction of a superframe
      ++by_age;
      ASSERT_EQ(a->dissolving(), apart > 0.0);
    } else {
      ASSERT_TRUE(b->dissolving()) << "the smaller session id wins";
    }
  }
  EXPECT_GT(by_age, 5'000);
}

// Keyed network: a merge request decides as a beacon does in an open network, but dissolves nobody. An
// unverified beacon changes nothing.
TEST(MasterElection, AMergeRequestIsFollowedOrAnsweredAndAnUnverifiedBeaconIsNot) {
  std::mt19937_64 random(4);
  int adopted = 0;
  for (int i = 0; i < 5'000; ++i) {
    Node a(101);
    Node b(102);
    a.coexistence->found();
    b.coexistence->found();
    const auto apart = static_cast<std::int64_t>(random() % 40'000'000) - 20'000'000;
    Beacon of_a = a.beacon(500, 101);
    of_a.session = a->session();
    Beacon of_b = b.beacon(500, 102);
    of_b.session = b->session();
    // One merge request at once, then ever less often.
    EXPECT_EQ(a.coexistence->judge_unverified(102, of_b), Verdict::kRequestMerge);
    EXPECT_EQ(a.coexistence->judge_unverified(102, of_b), Verdict::kIgnore);
    ASSERT_TRUE(a->leads());
    ASSERT_EQ(a->session(), of_a.session);
    const Verdict at_a = a.coexistence->judge_merge_request(102, of_b, Ticks(apart));
    const Verdict at_b = b.coexistence->judge_merge_request(101, of_a, Ticks(-apart));
    const Verdict loses = apart > kGuard.count() ? at_a : at_b;
    ASSERT_EQ(loses, Verdict::kAdopt) << apart;
    ASSERT_EQ(loses == at_a ? at_b : at_a, Verdict::kRequestMerge) << apart;
    ASSERT_NE(a->leads(), b->leads());
    ASSERT_EQ(a->session() == of_a.session, a->leads());
    adopted += at_a == Verdict::kAdopt ? 1 : 0;
  }
  EXPECT_GT(adopted, 2'000);
  // A merge request from the same timeline is ignored; one of the same session that has drifted apart is not.
  Node node(101);
  node.coexistence->found();
  Beacon own = node.beacon(0, 102);
  own.session = node->session();
  EXPECT_EQ(node.coexistence->judge_merge_request(102, own, kGuard), Verdict::kIgnore);
  EXPECT_EQ(node.coexistence->judge_merge_request(102, own, -2 * kGuard), Verdict::kRequestMerge);
  EXPECT_EQ(node.coexistence->judge_merge_request(102, own, 2 * kGuard), Verdict::kAdopt);
  // An unverified beacon of another schedule triggers no merge request.
  own.schedule_hash ^= 1;
  EXPECT_EQ(Node(102).coexistence->judge_unverified(102, own), Verdict::kIgnore);
}

TEST(MasterElection, ANodeDoesNotRejoinADissolvedSession) {
  Node node(105);
  EXPECT_EQ(node.hear(101, node.beacon(100)), Verdict::kAdopt);
  Beacon last = node.beacon(101);
  last.dissolving = true;
  EXPECT_EQ(node.hear(101, last), Verdict::kLeave);
  EXPECT_EQ(node->role(), Role::kSearching);
  EXPECT_EQ(node.hear(103, node.beacon(102, 101, 1, 1)), Verdict::kIgnore);
  Beacon other = node.beacon(5, 102);
  other.session = kSession + 1;
  EXPECT_EQ(node.hear(102, other), Verdict::kAdopt);
}

// A dissolving beacon was forged if its master continues to send beacons.
TEST(MasterElection, AForgedDissolutionIsRefutedByTheMastersNextBeacon) {
  Node node(105);
  node.synchronize(100);
  Beacon last = node.beacon(101);
  last.dissolving = true;
  Beacon far = last;
  far.superframe = 501;
  EXPECT_EQ(node.hear(101, far, 400 * kDuration), Verdict::kIgnore) << "of another superframe";
  Beacon of_other = last;
  of_other.master = 102;
  EXPECT_EQ(node.hear(102, of_other), Verdict::kIgnore) << "not its master's";
  EXPECT_EQ(node.hear(101, last), Verdict::kLeave);
  EXPECT_EQ(node.hear(101, node.beacon(102)), Verdict::kAdopt);
  EXPECT_EQ(node->role(), Role::kFollowing);
}

TEST(MasterElection, ANodeWithTheWrongCountGivesItUp) {
  Node follower(102);
  Beacon wrong = follower.beacon(100 + 4096);
  EXPECT_EQ(follower.hear(101, wrong), Verdict::kAdopt);
  for (std::uint32_t n = 101; n < 103; ++n)
    EXPECT_EQ(follower.hear(101, follower.beacon(n), -4096 * kDuration), Verdict::kIgnore);
  EXPECT_EQ(follower.hear(101, follower.beacon(103), -4096 * kDuration), Verdict::kLeave);
  EXPECT_EQ(follower.hear(101, follower.beacon(104)), Verdict::kAdopt);
  // Occasional wrong ones between right ones change nothing.
  for (std::uint32_t n = 105; n < 125; ++n) {
    EXPECT_EQ(follower.hear(101, follower.beacon(n + 7), 7 * kDuration), Verdict::kIgnore);
    EXPECT_EQ(follower.hear(101, follower.beacon(n)), Verdict::kMeasure);
  }
  // Of two masters of one session the one whose count is behind yields.
  for (const int ahead : {-40, 40}) {
    Node leader(102);
    leader.synchronize(100);
    (void)leader.silent_until_takeover(100);
    for (int i = 0; i < 3; ++i) {
      EXPECT_FALSE(leader->dissolving());
      EXPECT_EQ(leader.hear(101, leader.beacon(150), ahead * kDuration), Verdict::kIgnore);
    }
    EXPECT_EQ(leader->dissolving(), ahead > 0);
  }
}

TEST(MasterElection, ANodeWithAStaleScheduleFallsSilent) {
  const auto with_epoch = [](Node& node, int by) {
    Beacon beacon = node.beacon(100);
    beacon.epoch = static_cast<std::uint32_t>(static_cast<int>(beacon.epoch) + by);
    beacon.schedule_hash ^= 1U;
    return beacon;
  };
  // While searching: a network with a newer schedule keeps every node from starting one. A network with an
  // older schedule keeps only nodes on trial from it, except the master.
  for (const int by : {-1, 1}) {
    for (const std::uint16_t id : std::vector<std::uint16_t>{101, 102}) {
      for (const bool on_trial : {false, true}) {
        Node node(id);
        node.site.on_trial = on_trial;
        const ClockTime before = *node->lead_at();
        const bool waits = by > 0 || (on_trial && id != 101);
        EXPECT_EQ(node.hear(101, with_epoch(node, by)), waits ? Verdict::kStale : Verdict::kRequestMerge);
        EXPECT_GE(*node->lead_at(), waits ? before + Ticks::from_us(2'000'000) : before);
        // Traffic of a network with an older schedule does not delay its start.
        const ClockTime then = *node->lead_at();
        node.coexistence->on_traffic(at_s(0.9));
        if (!waits) {
          EXPECT_EQ(*node->lead_at(), then);
        }
      }
    }
  }
  Node follower(105);
  EXPECT_EQ(follower.hear(101, follower.beacon(100)), Verdict::kAdopt);
  EXPECT_EQ(follower.hear(102, with_epoch(follower, -1)), Verdict::kStale);
  EXPECT_EQ(follower->role(), Role::kFollowing);
  EXPECT_EQ(follower.hear(101, follower.beacon(101)), Verdict::kMeasure);
  EXPECT_EQ(follower.hear(102, with_epoch(follower, -1)), Verdict::kRequestMerge)
      << "a merge request goes to the network with the older schedule";
  // One frame is no evidence, nor are two with different schedules.
  for (const int by : {1, 2, 1}) EXPECT_EQ(follower.hear(102, with_epoch(follower, by)), Verdict::kStale);
  EXPECT_EQ(follower->role(), Role::kFollowing);
  EXPECT_EQ(follower.hear(103, with_epoch(follower, 1)), Verdict::kLeave);
  Node backup(102);
  backup.synchronize(100);
  EXPECT_EQ(backup.hear(103, with_epoch(backup, 1)), Verdict::kStale);
  EXPECT_EQ(backup.hear(103, with_epoch(backup, 1)), Verdict::kLeave);
  EXPECT_GE(*backup->lead_at() - at_s(1.0), Ticks::from_us(2'000'000)) << "starts no session meanwhile";
  Node leader(101);
  leader.coexistence->found();
  EXPECT_EQ(leader.hear(102, with_epoch(leader, -1)), Verdict::kStale);
  EXPECT_FALSE(leader->dissolving());
  EXPECT_EQ(leader.hear(102, with_epoch(leader, 1)), Verdict::kStale);
  EXPECT_FALSE(leader->dissolving());
  EXPECT_EQ(leader.hear(102, with_epoch(leader, 1)), Verdict::kStale);
  EXPECT_TRUE(leader->dissolving());
}

TEST(MasterElection, AContradictoryBeaconIsStale) {
  Node node(105);
  EXPECT_EQ(node.hear(107, node.beacon(100, 101, 1)), Verdict::kStale) << "no relay";
  EXPECT_EQ(node.hear(101, node.beacon(100, 107)), Verdict::kStale) << "no master";
  EXPECT_EQ(node.hear(102, node.beacon(100, 101)), Verdict::kStale) << "hop 0, but not from the master";
  EXPECT_EQ(node.hear(101, node.beacon(100, 101, 1)), Verdict::kStale) << "from the master, but hop 1";
  EXPECT_EQ(node.hear(101, node.beacon(100, 101, 0, 1)), Verdict::kStale) << "from the master, but age 1";
}

// No two nodes share a turn, whichever leads, and each relay has one turn per round.
TEST(MasterElection, NoTwoBeaconersSendInOneSharedSlot) {
  for (std::size_t backups = 0; backups <= 7; ++backups) {
    for (std::size_t leader = 0; leader <= backups; ++leader) {
      std::vector<std::unique_ptr<Node>> nodes;
      const auto leader_id = static_cast<std::uint16_t>(101 + leader);
      for (std::size_t i = 0; i <= backups; ++i) {
        nodes.push_back(std::make_unique<Node>(static_cast<std::uint16_t>(101 + i), backups));
        Node& node = *nodes.back();
        if (i == leader) {
          node.coexistence->found();
        } else {
          (void)node.hear(leader_id, node.beacon(0, leader_id));
        }
      }
      std::vector<int> turns(backups + 1, 0);
      const auto rounds = static_cast<std::uint32_t>(2 * (backups + 1));
      for (std::uint32_t n = 0; n < rounds; ++n) {
        int senders = 0;
        for (std::size_t i = 0; i <= backups; ++i) {
          const auto verdict = (*nodes[i])->leads()
                                   ? Verdict::kIgnore
                                   : nodes[i]->hear(leader_id, nodes[i]->beacon(n, leader_id));
          EXPECT_NE(verdict, Verdict::kStale);
          if (!(*nodes[i])->has_shared_turn(n)) continue;
          ++senders;
          ++turns[i];
        }
        ASSERT_LE(senders, 1) << backups << ' ' << leader << ' ' << n;
        ASSERT_EQ(senders == 0, n % (backups + 1) == 0) << "each slot except the open one has a sender";
      }
      for (std::size_t i = 1; i <= backups; ++i) {
        EXPECT_EQ(turns[i], i == leader ? 1 : 2);
      }
    }
  }
}

TEST(MasterElection, CountsPastTheSuperframeNumbersWrap) {
  Node node(102);
  const std::uint32_t last = 0xFFFF'FFFA;
  EXPECT_EQ(node.hear(101, node.beacon(last)), Verdict::kAdopt);
  for (std::uint32_t i = 1; i < 20; ++i) {
    EXPECT_EQ(node.coexistence->begin(last + i), Duty::kGoOn);
    EXPECT_EQ(node.hear(101, node.beacon(last + i)), Verdict::kMeasure);
  }
  EXPECT_EQ(node->age(last + 19), 0U);
  EXPECT_EQ(node.silent_until_takeover(last + 19), 13U);
}

// ---- many nodes at random --------------------------------------------------------------------------------

// Simulates superframe by superframe: synchronized nodes in reach hear masters and relays. Only searching or
// scanning nodes hear another timeline.
class Crowd {
 public:
  Crowd(std::uint64_t seed, std::size_t backups, std::size_t others) : random_(seed), backups_(backups) {
    for (std::size_t i = 0; i < backups + 1 + others; ++i) add(static_cast<std::uint16_t>(101 + i));
    cut.assign(nodes.size(), 0);
  }

  struct Member {
    std::unique_ptr<Node> node;
    bool on = false;
    bool scans = false;
    bool silent = false;
    double base = 0.0;  // its superframes are `base` ahead of the step's number
  };

  void power(std::size_t i, bool on) {
    Member& member = nodes[i];
    if (on && !member.on) {
      const std::uint16_t id = member.node->site.id;
      ++boots_;
      member.node = std::make_unique<Node>(id, backups_);
      member.node->site.boot_count = boots_;
      member.node->coexistence->search(now());
    }
    member.on = on;
  }

  void step() {
    ++t_;
    const bool several = timelines() > 1;
    for (Member& m : nodes) begin(m, several);
    std::vector<Sent> sent;
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      const Member& m = nodes[i];
      if (m.on && !m.silent && (*m.node)->leads()) sent.push_back({i, beacon_of(m, false)});
    }
    deliver(sent, true);
    for (const Sent& s : sent) (void)nodes[s.source].node->coexistence->on_led(now());
    sent.clear();
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      const Member& m = nodes[i];
      if (m.on && (*m.node)->role() != Role::kSearching && (*m.node)->has_shared_turn(number(m))) {
        sent.push_back({i, beacon_of(m, true)});
      }
    }
    deliver(sent, false);
    std::vector<Sent> merge_requests;
    merge_requests.swap(merge_requests_);
    for (const Sent& s : merge_requests) {
      for (Member& m : nodes) {
        if (m.on && hears(s.source, m)) take(m, s, nodes[s.source].base);
      }
    }
  }

  [[nodiscard]] std::size_t leaders() const {
    return static_cast<std::size_t>(std::count_if(
        nodes.begin(), nodes.end(), [](const Member& m) { return m.on && m.node->election->leads(); }));
  }
  [[nodiscard]] bool one_network() const {
    std::set<std::uint64_t> sessions;
    for (const Member& m : nodes) {
      if (!m.on) continue;
      if (m.node->election->role() == Role::kSearching) return false;
      sessions.insert(m.node->election->session());
    }
    return sessions.size() == 1 && leaders() == 1;
  }
  [[nodiscard]] bool anyone_could_lead() const {
    return std::any_of(nodes.begin(), nodes.end(),
                       [](const Member& m) { return m.on && m.node->election->rank().has_value(); });
  }

  std::vector<Member> nodes;
  std::vector<int> cut;  // nodes with equal values hear each other
  double loss = 0.0;

 private:
  struct Sent {
    std::size_t source;
    Beacon beacon;
  };

  void add(std::uint16_t id) {
    nodes.push_back({});
    nodes.back().node = std::make_unique<Node>(id, backups_);
  }
  [[nodiscard]] ClockTime now() const { return ClockTime(t_ * kDuration.count()); }
  [[nodiscard]] std::uint32_t number(const Member& m) const {
    // Modulo 2^32, also where it is negative.
    return static_cast<std::uint32_t>(
        static_cast<std::int64_t>(std::floor(static_cast<double>(t_) + m.base)));
  }
  double uniform() { return static_cast<double>(random_() >> 11) * 0x1p-53; }
  [[nodiscard]] std::size_t timelines() const {
    std::set<double> bases;
    for (const Member& m : nodes) {
      if (m.on && m.node->election->role() != Role::kSearching) bases.insert(m.base);
    }
    return bases.size();
  }
  bool hears(std::size_t source, const Member& m) {
    const auto i = static_cast<std::size_t>(&m - nodes.data());
    return i != source && cut[i] == cut[source] && uniform() >= loss;
  }

  void begin(Member& m, bool several) {
    if (!m.on) return;
    const MasterElection& election = *m.node->election;
    Coexistence& coexistence = *m.node->coexistence;
    m.scans = m.silent = false;
    if (election.role() == Role::kSearching) {
      const auto lead_at = election.lead_at();
      if (!lead_at || now() < *lead_at) return;
      coexistence.found();
      m.base = -static_cast<double>(t_) - uniform();
      while (number(m) == ~0U) m.base += 1e-3;
      m.base = std::floor(m.base) + uniform() * 0.999 + 1.0;
    }
    if (several) coexistence.suspect();
    // After a hundred superframes without its network its clock is lost.
    if (election.role() == Role::kFollowing && election.age(number(m)) > 100) {
      return coexistence.search(now());
    }
    const Duty duty = coexistence.begin(number(m));
    if (election.orphaned_after_one_beacon(number(m))) return coexistence.search(now());
    m.scans = duty != Duty::kGoOn && duty != Duty::kTakeOver;
    m.silent = duty == Duty::kSilence || duty == Duty::kLongSilence;
  }

  [[nodiscard]] Beacon beacon_of(const Member& m, bool shared) const {
    const MasterElection& election = *m.node->election;
    const std::uint32_t age = election.age(number(m));
    return {.superframe = number(m),
            .session = election.session(),
            .epoch = m.node->schedule.epoch,
            .schedule_hash = kHash,
            .master = election.master(),
            .hop = election.hop(),
            .age = static_cast<std::uint8_t>(std::min<std::uint32_t>(age, 255)),
            .dissolving = election.dissolving(),
            .shared = shared};
  }

  // Simultaneous beacons of one timeline collide.
  void deliver(const std::vector<Sent>& sent, bool in_step_collide) {
    for (Member& m : nodes) {
      if (!m.on) continue;
      const auto i = static_cast<std::size_t>(&m - nodes.data());
      for (const Sent& s : sent) {
        const Member& source = nodes[s.source];
        const bool searching = m.node->election->role() == Role::kSearching;
        if (s.source == i || cut[i] != cut[s.source]) continue;
        if (!searching && !m.scans && source.base != m.base) continue;
        if (in_step_collide && !searching && m.node->election->leads() && source.base == m.base) continue;
        const bool collides = std::any_of(sent.begin(), sent.end(), [&](const Sent& other) {
          return other.source != s.source && cut[other.source] == cut[i] &&
                 nodes[other.source].base == source.base;
        });
        if (collides || uniform() < loss) continue;
        take(m, s, source.base);
      }
    }
  }

  void take(Member& m, const Sent& s, double base) {
    const Ticks ahead(std::llround((base - m.base) * static_cast<double>(kDuration.count())));
    const Verdict verdict = m.node->coexistence->judge(nodes[s.source].node->site.id, s.beacon, ahead, now());
    if (verdict == Verdict::kAdopt || verdict == Verdict::kSwitch) m.base = base;
    if (verdict == Verdict::kRequestMerge && m.node->coexistence->may_request_merge(s.beacon.superframe)) {
      Beacon merge_request = beacon_of(m, true);
      merge_request.merge_request = true;
      merge_requests_.push_back({static_cast<std::size_t>(&m - nodes.data()), merge_request});
    }
  }

  std::mt19937_64 random_;
  std::size_t backups_;
  std::int64_t t_ = 0;
  std::uint32_t boots_ = 100;
  std::vector<Sent> merge_requests_;
};

TEST(MasterElection, RandomFailuresEndInOneNetworkWithOneMaster) {
  int longest = 0;
  for (std::uint64_t seed = 0; seed < 150; ++seed) {
    std::mt19937_64 random(seed);
    const auto backups = static_cast<std::size_t>(random() % 6);
    Crowd crowd(seed + 1'000, backups, 4);
    for (int round = 0; round < 8; ++round) {
      crowd.loss = 0.3 * static_cast<double>(random() % 3) / 2.0;
      for (std::size_t i = 0; i < crowd.nodes.size(); ++i) {
        if (random() % 3 == 0) crowd.power(i, !crowd.nodes[i].on);
        crowd.cut[i] = static_cast<int>(random() % 3);
      }
      const std::uint64_t failures = random() % 200;
      for (std::uint64_t i = 0; i < failures; ++i) crowd.step();
      std::fill(crowd.cut.begin(), crowd.cut.end(), 0);
      crowd.loss = 0.0;
      crowd.power(static_cast<std::size_t>(random() % (backups + 1)), true);
      ASSERT_TRUE(crowd.anyone_could_lead());
      int steps = 0;
      while (steps < 1'000 && !crowd.one_network()) {
        crowd.step();
        ++steps;
      }
      ASSERT_LT(steps, 200) << "seed " << seed << " round " << round;
      longest = std::max(longest, steps);
      // And the network stays one.
      for (int i = 0; i < 50; ++i) crowd.step();
      ASSERT_TRUE(crowd.one_network()) << "seed " << seed << " round " << round;
    }
  }
  RecordProperty("longest", longest);
  EXPECT_GT(longest, 5) << "some rounds needed a merge";
}

}  // namespace
}  // namespace groma::mac
