#include "host/daemon/service_manager.hpp"

#include <sys/socket.h>
#include <sys/un.h>

#include <charconv>
#include <cstddef>
#include <cstdlib>
#include <cstring>

namespace groma::daemon {

ServiceManager::ServiceManager() {
  const char* const path = std::getenv("NOTIFY_SOCKET");
  if (path == nullptr || std::strlen(path) >= sizeof(sockaddr_un::sun_path)) return;
  path_ = path;
  if (path_.starts_with('@')) path_.front() = '\0';
  socket_ = io::Descriptor(::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  const char* const watchdog = std::getenv("WATCHDOG_USEC");
  if (watchdog == nullptr) return;
  long long interval_us = 0;
  std::from_chars(watchdog, watchdog + std::strlen(watchdog), interval_us);
  period_ = std::chrono::microseconds(interval_us / 2);
}

void ServiceManager::alive() {
  const Clock::time_point now = Clock::now();
  if (period_ <= Clock::duration::zero() || now < next_) return;
  next_ = now + period_;
  notify("WATCHDOG=1");
}

void ServiceManager::notify(std::string_view state) const {
  if (!socket_.valid()) return;
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  path_.copy(address.sun_path, sizeof(address.sun_path));
  const auto size = static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + path_.size());
  static_cast<void>(::sendto(socket_.get(), state.data(), state.size(), MSG_NOSIGNAL,
                             reinterpret_cast<const sockaddr*>(&address), size));
}

}  // namespace groma::daemon
