// The site whose rate is specified, 3 tags, 12 anchors, preamble 128, by the usual schedule; and others.
#pragma once

#include <gtest/gtest.h>

#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/emulator/site_rate.hpp"

namespace groma::sim {

// Anchor 101 is the master; its back-ups are the anchors from 102 on.
inline SiteSettings fast_site(int tags = 3, int anchors = 12,
                              groma_Preamble preamble = groma_Preamble_PREAMBLE_128, int backups = 2) {
  SiteSettings settings;
  settings.tags = tags;
  settings.anchors = anchors;
  settings.preamble = preamble;
  settings.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  settings.raw_stamps = false;
  settings.configure = [backups](groma_Config& config) {
    groma_Schedule& schedule = config.schedule;
    for (int i = 1; i <= backups; ++i) schedule.backup_ids[schedule.backup_ids_count++] = nth_anchor(i);
  };
  return settings;
}

inline SiteSettings arming_ahead(SiteSettings settings) {
  settings.arm_ahead = true;
  return settings;
}

inline SiteSettings with_key(SiteSettings settings) {
  settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  return settings;
}

// A processor that needs 3.0 cycles for each instruction.
inline EmulatorOptions slow_processor() {
  EmulatorOptions slow;
  slow.timing.instruction = 3 * slow.timing.cycle;
  return slow;
}

inline void expect_fast(const SiteRate& rate, double least_per_s) {
  EXPECT_GE(rate.ranges_per_s, least_per_s);
  EXPECT_EQ(rate.late_transmits, 0);
  EXPECT_EQ(rate.reports_lost, 0);
  EXPECT_EQ(rate.recoveries, 0);
  testing::Test::RecordProperty("ranges_per_s", static_cast<int>(rate.ranges_per_s));
  testing::Test::RecordProperty("air_time_bound_per_s", static_cast<int>(rate.bound_per_s));
}

}  // namespace groma::sim
