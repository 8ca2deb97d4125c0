#include "host/link/listening_socket.hpp"

#include <fmt/format.h>
#include <netdb.h>
#include <sys/socket.h>

#include <cerrno>
#include <cstring>
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

LinkError explain_listen_error(const std::string& where, int error_number, std::string_view key) {
  const char* const reason = std::strerror(error_number);
  switch (error_number) {
    case EADDRINUSE:
      return {LinkFault::kBusy,
              fmt::format("{}: another program listens here; stop it, or change `{}`", where, key)};
    case EACCES:
    case EPERM:
    case EROFS:
      return {
          LinkFault::kPermission,
          fmt::format("{}: not permitted ({}); change `{}` to a port above 1023, or to a folder that this "
                      "user may write to",
                      where, reason, key)};
    case EADDRNOTAVAIL:
    case ENOENT:
      return {
          LinkFault::kNoDevice,
          fmt::format("{}: no such address or folder ({}); change `{}` to an address of this computer, or to "
                      "a folder that exists",
                      where, reason, key)};
    default:
      return {LinkFault::kUnsuitable, fmt::format("{}: cannot listen ({}); change `{}`", where, reason, key)};
  }
}

}  // namespace groma::link
