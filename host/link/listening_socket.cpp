#include "host/link/listening_socket.hpp"

#include <netdb.h>
#include <sys/socket.h>

#include <cerrno>
#include <memory>
#include <utility>

namespace groma::link {
namespace {

struct AddressDeleter {
  void operator()(addrinfo* addresses) const noexcept { ::freeaddrinfo(addresses); }
};

}  // namespace

ListeningSocket listen_at(const std::string& address, std::uint16_t port, int type, int backlog) {
  addrinfo hints{};
  hints.ai_socktype = type;
  hints.ai_flags = AI_NUMERICHOST | AI_NUMERICSERV | AI_PASSIVE;
  addrinfo* raw = nullptr;
  if (::getaddrinfo(address.c_str(), std::to_string(port).c_str(), &hints, &raw) != 0) {
    return {{}, EADDRNOTAVAIL};
  }
  const std::unique_ptr<addrinfo, AddressDeleter> found(raw);
  Descriptor fd(::socket(found->ai_family, type | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  const bool streams = type == SOCK_STREAM;
  const int on = 1;
  // After a restart, connections of the run before still hold the port for a while.
  if (!fd.valid() || (streams && ::setsockopt(fd.get(), SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on)) != 0) ||
      ::bind(fd.get(), found->ai_addr, found->ai_addrlen) != 0 ||
      (streams && ::listen(fd.get(), backlog) != 0)) {
    return {{}, errno};
  }
  return {std::move(fd), 0};
}

}  // namespace groma::link
