// The demonstration as one self-contained HTML page: a map, the errors over time, the tables.
#pragma once

#include <cstdint>

#include "firmware/sim/world/scenario.hpp"
#include "host/report/page.hpp"
#include "host/report/site.hpp"
#include "host/simulation/demo.hpp"

namespace groma::cli {

// Without what is overhead.
[[nodiscard]] report::Walls walls_of(const sim::Scenario& scenario);

[[nodiscard]] report::Page demo_report(const sim::Scenario& scenario, const simulation::DemoResult& result,
                                       std::uint64_t seed);

}  // namespace groma::cli
