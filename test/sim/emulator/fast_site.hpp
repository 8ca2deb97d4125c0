// The site whose rate is promised: 3 tags, 12 anchors, preamble 128.
#pragma once

#include <gtest/gtest.h>

#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/emulator/site_rate.hpp"

namespace groma::sim {

inline SiteSettings fast_site() {
  SiteSettings settings;
  settings.tags = 3;
  settings.anchors = 12;
  settings.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  settings.turn_round_us = 300;
  settings.response_gap_us = 155;
  settings.guard_us = 20;
  settings.raw_stamps = false;
  return settings;
}

inline void expect_fast(const SiteRate& rate) {
  EXPECT_GE(rate.ranges_per_s, 2'280.0);
  EXPECT_EQ(rate.late_transmits, 0);
  EXPECT_EQ(rate.reports_lost, 0);
  EXPECT_EQ(rate.recoveries, 0);
  testing::Test::RecordProperty("ranges_per_s", static_cast<int>(rate.ranges_per_s));
  testing::Test::RecordProperty("air_time_bound_per_s", static_cast<int>(rate.bound_per_s));
}

}  // namespace groma::sim
