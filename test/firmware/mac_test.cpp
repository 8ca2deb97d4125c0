#include <gtest/gtest.h>

#include <algorithm>
#include <map>

#include "test/firmware/air.hpp"

namespace groma::testing {
namespace {

using mac::RangeStatus;

std::size_t good(const std::vector<RangeSeen>& ranges) {
  return static_cast<std::size_t>(std::count_if(
      ranges.begin(), ranges.end(), [](const RangeSeen& r) { return r.range.status == RangeStatus::kOk; }));
}

double worst_error_m(const std::vector<RangeSeen>& ranges) {
  double worst = 0.0;
  for (const RangeSeen& r : ranges) {
    if (r.range.status != RangeStatus::kOk) continue;
    worst = std::max(worst, std::abs(static_cast<double>(r.range.flight.distance_m()) - r.truth_m));
  }
  return worst;
}

struct Case {
  groma_RangingMethod method;
  dw1000::Preamble preamble;
};

class Network : public ::testing::TestWithParam<Case> {};

INSTANTIATE_TEST_SUITE_P(
    Methods, Network,
    ::testing::Values(Case{groma_RangingMethod_METHOD_DS_FINAL, dw1000::Preamble::k128},
                      Case{groma_RangingMethod_METHOD_DS_NEXT_POLL, dw1000::Preamble::k128},
                      Case{groma_RangingMethod_METHOD_DS_FINAL, dw1000::Preamble::k64},
                      Case{groma_RangingMethod_METHOD_DS_NEXT_POLL, dw1000::Preamble::k256}));

TEST_P(Network, EveryRangeComesAndIsRightInAnIdealWorld) {
  const groma_Schedule schedule = schedule_of(3, 12, GetParam().method);
  Air air(schedule, GetParam().preamble);
  air.add_all(100.0, 20.0, 1);
  air.start_all();
  air.run(2.0);
  EXPECT_EQ(air.collisions, 0U);
  const mac::Superframe superframe(schedule, dw1000::Phy(GetParam().preamble));
  const double superframes = 2.0 * kTicksPerSecond / static_cast<double>(superframe.duration().count());
  EXPECT_GT(static_cast<double>(good(air.ranges)), 36.0 * (superframes - 6.0));
  EXPECT_EQ(good(air.ranges), air.ranges.size());
  // tof x offset: 2 mm at 100 m and 20 ppm, and the stamps' rounding.
  EXPECT_LT(worst_error_m(air.ranges), 0.008);
}

}  // namespace
}  // namespace groma::testing
