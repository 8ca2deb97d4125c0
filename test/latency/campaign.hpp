// What the campaigns of gromad under load share: their argument, their table and their exit code.
#pragma once

#include <vector>

#include "test/latency/measurement.hpp"

namespace groma::latency {

struct CampaignTimes {
  double usual_s = 0.0;  // without an argument
  double least_s = 0.0;
};
inline constexpr double kMostTime_s = 600.0;

// Prints the rows and how many bounds are missed. 1 if any is, else 0.
[[nodiscard]] int report(const std::vector<Row>& rows);

// Calls `run` with the duration that the program's only argument gives; returns what it returns. 2, with a
// message, if the duration is out of bounds; 1, with its text, for an exception.
[[nodiscard]] int campaign(int argc, char** argv, const char* name, const CampaignTimes& times,
                           int (*run)(double duration_s));

}  // namespace groma::latency
