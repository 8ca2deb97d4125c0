// The shipped image relays the beacon at any gap; with a single slot in its table also if each instruction
// costs 1.5 times as much.
#include <gtest/gtest.h>

#include <vector>

#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/fault_site.hpp"

namespace groma::sim {
namespace {

struct RelayCase {
  int slots;
  std::uint32_t gap_us;
  bool keyed;
};

std::ostream& operator<<(std::ostream& out, const RelayCase& of) {
  return out << of.slots << " slots, " << of.gap_us << " us" << (of.keyed ? ", keyed" : "");
}

class RelayingImages : public testing::TestWithParam<RelayCase> {};

TEST_P(RelayingImages, AreInTimeWithEachBeacon) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  const RelayCase of = GetParam();
  FaultSiteSettings settings{
      .tags = 1, .anchors = 3, .backups = 2, .slots = of.slots, .response_gap_us = of.gap_us};
  if (of.keyed) settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  EmulatorOptions options;
  FaultSite site(emulating(settings, options));
  constexpr double kSettled_s = 1.4;
  site.run_until(kSettled_s);
  site.air.keep_sent = true;
  constexpr double kSuperframes = 60.0;
  site.run_for(kSuperframes * site.superframe_s());
  site.air.keep_sent = false;
  const std::vector<AirLog::Sent> sent = std::move(site.air.sent);
  for (int rank = 0; rank <= settings.backups; ++rank) {
    const std::uint16_t id = nth_anchor(rank);
    double beacons = 0.0;
    for (const AirLog::Sent& one : sent) {
      const auto frame = parsed(one.frame);
      const auto* beacon = frame ? std::get_if<mac::Beacon>(&frame->body) : nullptr;
      if (one.transmitter != id || beacon == nullptr) continue;
      EXPECT_EQ(beacon->hop, rank == 0 ? 0 : 1);
      EXPECT_LE(beacon->age, 1);
      beacons += 1.0;
    }
    const double turns = settings.backups + 1.0;
    EXPECT_NEAR(beacons, rank == 0 ? kSuperframes : kSuperframes / turns, 1.1) << id;
  }
}

INSTANTIATE_TEST_SUITE_P(Gaps, RelayingImages,
                         testing::Values(RelayCase{1, 220, false}, RelayCase{1, 300, false},
                                         RelayCase{1, 220, true}, RelayCase{1, 320, true},
                                         RelayCase{16, 300, false}, RelayCase{16, 320, true}));

}  // namespace
}  // namespace groma::sim
