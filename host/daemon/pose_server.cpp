#include "host/daemon/pose_server.hpp"

#include <sys/socket.h>

#include <array>
#include <cerrno>
#include <utility>

namespace groma::daemon {

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
  if (clients_.size() == kMaxClients) {
    ++counters_.refused;
    return;
  }
  ++counters_.accepted;
  clients_.push_back(std::make_unique<Client>(*this, loop, std::move(fd)));
  queue(*clients_.back(), greeting_);
  remove_gone();
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
