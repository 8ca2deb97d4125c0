// Stop signals, for commands that run until the user ends them.
#pragma once

#include <csignal>

namespace groma::cli {

// From now on SIGINT and SIGTERM set the returned flag and do not end the program.
const volatile std::sig_atomic_t& stop_on_signals();

}  // namespace groma::cli
