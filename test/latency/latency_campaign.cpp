// latency_campaign [SECONDS]: gromad under full load for that time, by default ten minutes. Prints a table;
// ends with 1 if a bound is missed.
#include <fmt/format.h>

#include "test/latency/campaign.hpp"
#include "test/latency/load_generator.hpp"
#include "test/latency/measurement.hpp"

namespace groma::latency {
namespace {

int run(double duration_s) {
  const std::vector<Row> rows = judge(measure(duration_s));
  fmt::print(
      "gromad for {} s: {} ranges/s on {} pseudo-terminals, odometry at {} Hz, capture, a TCP client\n\n",
      duration_s, LoadGenerator::kRanges_hz, LoadGenerator::kTags, LoadGenerator::kOdometry_hz);
  return report(rows);
}

}  // namespace
}  // namespace groma::latency

int main(int argc, char** argv) {
  using namespace groma::latency;
  return campaign(argc, argv, "latency_campaign", {.usual_s = kMostTime_s, .least_s = 2.0 * kWarmUp_s}, run);
}
