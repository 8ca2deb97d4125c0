// Peak memory of a calibration by the number of ranges.
#include <gtest/gtest.h>

#include <cstddef>
#include <string>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/support/live_heap.hpp"

namespace groma::calibration {
namespace {

// Peak of calibrate(), without the drive itself.
double peak_bytes(const test::SimulatedSite& site) {
  const Drive drive = site.drive();
  test::watch_heap();
  const Result result = calibrate(drive);
  EXPECT_EQ(result.calibration.anchors.size(), site.anchors.size());
  return static_cast<double>(test::peak_heap_bytes());
}

TEST(LiveHeap, MeasuresThePeak) {
  test::watch_heap();
  {
    const std::vector<double> one(100'000);
    // Through a volatile pointer: otherwise the compiler removes an allocation that nothing reads.
    const std::vector<double>* const volatile read = &one;
    EXPECT_GE(read->capacity(), 100'000U);
  }
  const std::vector<double> another(50'000);
  const Eigen::VectorXd third = Eigen::VectorXd::Ones(25'000);
  EXPECT_NEAR(static_cast<double>(test::peak_heap_bytes()), 800e3, 5e3);
  EXPECT_EQ(another.size(), 2 * static_cast<std::size_t>(third.size()));
}

TEST(CalibrationMemory, GrowsInProportionToTheNumberOfRanges) {
  const double few = 200.0;
  const double more = 1000.0;
  const double many = 4000.0;
  std::vector<double> bytes;
  std::vector<double> ranges;
  for (const double per_pair : {few, more, many}) {
    const test::SimulatedSite site = test::simulate_site(
        {.ranges_per_pair = static_cast<std::size_t>(per_pair), .outlier_share = 0.15}, 1);
    ranges.push_back(static_cast<double>(site.ranges.size()));
    bytes.push_back(peak_bytes(site));
    RecordProperty("peak_bytes_" + std::to_string(site.ranges.size()), std::to_string(bytes.back()));
  }
  const double first_slope = (bytes[1] - bytes[0]) / (ranges[1] - ranges[0]);
  const double second_slope = (bytes[2] - bytes[1]) / (ranges[2] - ranges[1]);
  RecordProperty("bytes_per_range", std::to_string(second_slope));
  EXPECT_LT(second_slope, 1.1 * first_slope);
  EXPECT_LT(second_slope, 400.0);
}

}  // namespace
}  // namespace groma::calibration
