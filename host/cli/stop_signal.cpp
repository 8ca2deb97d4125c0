#include "host/cli/stop_signal.hpp"

namespace groma::cli {

namespace {

volatile std::sig_atomic_t stop = 0;

extern "C" void on_stop_signal(int /*signal*/) {
  stop = 1;
}

}  // namespace

const volatile std::sig_atomic_t& stop_on_signals() {
  std::signal(SIGINT, on_stop_signal);
  std::signal(SIGTERM, on_stop_signal);
  return stop;
}

}  // namespace groma::cli
