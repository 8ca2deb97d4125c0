// latency_campaign [SECONDS]: gromad under full load for that time, by default ten minutes. Prints a table;
// ends with 1 if a bound is missed.
#include <fmt/format.h>

#include <algorithm>
#include <cstdlib>
#include <exception>

#include "test/latency/load_generator.hpp"
#include "test/latency/measurement.hpp"

int main(int argc, char** argv) {
  using namespace groma::latency;
  constexpr double kFull_s = 600.0;
  const double duration_s = argc > 1 ? std::strtod(argv[1], nullptr) : kFull_s;
  if (!(duration_s >= 2.0 * kWarmUp_s && duration_s <= kFull_s)) {
    fmt::print(stderr, "latency_campaign: give a duration of {} to {} s\n", 2.0 * kWarmUp_s, kFull_s);
    return 2;
  }
  try {
    const Measurement measured = measure(duration_s);
    const std::vector<Row> rows = judge(measured);
    const auto missed = std::count_if(rows.begin(), rows.end(), [](const Row& row) { return !row.met; });
    fmt::print(
        "gromad for {} s: {} ranges/s on {} pseudo-terminals, odometry at {} Hz, capture, a TCP client\n\n",
        duration_s, LoadGenerator::kRanges_hz, LoadGenerator::kTags, LoadGenerator::kOdometry_hz);
    fmt::print("{}\n{} bounds missed\n", format_table(rows), missed);
    return missed == 0 ? 0 : 1;
  } catch (const std::exception& error) {
    fmt::print(stderr, "latency_campaign: {}\n", error.what());
    return 1;
  }
}
