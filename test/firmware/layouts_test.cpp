// Multi-hop networks whose nodes fail and restart at random: lines, rings, stars and trees of beaconers, with
// tags and anchors that each hear one beaconer. Soon after the last change each connected component is one
// network with one master.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <map>
#include <numeric>
#include <random>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "test/firmware/air.hpp"

namespace groma::testing {
namespace {

using mac::SyncState;

enum class Shape : std::uint8_t { kLine, kRing, kStar, kTree };

const char* name_of(Shape shape) {
  constexpr std::array<const char*, 4> kNames{"line", "ring", "star", "tree"};
  return kNames[static_cast<std::size_t>(shape)];
}

using Edges = std::vector<std::pair<std::size_t, std::size_t>>;

Edges edges_of(Shape shape) {
  switch (shape) {
    case Shape::kLine:
      return {{0, 1}, {1, 2}, {2, 3}};
    case Shape::kRing:
      return {{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {5, 6}, {6, 0}};
    case Shape::kStar:
      return {{0, 1}, {0, 2}, {0, 3}, {0, 4}, {0, 5}};
    case Shape::kTree:
      return {{0, 1}, {0, 2}, {1, 3}, {1, 4}, {2, 5}, {2, 6}};
  }
  return {};
}

std::size_t beaconers_of(Shape shape) {
  constexpr std::array<std::size_t, 4> kCounts{4, 7, 6, 7};
  return kCounts[static_cast<std::size_t>(shape)];
}

constexpr std::size_t kTags = 3;

groma_Schedule schedule_of_shape(Shape shape) {
  const std::size_t beaconers = beaconers_of(shape);
  groma_Schedule schedule =
      schedule_of(kTags, beaconers + 2, groma_RangingMethod_METHOD_DS_NEXT_POLL, 300, 150);
  schedule.backup_ids_count = static_cast<pb_size_t>(beaconers - 1);
  for (std::size_t i = 1; i < beaconers; ++i)
    schedule.backup_ids[i - 1] = static_cast<std::uint16_t>(101 + i);
  return schedule;
}

class Layout {
 public:
  Layout(Shape shape, std::uint64_t seed)
      : beaconers_(beaconers_of(shape)),
        schedule_(schedule_of_shape(shape)),
        random_(seed),
        air(schedule_, radio::Preamble::k128) {
    const mac::Superframe superframe(schedule_, dw1000::phy_of(radio::Preamble::k128));
    superframe_s = static_cast<double>(superframe.duration().count()) / kTicksPerSecond;
    air.add_all(60.0, 20.0, seed);
    // The rank at each position is random, and so is the beaconer that a leaf hears.
    std::vector<std::size_t> at(beaconers_);
    std::iota(at.begin(), at.end(), std::size_t{0});
    for (std::size_t i = beaconers_ - 1; i > 0; --i) std::swap(at[i], at[random_below(i + 1)]);
    for (const auto& [a, b] : edges_of(shape)) join(at[a], at[b]);
    for (std::size_t i = beaconers_; i < air.size(); ++i) join(i, random_below(beaconers_));
    on.assign(air.size(), false);
    air.reach = [this](std::size_t a, std::size_t b) { return edges_.contains({a, b}); };
  }

  void set_power(std::size_t node, bool to) {
    if (on[node] == to) return;
    on[node] = to;
    if (to) {
      air.start(node);
    } else {
      air.stop(node);
    }
  }
  // Toggles the power of some nodes one after the other, then of more at once.
  void change() {
    for (int i = 0; i < 4; ++i) {
      const std::size_t node = random_below(air.size());
      set_power(node, !on[node]);
      air.run(superframe_s * static_cast<double>(random_below(40)));
    }
    for (std::size_t i = 0; i < air.size(); ++i)
      if (random_below(3) == 0) set_power(i, random_below(4) != 0);
  }
  std::size_t random_below(std::size_t bound) { return static_cast<std::size_t>(random_() % bound); }

  // Maps each live node to the lowest beaconer of its connected component. Omits nodes that reach none.
  [[nodiscard]] std::map<std::size_t, std::size_t> components() const {
    std::map<std::size_t, std::size_t> component;
    for (std::size_t first = 0; first < beaconers_; ++first) {
      if (!on[first] || component.contains(first)) continue;
      std::vector<std::size_t> open{first};
      while (!open.empty()) {
        const std::size_t node = open.back();
        open.pop_back();
        if (!component.emplace(node, first).second || node >= beaconers_) continue;
        for (std::size_t i = 0; i < air.size(); ++i)
          if (on[i] && edges_.contains({node, i})) open.push_back(i);
      }
    }
    return component;
  }
  [[nodiscard]] bool one_master_per_component() const {
    std::map<std::size_t, int> leaders;
    for (const auto& [node, component] : components())
      leaders[component] += air.station(node).election().leads() ? 1 : 0;
    return std::all_of(leaders.begin(), leaders.end(), [](const auto& l) { return l.second == 1; });
  }
  [[nodiscard]] bool all_synchronized() const {
    std::map<std::size_t, std::set<std::uint64_t>> sessions;
    for (const auto& [node, component] : components()) {
      if (air.station(node).sync().state() == SyncState::kSearching) return false;
      sessions[component].insert(air.station(node).election().session());
    }
    return std::all_of(sessions.begin(), sessions.end(), [](const auto& s) { return s.second.size() == 1; });
  }
  [[nodiscard]] std::string description() const {
    std::string text;
    for (const auto& [node, component] : components()) {
      const auto& m = air.station(node).election();
      std::array<char, 160> line{};
      std::snprintf(line.data(), line.size(),
                    "  %u of component %u: role %d, master %u, session %llx, hop %d\n", air.id(node),
                    air.id(component), static_cast<int>(m.role()), m.master(),
                    static_cast<unsigned long long>(m.session()), m.hop());
      text += line.data();
    }
    return text;
  }

 private:
  void join(std::size_t a, std::size_t b) {
    edges_.insert({a, b});
    edges_.insert({b, a});
  }

  std::size_t beaconers_;
  groma_Schedule schedule_;
  std::mt19937_64 random_;
  std::set<std::pair<std::size_t, std::size_t>> edges_;

 public:
  Air air;
  double superframe_s = 0.0;
  std::vector<bool> on;
};

class Layouts : public ::testing::TestWithParam<Shape> {};

// In at most 1 % of the rounds two networks of a component stay separate, because the frames of each fall
// where the other does not listen.
TEST_P(Layouts, EachComponentSoonIsOneNetworkAfterTheLastChange) {
  constexpr int kRounds = 6;
  constexpr int kSoon = 60;
  constexpr int kMost = 400;
  std::vector<int> until_one;
  std::vector<int> until_synchronized;
  for (std::uint64_t seed = GROMA_FIRST_SEED; seed <= GROMA_LAST_SEED; ++seed) {
    Layout layout(GetParam(), 100 * seed + static_cast<std::uint64_t>(GetParam()));
    for (std::size_t i = 0; i < layout.air.size(); ++i) layout.set_power(i, true);
    for (int round = 0; round < kRounds; ++round) {
      if (round > 0) layout.change();
      int one = 0;
      int sync_superframes = 0;
      for (int n = 1; n <= kMost && n <= std::max(one, sync_superframes) + 30; ++n) {
        layout.air.run(layout.superframe_s);
        if (!layout.one_master_per_component()) one = n;
        if (!layout.all_synchronized()) sync_superframes = n;
      }
      layout.air.ranges.clear();
      until_one.push_back(one);
      until_synchronized.push_back(sync_superframes);
      if (std::max(one, sync_superframes) > kSoon)
        std::printf("%s, seed %d, round %d: %d and %d superframes\n%s", name_of(GetParam()),
                    static_cast<int>(seed), round, one, sync_superframes, layout.description().c_str());
    }
  }
  std::sort(until_one.begin(), until_one.end());
  std::sort(until_synchronized.begin(), until_synchronized.end());
  const auto at = [](const std::vector<int>& of, double share) {
    return of[static_cast<std::size_t>(share * static_cast<double>(of.size() - 1))];
  };
  std::printf(
      "%s, %zu rounds: superframes until one master: median %d, 90 %% %d, 99 %% %d, longest %d; until all "
      "synchronized: %d, %d, %d, %d\n",
      name_of(GetParam()), until_one.size(), at(until_one, 0.5), at(until_one, 0.9), at(until_one, 0.99),
      until_one.back(), at(until_synchronized, 0.5), at(until_synchronized, 0.9),
      at(until_synchronized, 0.99), until_synchronized.back());
  EXPECT_GT(until_one.back(), 5) << "some rounds needed a merge";
  EXPECT_LE(at(until_one, 0.99), kSoon);
  EXPECT_LE(at(until_synchronized, 0.99), kSoon);
}

INSTANTIATE_TEST_SUITE_P(Shapes, Layouts,
                         ::testing::Values(Shape::kLine, Shape::kRing, Shape::kStar, Shape::kTree));

}  // namespace
}  // namespace groma::testing
