// A site of few nodes without walls, for fast tests.
#pragma once

#include "firmware/sim/world/scenario.hpp"

namespace groma::simulation {

inline sim::Scenario small_site() {
  sim::Scenario site;
  site.name = "small";
  site.anchors = {{10, {0.0, 0.0, 2.0}}, {11, {8.0, 0.0, 2.5}}, {12, {8.0, 6.0, 1.5}}, {13, {0.0, 6.0, 3.0}}};
  site.tags = {{1, {0.5, 0.2, 1.4}}, {2, {-0.5, -0.2, 0.6}}};
  site.biases = {{0.1, 0.1}, -0.2, 0.4, {1.0, 0.002}};
  site.drives = {{"first", {{1.0, 1.0, {}, 0.0}, {6.0, 1.5, {}, 0.0}, {6.0, 4.5, {}, 0.0}}},
                 {"second", {{2.0, 4.5, {}, 0.0}, {1.5, 2.0, {}, 0.0}}}};
  site.schedule.master_id = 10;
  return site;
}

}  // namespace groma::simulation
