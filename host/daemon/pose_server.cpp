#include "host/daemon/pose_server.hpp"

#include <fmt/format.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <system_error>
#include <utility>

namespace groma::daemon {
namespace {

struct AddressDeleter {
  void operator()(addrinfo* found) const noexcept { ::freeaddrinfo(found); }
};

link::LinkError explain(const std::string& address, std::uint16_t port, int error) {
  const std::string where = fmt::format("{} port {}", address, port);
  switch (error) {
    case EADDRINUSE:
      return {link::LinkFault::kBusy,
              fmt::format("{}: in use by another program; stop it or set another pose_stream port", where)};
    case EACCES:
    case EPERM:
      return {link::LinkFault::kPermission,
              fmt::format("{}: not permitted; set a pose_stream port above 1023", where)};
    case EADDRNOTAVAIL:
      return {link::LinkFault::kNoDevice,
              fmt::format("{}: not an address of this computer; set another pose_stream address", where)};
    default:
      return {link::LinkFault::kUnsuitable, fmt::format("{}: cannot listen ({}); set another pose_stream",
                                                        where, std::generic_category().message(error))};
  }
}

std::uint16_t bound_port(int fd) {
  sockaddr_storage bound{};
  socklen_t size = sizeof(bound);
  if (::getsockname(fd, reinterpret_cast<sockaddr*>(&bound), &size) != 0) return 0;
  // IPv4 and IPv6 have the port at the same offset.
  return ntohs(reinterpret_cast<const sockaddr_in*>(&bound)->sin_port);
}

}  // namespace

PoseServer::Opened PoseServer::open(const std::string& address, std::uint16_t port, std::string greeting) {
  addrinfo hints{};
  hints.ai_flags = AI_NUMERICHOST | AI_NUMERICSERV | AI_PASSIVE;
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* raw = nullptr;
  if (::getaddrinfo(address.c_str(), std::to_string(port).c_str(), &hints, &raw) != 0) {
    return {nullptr, explain(address, port, EADDRNOTAVAIL)};
  }
  const std::unique_ptr<addrinfo, AddressDeleter> found(raw);
  io::Descriptor listener(::socket(found->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  const int on = 1;
  if (!listener.valid() || ::setsockopt(listener.get(), SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on)) != 0 ||
      ::bind(listener.get(), found->ai_addr, found->ai_addrlen) != 0 || ::listen(listener.get(), 16) != 0) {
    return {nullptr, explain(address, port, errno)};
  }
  const std::uint16_t bound = bound_port(listener.get());
  return {std::unique_ptr<PoseServer>(new PoseServer(std::move(listener), bound, std::move(greeting))), {}};
}

PoseServer::PoseServer(io::Descriptor listener, std::uint16_t port, std::string greeting)
    : listener_(std::move(listener)), port_(port), greeting_(std::move(greeting)) {}

void PoseServer::append_poll(std::vector<pollfd>& out) const {
  out.push_back({listener_.get(), POLLIN, 0});
  for (const Client& client : clients_) {
    const int events = client.waiting.empty() ? POLLIN : POLLIN | POLLOUT;
    out.push_back({client.fd.get(), static_cast<short>(events), 0});
  }
}

void PoseServer::service() {
  accept_clients();
  std::array<char, 512> ignored{};
  for (Client& client : clients_) {
    // Data from clients is read and ignored, to detect a disconnect. The amount is bounded, so that a client
    // that sends without end does not delay the others.
    const ssize_t n = ::recv(client.fd.get(), ignored.data(), ignored.size(), 0);
    if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) {
      drop(client, counters_.disconnected);
    } else {
      send_waiting(client);
    }
  }
  std::erase_if(clients_, [](const Client& client) { return client.gone; });
}

void PoseServer::broadcast(std::string_view line) {
  for (Client& client : clients_) queue(client, line);
  std::erase_if(clients_, [](const Client& client) { return client.gone; });
}

void PoseServer::accept_clients() {
  while (true) {
    io::Descriptor fd(::accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (!fd.valid()) return;
    if (clients_.size() == kMaxClients) {
      ++counters_.refused;
      continue;
    }
    const int on = 1;
    ::setsockopt(fd.get(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
    ++counters_.accepted;
    clients_.push_back({.fd = std::move(fd), .waiting = {}});
    queue(clients_.back(), greeting_);
  }
}

void PoseServer::queue(Client& client, std::string_view line) {
  if (client.gone) return;
  client.waiting += line;
  send_waiting(client);
  if (!client.gone && client.waiting.size() > kMaxBacklog) drop(client, counters_.too_slow);
}

void PoseServer::send_waiting(Client& client) {
  std::size_t sent = 0;
  while (sent < client.waiting.size()) {
    const std::string_view rest = std::string_view(client.waiting).substr(sent);
    const ssize_t n = ::send(client.fd.get(), rest.data(), rest.size(), MSG_NOSIGNAL);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) {
      if (errno != EAGAIN) drop(client, counters_.disconnected);
      break;
    }
    sent += static_cast<std::size_t>(n);
  }
  client.waiting.erase(0, sent);
}

void PoseServer::drop(Client& client, std::uint64_t& counter) {
  client.gone = true;
  ++counter;
}

}  // namespace groma::daemon
