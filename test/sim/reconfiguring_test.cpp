// A ranging site whose nodes receive another schedule, one after the other over their cables.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <set>
#include <string>
#include <vector>

#include "test/sim/fault_site.hpp"

namespace groma::sim {
namespace {

constexpr int kTags = 2;
constexpr int kAnchors = 6;

struct Reconfiguring {
  const char* name;
  std::vector<std::uint16_t> order;
  std::function<void(groma_Schedule&)> change;
};

std::ostream& operator<<(std::ostream& out, const Reconfiguring& of) {
  return out << of.name;
}

class Reconfigured : public testing::TestWithParam<Reconfiguring> {};

// Superframes within which, once a beaconer has the newer schedule, no node follows the older one and the
// nodes with the newer one range. Includes the time that a node is off the air to write its flash.
constexpr double kBound = 60.0;

TEST_P(Reconfigured, TheNodesWithTheNewestScheduleRangeAndTheOthersAreSilent) {
  const Reconfiguring& of = GetParam();
  FaultSite site({.tags = kTags, .anchors = kAnchors, .backups = 2, .slots = 3});
  site.run_for(2.0);
  site.air.keep_sent = true;
  std::set<std::uint16_t> newer;
  double longest = 0.0;
  for (const std::uint16_t id : of.order) {
    groma_Config config = site.config_of(id, id < 100 ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR);
    ++config.schedule.epoch;
    of.change(config.schedule);
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = 1;
    command.which_body = groma_HostToNode_write_config_tag;
    command.body.write_config = config;
    site.send(id, command);
    site.run_for(0.3);
    command = groma_HostToNode_init_zero;
    command.request_id = 2;
    command.which_body = groma_HostToNode_apply_config_tag;
    site.send(id, command);
    newer.insert(id);
    const double from_s = site.now_s();
    site.air.sent.clear();
    const double bound_s = kBound * seconds_of(site.superframe(config));
    site.run_for(bound_s);
    const std::uint64_t collisions = site.air.collisions;
    const std::size_t ranges = site.ranges().size();
    const double watched_from_s = site.now_s();
    site.run_for(0.5);
    const bool led = newer.contains(101) || newer.contains(102) || newer.contains(103);
    double stale_s = 0.0;
    for (const AirLog::Sent& sent : site.air.sent)
      if (led && !newer.contains(sent.transmitter))
        stale_s = std::max(stale_s, to_seconds(sent.frame.preamble_start) - from_s);
    longest = std::max(longest, stale_s);
    // Each pair that can range does so all the time, and no other pair ranges.
    std::set<std::pair<std::uint16_t, std::uint16_t>> pairs;
    std::size_t good = 0;
    double first_s = 1e9;
    for (std::size_t i = 0; i < site.ranges().size(); ++i) {
      const SeenRange& range = site.ranges()[i];
      if (!range.good) continue;
      EXPECT_LT(std::abs(range.error_m), 6.0 * range.sigma_m);
      if (range.at_s > from_s && newer.contains(range.tag)) first_s = std::min(first_s, range.at_s - from_s);
      if (i < ranges || range.at_s < watched_from_s) continue;
      ++good;
      pairs.insert({range.tag, range.anchor});
    }
    std::size_t due = 0;
    for (int t = 0; t < kTags; ++t)
      for (int a = 0; a < kAnchors; ++a)
        if (newer.contains(nth_tag(t)) == newer.contains(nth_anchor(a)) && newer.contains(nth_tag(t)) == led)
          ++due;
    std::printf(
        "%s: %u: stale until %.0f ms, first range after %.0f ms, %zu of %zu pairs, %zu ranges, %d "
        "collisions\n",
        of.name, id, 1e3 * stale_s, 1e3 * first_s, pairs.size(), due, good,
        static_cast<int>(site.air.collisions - collisions));
    EXPECT_LT(stale_s, bound_s) << id;
    EXPECT_EQ(pairs.size(), due) << id;
    EXPECT_GE(static_cast<double>(good),
              0.97 * static_cast<double>(due) * 0.5 / seconds_of(site.superframe(config)) - 12.0)
        << id;
    EXPECT_EQ(site.air.collisions, collisions) << id;
  }
  std::printf("%s: longest %.0f ms\n", of.name, 1e3 * longest);
}

void no_other_change(groma_Schedule& /*schedule*/) {}
void another_slot(groma_Schedule& schedule) {
  ++schedule.slots;
}
void another_layout(groma_Schedule& schedule) {
  schedule.guard_us += 20;
  schedule.turn_round_us += 100;
  schedule.response_gap_us += 37;
}

const std::vector<std::uint16_t> kMasterLast{104, 105, 106, 1, 2, 103, 102, 101};
const std::vector<std::uint16_t> kTagsFirst{1, 2, 101, 102, 103, 104, 105, 106};
const std::vector<std::uint16_t> kMasterFirst{101, 1, 104, 102, 2, 105, 106, 103};
const std::vector<std::uint16_t> kBackUpFirst{103, 1, 106, 2, 101, 105, 102, 104};

INSTANTIATE_TEST_SUITE_P(
    Orders, Reconfigured,
    testing::Values(Reconfiguring{"master last", kMasterLast, no_other_change},
                    Reconfiguring{"tags first", kTagsFirst, no_other_change},
                    Reconfiguring{"master first", kMasterFirst, no_other_change},
                    Reconfiguring{"back-up first", kBackUpFirst, no_other_change},
                    Reconfiguring{"master first, one more slot", kMasterFirst, another_slot},
                    Reconfiguring{"back-up first, one more slot", kBackUpFirst, another_slot},
                    Reconfiguring{"master first, another layout", kMasterFirst, another_layout},
                    Reconfiguring{"back-up first, another layout", kBackUpFirst, another_layout},
                    Reconfiguring{"tags first, another layout", kTagsFirst, another_layout}));

}  // namespace
}  // namespace groma::sim
