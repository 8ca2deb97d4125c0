// A short form of the campaign. It judges what does not depend on the machine: losses, order, allocations.
#include <gtest/gtest.h>

#include "test/latency/measurement.hpp"

namespace groma::latency {
namespace {

TEST(Latency, FullLoadLosesNothingAndAllocatesNothingForPoses) {
  const Measurement measured = measure(10.0);
  const std::vector<Row> rows = judge(measured);
  EXPECT_GE(measured.poses, 600U);
  for (const Row& row : rows) EXPECT_TRUE(row.met || row.of_times) << row.what << ": " << row.value;
  if (HasFailure()) ADD_FAILURE() << format_table(rows) << measured.log;
}

}  // namespace
}  // namespace groma::latency
