// The demonstration as one self-contained HTML page: a map, the errors over time, the tables.
#pragma once

#include <cstdint>

#include "firmware/sim/world/scenario.hpp"
#include "host/report/page.hpp"
#include "host/simulation/demo.hpp"

namespace groma::cli {

[[nodiscard]] report::Page demo_report(const sim::Scenario& scenario, const simulation::DemoResult& result,
                                       std::uint64_t seed);

}  // namespace groma::cli
