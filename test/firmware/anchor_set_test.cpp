#include "firmware/core/mac/anchor_set.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <set>
#include <vector>

#include "firmware/core/dw1000/receive_quality.hpp"

namespace groma::mac {
namespace {

double uniform(std::mt19937_64& random) {
  return static_cast<double>(random() >> 11) * 0x1p-53;
}

std::vector<std::uint16_t> ids_from(std::uint16_t first, std::size_t count) {
  std::vector<std::uint16_t> ids(count);
  for (std::size_t i = 0; i < count; ++i) ids[i] = static_cast<std::uint16_t>(first + i);
  return ids;
}

std::vector<std::uint16_t> choose(AnchorSet& set, std::size_t places) {
  std::vector<std::uint16_t> out(places);
  out.resize(set.choose(out));
  return out;
}

bool contains(const std::vector<std::uint16_t>& ids, std::uint16_t id) {
  return std::find(ids.begin(), ids.end(), id) != ids.end();
}

// The anchors around a tag: each one's answer probability and link quality.
struct World {
  std::map<std::uint16_t, double> success{};
  std::map<std::uint16_t, std::uint8_t> quality{};
  std::mt19937_64 random{1};

  // Runs one superframe. Returns the polled ids and those that answered.
  std::pair<std::vector<std::uint16_t>, std::set<std::uint16_t>> superframe(AnchorSet& set,
                                                                            std::size_t places) {
    const auto polled = choose(set, places);
    std::set<std::uint16_t> answered;
    for (const std::uint16_t id : polled) {
      if (uniform(random) < success[id]) {
        set.on_answer(id, quality.contains(id) ? quality[id] : 200);
        answered.insert(id);
      } else {
        set.on_silence(id);
      }
    }
    return {polled, answered};
  }
};

// ---- quality ------------------------------------------------------------------------------------------

radio::LinkQuality received(double receive_dbm, double first_path_dbm) {
  // Inverts the formulas of 4.7.1 and 4.7.2 for 120 symbols.
  constexpr double kConstant_db = 121.74;
  const double n2 = 120.0 * 120.0;
  const double first = std::pow(10.0, (first_path_dbm + kConstant_db) / 10.0) * n2;
  const double whole = std::pow(10.0, (receive_dbm + kConstant_db) / 10.0) * n2 / 131072.0;
  const auto amplitude = static_cast<std::uint16_t>(std::lround(std::sqrt(first / 3.0)));
  return dw1000::link_quality({.amplitude1 = amplitude,
                               .amplitude2 = amplitude,
                               .amplitude3 = amplitude,
                               .channel_power = static_cast<std::uint16_t>(std::lround(whole)),
                               .preamble_count = 120});
}

TEST(LinkQuality, GrowsWithPowerAndLineOfSight) {
  EXPECT_GE(link_quality(received(-80.0, -82.0)), 128 + 100);
  EXPECT_LT(link_quality(received(-80.0, -88.0)), 128 + 64);  // 8 dB: LOS uncertain
  EXPECT_GE(link_quality(received(-80.0, -88.0)), 64 + 100);
  EXPECT_LT(link_quality(received(-80.0, -95.0)), 128);  // 15 dB: LOS unlikely
  int before = -1;
  for (double dbm = -98.0; dbm <= -80.0; dbm += 6.0) {
    const int q = link_quality(received(dbm, dbm - 2.0));
    EXPECT_GT(q, before) << dbm;
    before = q;
  }
}

TEST(LinkQuality, IsZeroForEmptyRegistersAndBoundedForAnyOthers) {
  EXPECT_EQ(link_quality({}), 0);
  EXPECT_EQ(link_quality(dw1000::link_quality({.channel_power = 100})), 0);
  EXPECT_EQ(link_quality(dw1000::link_quality({.amplitude1 = 0xFFFF,
                                               .amplitude2 = 0xFFFF,
                                               .amplitude3 = 0xFFFF,
                                               .channel_power = 0xFFFF,
                                               .preamble_count = 1})),
            127 + 128);
}

// ---- against a reference model that keeps all outcomes and sorts --------------------------------------

class Model {
 public:
  struct Anchor {
    std::uint16_t id;
    std::vector<int> outcomes;  // quality, or -1
    int untried = 1023;
    int weight = 100;
    int eager = 0;
    bool chosen = false;
    bool configured = false;
  };

  void add(std::uint16_t id, bool configured = false) {
    anchors.push_back({.id = id, .outcomes = {}, .configured = configured});
  }
  void record_silence(std::uint16_t id) {
    Anchor& a = of(id);
    a.outcomes.push_back(-1);
    const Belief b = belief(a);
    if (a.configured || a.weight != 100 || b.rate != 0 || b.missed != 15) return;
    a = anchors.back();
    anchors.pop_back();
  }
  Anchor& of(std::uint16_t id) {
    return *std::find_if(anchors.begin(), anchors.end(), [=](const Anchor& a) { return a.id == id; });
  }

  static int step(double from, double to, double share) {
    const double way = (to - from) * share;
    return static_cast<int>(from + (way >= 0 ? std::ceil(way) : std::floor(way)));
  }
  struct Belief {
    int rate = 0;
    int quality = 0;
    bool silent = true;
    bool unanswered = true;  // the last outcome was no answer
    int missed = 15;
  };
  // From all outcomes so far.
  static Belief belief(const Anchor& a) {
    Belief b;
    int missed = a.configured ? 15 : 7;
    for (const int outcome : a.outcomes) {
      if (outcome < 0) {
        b.rate = step(b.rate, 0, 1.0 / 16);
        missed = std::min(missed + 1, 15);
      } else {
        b.rate = step(b.rate, 255, 1.0 / 16);
        if (missed >= 7) b.rate = std::max(b.rate, 192);
        b.quality = missed >= 7 ? outcome : step(b.quality, outcome, 1.0 / 8);
        missed = 0;
      }
    }
    b.silent = missed >= 7;
    b.unanswered = missed > 0;
    b.missed = missed;
    return b;
  }

  std::vector<std::uint16_t> choose(std::size_t places) {
    std::vector<std::size_t> useful;
    std::vector<std::size_t> picked;
    std::vector<Belief> beliefs;
    std::size_t eager = 0;
    for (const Anchor& a : anchors) {
      beliefs.push_back(belief(a));
      eager += a.eager > 0 ? 1 : 0;
      if (!beliefs.back().silent && a.weight > 0) useful.push_back(beliefs.size() - 1);
    }
    const auto worth = [&](std::size_t i) {
      const int strength = 128 + beliefs[i].quality / 2;
      const double v = (beliefs[i].rate + 1.0) * strength * anchors[i].weight;
      return anchors[i].chosen ? v + std::floor(v / 4) : v;
    };
    const auto urgency = [&](std::size_t i) {
      const int hope = beliefs[i].unanswered ? 8 + beliefs[i].rate / 32 : 1;
      return (anchors[i].untried + 1.0) * (anchors[i].weight + 1.0) * hope +
             (anchors[i].eager > 0 ? 0x80000000 : 0);
    };
    std::set<std::size_t> in;
    if (anchors.size() <= places) {
      for (std::size_t i = 0; i < anchors.size(); ++i) in.insert(i);
      for (Anchor& a : anchors) a.chosen = true;
    } else {
      const std::size_t price = places >= 3 ? 32 : 128;
      const std::size_t most = places >= 3 ? 2 : 1;
      for (std::size_t i = 0; i < anchors.size(); ++i) {
        if (!anchors[i].chosen) credit += beliefs[i].unanswered ? 5U : 1U;
      }
      std::size_t trials = 0;
      while (trials < most && credit >= price) {
        credit -= price;
        ++trials;
      }
      credit = std::min(credit, price - 1);
      trials = std::max(trials, std::min(eager, most));
      std::vector<std::size_t> ranked;
      std::copy_if(useful.begin(), useful.end(), std::back_inserter(ranked),
                   [&](std::size_t i) { return anchors[i].eager == 0; });
      std::stable_sort(ranked.begin(), ranked.end(),
                       [&](std::size_t a, std::size_t b) { return worth(a) > worth(b); });
      ranked.resize(std::min(ranked.size(), places - trials));
      in.insert(ranked.begin(), ranked.end());
      std::vector<std::size_t> others;
      for (std::size_t i = 0; i < anchors.size(); ++i)
        if (!in.contains(i)) others.push_back(i);
      std::stable_sort(others.begin(), others.end(),
                       [&](std::size_t a, std::size_t b) { return urgency(a) > urgency(b); });
      for (std::size_t i = 0; i < anchors.size(); ++i) anchors[i].chosen = in.contains(i);
      others.resize(places - in.size());
      in.insert(others.begin(), others.end());
    }
    std::vector<std::uint16_t> out;
    for (std::size_t i = 0; i < anchors.size(); ++i) {
      if (in.contains(i)) {
        out.push_back(anchors[i].id);
        anchors[i].untried = 0;
        anchors[i].eager = std::max(anchors[i].eager - 1, 0);
      } else {
        anchors[i].untried = std::min(anchors[i].untried + 1, 1023);
      }
    }
    return out;
  }

  std::vector<Anchor> anchors;
  std::size_t credit = 0;
};

TEST(AnchorSet, ChoosesLikeTheReferenceModel) {
  for (std::uint64_t seed = 1; seed <= 40; ++seed) {
    std::mt19937_64 random(seed);
    const auto configured = static_cast<std::size_t>(1 + random() % 40);
    const std::size_t places = 1 + random() % 16;
    const auto ids = ids_from(100, configured);
    AnchorSet set(ids);
    Model model;
    for (const std::uint16_t id : ids) model.add(id, true);
    std::map<std::uint16_t, double> success;
    for (int superframe = 0; superframe < 300; ++superframe) {
      if (random() % 16 == 0 && model.anchors.size() < 64) {
        const auto id = static_cast<std::uint16_t>(100 + random() % 64);
        ASSERT_TRUE(set.announce(id));
        if (std::none_of(model.anchors.begin(), model.anchors.end(), [=](auto& a) { return a.id == id; })) {
          model.add(id);
        }
        model.of(id).eager = 3;
      }
      if (random() % 16 == 0) {
        const std::uint16_t id = model.anchors[static_cast<std::size_t>(random() % model.anchors.size())].id;
        const auto weight = static_cast<std::uint8_t>(random() % 4 == 0 ? 0 : random());
        set.prefer(id, weight);
        model.of(id).weight = weight;
      }
      if (random() % 8 == 0) {
        Model::Anchor& a = model.anchors[static_cast<std::size_t>(random() % model.anchors.size())];
        set.hear(a.id);
        if (Model::belief(a).silent && a.untried >= 16) a.eager = 1;
      }
      if (superframe % 50 == 0) {
        for (const Model::Anchor& a : model.anchors)
          success[a.id] = random() % 2 == 0 ? 0.0 : uniform(random);
      }
      const auto expected = model.choose(places);
      ASSERT_EQ(choose(set, places), expected) << "seed " << seed << ", superframe " << superframe;
      for (const std::uint16_t id : expected) {
        const bool answers = uniform(random) < success[id];
        const auto quality = static_cast<std::uint8_t>(random());
        if (answers) {
          set.on_answer(id, quality);
          model.of(id).eager = Model::belief(model.of(id)).unanswered && !model.of(id).chosen ? 1 : 0;
        } else {
          set.on_silence(id);
          model.record_silence(id);
          continue;
        }
        model.of(id).outcomes.push_back(quality);
      }
    }
    ASSERT_EQ(set.size(), model.anchors.size());
    for (std::size_t i = 0; i < set.size(); ++i) {
      const Model::Belief belief = Model::belief(model.anchors[i]);
      EXPECT_EQ(set.candidates()[i].rate, belief.rate);
      EXPECT_EQ(set.candidates()[i].quality, belief.quality);
      EXPECT_EQ(set.candidates()[i].silent(), belief.silent);
    }
  }
}

// ---- behaviour ----------------------------------------------------------------------------------------

TEST(AnchorSet, PollsAllAnchorsIfTheyFit) {
  AnchorSet set(ids_from(101, 12));
  World world;
  for (int i = 0; i < 50; ++i) EXPECT_EQ(world.superframe(set, 16).first, ids_from(101, 12));
}

TEST(AnchorSet, TheRateEstimatesTheShareAnswered) {
  AnchorSet set(ids_from(101, 1));
  World world;
  world.success[101] = 0.7;
  double sum = 0.0;
  constexpr int kSuperframes = 4000;
  for (int i = 0; i < kSuperframes; ++i) {
    (void)world.superframe(set, 16);
    if (i >= 100) sum += set.candidates()[0].rate / 255.0;
  }
  EXPECT_NEAR(sum / (kSuperframes - 100), 0.7, 0.03);
}

// If the next POLL closes the exchange, a range needs two POLLs in a row.
TEST(AnchorSet, ARestartedAnchorIsRangedWithinTenSuperframes) {
  for (std::size_t places = 3; places <= 16; ++places) {
    for (std::uint16_t dead = 101; dead <= 116; ++dead) {
      AnchorSet set(ids_from(101, 16));
      World world;
      for (const std::uint16_t id : ids_from(101, 16)) world.success[id] = id == dead ? 0.0 : 1.0;
      // The restarted anchor's link is worse than the others'.
      for (const std::uint16_t id : ids_from(101, 16)) world.quality[id] = id == dead ? 50 : 100;
      for (int i = 0; i < 100 + dead; ++i) (void)world.superframe(set, places);
      world.success[dead] = 1.0;
      bool before = false;
      int ranged = -1;
      for (int i = 1; i <= 10 && ranged < 0; ++i) {
        const bool answered = world.superframe(set, places).second.contains(dead);
        if (answered && before) ranged = i;
        before = answered;
      }
      EXPECT_GT(ranged, 0) << places << " places, anchor " << dead;
    }
  }
}

TEST(AnchorSet, AnAnnouncedAnchorIsPolledNext) {
  AnchorSet set(ids_from(101, 40));
  World world;
  for (const std::uint16_t id : ids_from(101, 40)) world.success[id] = 1.0;
  for (int i = 0; i < 100; ++i) (void)world.superframe(set, 8);
  ASSERT_TRUE(set.announce(900));
  EXPECT_TRUE(contains(choose(set, 8), 900));
  EXPECT_TRUE(contains(choose(set, 8), 900)) << "and again, in case the answer was lost";
}

TEST(AnchorSet, ASilentAnchorCostsOnlyTheTrials) {
  // 16 anchors answer, one is dead: it gets 5 trials in 32 superframes, and the best 15 are always polled.
  AnchorSet set(ids_from(101, 17));
  World world;
  for (const std::uint16_t id : ids_from(101, 16)) world.success[id] = 1.0;
  for (int i = 0; i < 100; ++i) (void)world.superframe(set, 16);
  std::map<std::uint16_t, int> polled;
  for (int i = 0; i < 800; ++i)
    for (const std::uint16_t id : world.superframe(set, 16).first) ++polled[id];
  EXPECT_NEAR(polled[117], 125, 8);
  EXPECT_EQ(std::count_if(polled.begin(), polled.end(), [](const auto& p) { return p.second == 800; }), 15);
}

TEST(AnchorSet, TwelveReachableAnchorsOfThirtyAreAllPolledAtOnceAndAlways) {
  AnchorSet set(ids_from(101, 30));
  World world;
  for (const std::uint16_t id : ids_from(110, 12)) world.success[id] = 1.0;
  for (int i = 0; i < 3; ++i) (void)world.superframe(set, 16);  // 30 candidates, 16 per POLL
  for (int i = 0; i < 300; ++i) EXPECT_EQ(world.superframe(set, 16).second.size(), 12U);
}

TEST(AnchorSet, ThirtyPercentLossRarelyDropsAnAnchor) {
  AnchorSet set(ids_from(101, 30));
  World world;
  for (const std::uint16_t id : ids_from(110, 12)) world.success[id] = 0.49;  // POLL and RESPONSE
  for (int i = 0; i < 50; ++i) (void)world.superframe(set, 16);
  int polls = 0;
  constexpr int kSuperframes = 2000;
  for (int i = 0; i < kSuperframes; ++i) {
    const auto polled = world.superframe(set, 16).first;
    polls += static_cast<int>(
        std::count_if(polled.begin(), polled.end(), [](std::uint16_t id) { return id >= 110 && id < 122; }));
  }
  EXPECT_GT(polls, 0.97 * 12 * kSuperframes);
}

TEST(AnchorSet, SwitchesToTheAnchorsOfANewCell) {
  // 64 anchors, 21 per cell. The robot changes cells between two superframes. The set has one second to
  // adapt, 18 superframes (10 tags, 16 responses).
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    AnchorSet set(ids_from(101, 64));
    World world;
    world.random.seed(seed);
    const auto enter = [&](std::uint16_t first) {
      world.success.clear();
      for (const std::uint16_t id : ids_from(first, 21)) world.success[id] = 0.98;
    };
    enter(101);
    for (int i = 0; i < 100; ++i) (void)world.superframe(set, 16);
    enter(132);
    std::size_t answers = 0;
    int superframes = 0;
    for (; answers < 13 && superframes < 100; ++superframes)
      answers = world.superframe(set, 16).second.size();
    EXPECT_LE(superframes, 18) << seed;
  }
}

TEST(AnchorSet, EachCandidateIsTriedInTurn) {
  AnchorSet set(ids_from(101, 64));
  World world;
  for (const std::uint16_t id : ids_from(101, 20)) world.success[id] = 1.0;
  for (int i = 0; i < 200; ++i) (void)world.superframe(set, 16);
  std::set<std::uint16_t> tried;
  for (int i = 0; i < 24; ++i)
    for (const std::uint16_t id : world.superframe(set, 16).first)
      if (id >= 121) tried.insert(id);
  EXPECT_GE(tried.size(), 42U) << "44 silent anchors, two trials per superframe";
}

TEST(AnchorSet, PrefersReliableAnchorsAndTheHostsHints) {
  AnchorSet set(ids_from(101, 32));
  World world;
  for (const std::uint16_t id : ids_from(101, 32)) {
    world.success[id] = id % 2 == 0 ? 1.0 : 0.5;
    world.quality[id] = 150;
  }
  for (int i = 0; i < 600; ++i) (void)world.superframe(set, 8);
  std::map<std::uint16_t, int> polled;
  for (int i = 0; i < 400; ++i)
    for (const std::uint16_t id : world.superframe(set, 8).first) ++polled[id];
  int even = 0;
  int odd = 0;
  for (const auto& [id, count] : polled) (id % 2 == 0 ? even : odd) += count;
  EXPECT_GT(even, 5 * odd) << "those that answer each time";

  world.success[103] = 0.8;
  set.prefer(103, 255);
  set.prefer(104, 0);
  for (int i = 0; i < 100; ++i) (void)world.superframe(set, 8);
  polled.clear();
  for (int i = 0; i < 400; ++i)
    for (const std::uint16_t id : world.superframe(set, 8).first) ++polled[id];
  EXPECT_GT(polled[103], 380);
  EXPECT_LT(polled[104], 20);
  set.prefer_none();
  EXPECT_EQ(set.candidates()[2].weight, AnchorSet::kNeutralWeight);
}

TEST(AnchorSet, ReplacesSilentGuestsButNotConfiguredAnchors) {
  AnchorSet set(ids_from(101, 62));
  EXPECT_TRUE(set.announce(901));
  EXPECT_TRUE(set.announce(902));
  EXPECT_FALSE(set.announce(903)) << "those two are still to be tried";
  for (int i = 0; i < 60; ++i) {
    for (const std::uint16_t id : choose(set, 16)) {
      if (id == 902) {
        set.on_answer(id, 100);
      } else {
        set.on_silence(id);
      }
    }
  }
  EXPECT_TRUE(set.announce(903));
  EXPECT_EQ(set.size(), 64U);
  std::set<std::uint16_t> ids;
  for (const auto& candidate : set.candidates()) ids.insert(candidate.id);
  EXPECT_EQ(ids.size(), 64U);
  EXPECT_TRUE(ids.contains(903) && ids.contains(902) && !ids.contains(901));
}

TEST(AnchorSet, AnEmptySetPollsNothing) {
  AnchorSet set(ids_from(101, 0));
  EXPECT_TRUE(choose(set, 16).empty());
  EXPECT_EQ(set.answering(), 0U);
  ASSERT_TRUE(set.announce(5));
  EXPECT_EQ(choose(set, 16), std::vector<std::uint16_t>{5});
  EXPECT_TRUE(choose(set, 0).empty());
}

}  // namespace
}  // namespace groma::mac
