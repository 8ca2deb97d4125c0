// Reports to systemd as sd_notify(3) does. Does nothing unless systemd set NOTIFY_SOCKET.
#pragma once

#include <chrono>
#include <string>
#include <string_view>

#include "host/io/descriptor.hpp"

namespace groma::daemon {

class ServiceManager {
 public:
  // Reads NOTIFY_SOCKET and WATCHDOG_USEC.
  ServiceManager();

  void ready() const { notify("READY=1"); }
  void reloading() const { notify("RELOADING=1"); }  // until ready()
  // From now on the watchdog does not wait for alive().
  void stopping() const { notify("STOPPING=1\nWATCHDOG_USEC=0"); }
  // Call it in each turn of the loop: feeds the watchdog twice in each of its intervals.
  void alive();

 private:
  using Clock = std::chrono::steady_clock;
  void notify(std::string_view state) const;

  std::string path_;  // of the socket; begins with a zero byte if it is abstract
  io::Descriptor socket_;
  Clock::duration period_{};  // zero: no watchdog
  Clock::time_point next_;
};

}  // namespace groma::daemon
