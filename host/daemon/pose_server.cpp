#include "host/daemon/pose_server.hpp"

#include <fmt/format.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <utility>

#include "host/daemon/pose_message.hpp"

namespace groma::daemon {
namespace {

// Bytes that the kernel keeps for a client, so that one that does not read is noticed within seconds; by
// itself the kernel would keep megabytes.
constexpr int kSendBuffer = 65'536;
// A client that acknowledges nothing for this time is gone, without a word.
constexpr unsigned kAcknowledges_ms = 20'000;

void bound_buffers(int fd) {
  ::setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &kSendBuffer, sizeof(kSendBuffer));
  ::setsockopt(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, &kAcknowledges_ms, sizeof(kAcknowledges_ms));
}

}  // namespace

struct PoseServer::Client {
  Client(PoseServer& server, EventLoop& loop, io::Descriptor socket)
      : fd(std::move(socket)),
        watch(
            loop, fd.get(), [&server, this] { server.read(*this); },
            [&server, this] {
              server.send_waiting(*this);
              server.remove_gone();
            }) {}

  io::Descriptor fd;
  EventLoop::Watch watch;
  std::string waiting;
  bool gone = false;
};

PoseServer::Opened PoseServer::open(EventLoop& loop, const Endpoint& endpoint, std::string greeting) {
  std::unique_ptr<PoseServer> server(new PoseServer(std::move(greeting)));
  TcpListener::Opened opened =
      TcpListener::open(loop, endpoint, "pose_stream",
                        [&loop, &to = *server](io::Descriptor client) { to.add(loop, std::move(client)); });
  if (!opened.listener) return {nullptr, std::move(opened.error)};
  server->listener_ = std::move(opened.listener);
  return {std::move(server), {}};
}

PoseServer::PoseServer(std::string greeting) : greeting_(std::move(greeting)) {}

PoseServer::~PoseServer() = default;

std::size_t PoseServer::waiting_bytes() const noexcept {
  std::size_t bytes = 0;
  for (const auto& client : clients_) bytes += client->waiting.size();
  return bytes;
}

void PoseServer::add(EventLoop& loop, io::Descriptor fd) {
  if (clients_.size() == kMaxClients && !make_place()) {
    ++counters_.refused;
    const std::string farewell = greeting_ + refused_line();
    static_cast<void>(::send(fd.get(), farewell.data(), farewell.size(), MSG_NOSIGNAL));
    return;
  }
  ++counters_.accepted;
  bound_buffers(fd.get());
  clients_.push_back(std::make_unique<Client>(*this, loop, std::move(fd)));
  queue(*clients_.back(), greeting_);
  remove_gone();
}

bool PoseServer::make_place() {
  const auto furthest = std::max_element(clients_.begin(), clients_.end(), [](const auto& a, const auto& b) {
    return a->waiting.size() < b->waiting.size();
  });
  if ((*furthest)->waiting.size() < kBehind) return false;
  drop(**furthest, counters_.too_slow);
  remove_gone();
  return true;
}

void PoseServer::log_events(const std::function<void(std::string_view)>& log) {
  if (too_slow_.is_due(counters_.too_slow)) {
    log(fmt::format("pose stream: clients dropped so far because they did not read: {}", counters_.too_slow));
  }
  if (refused_.is_due(counters_.refused)) {
    log(fmt::format("pose stream: clients refused so far because {} others read it: {}", kMaxClients,
                    counters_.refused));
  }
  if (pauses_.is_due(listener_->pauses())) {
    log("pose stream: no descriptor is free for a client; raise 'ulimit -n', or end other programs");
  }
}

void PoseServer::on_line(std::string_view line) {
  for (const auto& client : clients_) queue(*client, line);
  remove_gone();
}

// Data from clients is read and ignored, to detect a disconnect. The amount is bounded, so that a client that
// sends without end does not delay the others.
void PoseServer::read(Client& client) {
  std::array<char, 16384> ignored{};
  const ssize_t n = ::recv(client.fd.get(), ignored.data(), ignored.size(), 0);
  if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) drop(client, counters_.disconnected);
  remove_gone();
}

void PoseServer::queue(Client& client, std::string_view line) {
  if (client.gone) return;
  // While bytes wait, the loop sends them as soon as the client can take some.
  const bool waited = !client.waiting.empty();
  client.waiting += line;
  if (!waited) send_waiting(client);
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
  if (!client.gone && !client.waiting.empty()) client.watch.await_writable();
}

void PoseServer::drop(Client& client, std::uint64_t& counter) {
  client.gone = true;
  ++counter;
}

void PoseServer::remove_gone() {
  std::erase_if(clients_, [](const auto& client) { return client->gone; });
}

}  // namespace groma::daemon
