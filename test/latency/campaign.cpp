#include "test/latency/campaign.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstdlib>
#include <exception>

namespace groma::latency {

int report(const std::vector<Row>& rows) {
  const auto missed = std::count_if(rows.begin(), rows.end(), [](const Row& row) { return !row.met; });
  fmt::print("{}\n{} bounds missed\n", format_table(rows), missed);
  return missed == 0 ? 0 : 1;
}

int campaign(int argc, char** argv, const char* name, const CampaignTimes& times,
             int (*run)(double duration_s)) {
  const double duration_s = argc > 1 ? std::strtod(argv[1], nullptr) : times.usual_s;
  if (!(duration_s >= times.least_s && duration_s <= kMostTime_s)) {
    fmt::print(stderr, "{}: give a duration of {} to {} s\n", name, times.least_s, kMostTime_s);
    return 2;
  }
  try {
    return run(duration_s);
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}: {}\n", name, error.what());
    return 1;
  }
}

}  // namespace groma::latency
