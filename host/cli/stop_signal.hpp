// For commands that run until they are told to stop.
#pragma once

#include <csignal>

namespace groma::cli {

// From now on SIGINT and SIGTERM set what is returned, and do not end the program.
const volatile std::sig_atomic_t& stop_on_signals();

}  // namespace groma::cli
