// A simulated site with a gromad of its own that serves the live page: groma sim --live, groma demo --live.
#pragma once

#include <cstdint>

#include "firmware/sim/world/scenario.hpp"
#include "host/simulation/site_server.hpp"

namespace groma::cli {

inline constexpr std::uint16_t kLivePort = 4722;  // of the page; gromad's default

// The same site, whose last drive is repeated for hours.
[[nodiscard]] sim::Scenario endless(sim::Scenario scenario);

// The exit code of a site that has run: kDoneWithWarnings, with a warning, if this machine was too slow for
// it.
[[nodiscard]] int report_behind(const simulation::SiteServer& server);

// Runs until a stop signal, and prints the page's address. The folder gets gromad's configuration and the
// files that it names. Throws as SiteServer, and io::DeviceError if gromad is not beside this program or
// fails.
[[nodiscard]] int run_live(const sim::Scenario& scenario, const simulation::SiteServer::Options& options,
                           std::uint16_t port);

}  // namespace groma::cli
