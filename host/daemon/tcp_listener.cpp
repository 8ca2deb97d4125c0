#include "host/daemon/tcp_listener.hpp"

#include <fmt/format.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>

#include <cerrno>
#include <utility>

#include "host/link/listening_socket.hpp"

namespace groma::daemon {
namespace {

// Clients that connect within one turn of the loop; with a full backlog TCP tries again only after 1 s.
constexpr int kBacklog = 256;

std::uint16_t bound_port(int fd) {
  sockaddr_storage bound{};
  socklen_t size = sizeof(bound);
  if (::getsockname(fd, reinterpret_cast<sockaddr*>(&bound), &size) != 0) return 0;
  // IPv4 and IPv6 have the port at the same offset.
  return ntohs(reinterpret_cast<const sockaddr_in*>(&bound)->sin_port);
}

bool lacks_resources(int error) {
  return error == EMFILE || error == ENFILE || error == ENOBUFS || error == ENOMEM;
}

}  // namespace

std::string authority(const std::string& address, std::uint16_t port) {
  const bool is_v6 = address.find(':') != std::string::npos;
  return fmt::format("{}{}{}:{}", is_v6 ? "[" : "", address, is_v6 ? "]" : "", port);
}

TcpListener::Opened TcpListener::open(EventLoop& loop, const Endpoint& endpoint, std::string_view key,
                                      Accepted accepted) {
  link::ListeningSocket listening = link::listen_at(endpoint.address, endpoint.port, SOCK_STREAM, kBacklog);
  if (!listening.fd.valid()) {
    const std::string where = fmt::format("{} port {}", endpoint.address, endpoint.port);
    return {nullptr, link::explain_listen_error(where, listening.error, key)};
  }
  const std::uint16_t bound = bound_port(listening.fd.get());
  return {std::unique_ptr<TcpListener>(
              new TcpListener(loop, std::move(listening.fd), bound, std::move(accepted))),
          {}};
}

TcpListener::TcpListener(EventLoop& loop, io::Descriptor listener, std::uint16_t port, Accepted accepted)
    : loop_(loop),
      listener_(std::move(listener)),
      port_(port),
      accepted_(std::move(accepted)),
      resume_(loop, kPause_s, [this] {
        if (!watch_) listen();
      }) {
  listen();
}

void TcpListener::listen() {
  watch_.emplace(loop_, listener_.get(), [this] { accept(); });
}

void TcpListener::accept() {
  for (int i = 0; i < kAcceptsPerTurn; ++i) {
    io::Descriptor client(::accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (!client.valid()) {
      if (!lacks_resources(errno)) return;
      ++pauses_;
      watch_.reset();
      return;
    }
    const int on = 1;
    ::setsockopt(client.get(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
    accepted_(std::move(client));
  }
}

}  // namespace groma::daemon
