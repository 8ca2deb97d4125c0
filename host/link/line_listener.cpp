#include "host/link/line_listener.hpp"

#include <fcntl.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <memory>
#include <string_view>
#include <utility>

#include "host/link/listening_socket.hpp"
#include "host/link/network_link.hpp"

namespace groma::link {
namespace {

constexpr int kBacklog = 8;
constexpr std::size_t kMaxDatagram = 65536;
constexpr std::size_t kMostLines = 65536;  // bytes of whole lines that wait
constexpr mode_t kSocketMode = 0660;

bool watch(int poll_fd, int fd) noexcept {
  epoll_event event{};
  event.events = EPOLLIN;
  event.data.fd = fd;
  return ::epoll_ctl(poll_fd, EPOLL_CTL_ADD, fd, &event) == 0;
}

LinkError explain(const std::string& path, int error_number) {
  return explain_listen_error(path, error_number, "robot");
}

Descriptor open_spare() noexcept {
  return Descriptor(::open("/dev/null", O_RDONLY | O_CLOEXEC));
}

// Whether a program serves the socket at this address.
bool is_served(const sockaddr_un& address) noexcept {
  const Descriptor client(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
  return client.valid() &&
         ::connect(client.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) == 0;
}

ListeningSocket listen_at_file(const std::string& path) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof(address.sun_path)) return {{}, ENAMETOOLONG};
  std::memcpy(address.sun_path, path.c_str(), path.size() + 1);
  struct stat status {};
  if (::stat(path.c_str(), &status) == 0 && S_ISSOCK(status.st_mode)) {
    if (is_served(address)) return {{}, EADDRINUSE};
    ::unlink(path.c_str());
  }
  Descriptor fd(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  if (!fd.valid() || ::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0 ||
      ::chmod(path.c_str(), kSocketMode) != 0 || ::listen(fd.get(), kBacklog) != 0) {
    return {{}, errno};
  }
  return {std::move(fd), 0};
}

}  // namespace

LineListener::LineListener(Descriptor poll, Descriptor listener, bool datagrams,
                           std::filesystem::path socket_file) noexcept
    : poll_(std::move(poll)),
      listener_(std::move(listener)),
      spare_(open_spare()),
      datagrams_(datagrams),
      datagram_(datagrams ? kMaxDatagram : 0, '\0'),
      socket_file_(std::move(socket_file)) {}

LineListener::~LineListener() {
  if (!socket_file_.empty()) ::unlink(socket_file_.c_str());
}

ReadResult LineListener::read(std::span<std::uint8_t> out) {
  if (read_ == lines_.size()) {
    lines_.clear();
    read_ = 0;
    receive();
  }
  const std::size_t bytes = std::min(out.size(), lines_.size() - read_);
  std::memcpy(out.data(), lines_.data() + read_, bytes);
  read_ += bytes;
  return {bytes, false};
}

void LineListener::receive() {
  ++turns_;
  std::array<epoll_event, kMaxClients + 1> events{};
  const int count = ::epoll_wait(poll_.get(), events.data(), static_cast<int>(events.size()), 0);
  for (int i = 0; i < count; ++i) {
    const int fd = events.at(static_cast<std::size_t>(i)).data.fd;
    if (fd == listener_.get()) {
      if (datagrams_) {
        receive_datagrams();
      } else {
        accept_clients();
      }
      continue;
    }
    const auto client = std::find_if(clients_.begin(), clients_.end(),
                                     [fd](const Client& one) { return one.fd.get() == fd; });
    if (client != clients_.end() && !receive_from(*client)) clients_.erase(client);
  }
}

void LineListener::accept_clients() {
  for (int i = 0; i < kBacklog; ++i) {
    Client client{
        .fd = Descriptor(::accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC)),
        .line = {},
        .heard = turns_};
    if (!client.fd.valid()) {
      if (errno == EMFILE || errno == ENFILE) turn_away();
      return;
    }
    if (clients_.size() == kMaxClients) {
      clients_.erase(std::min_element(clients_.begin(), clients_.end(),
                                      [](const Client& a, const Client& b) { return a.heard < b.heard; }));
    }
    if (watch(poll_.get(), client.fd.get())) clients_.push_back(std::move(client));
  }
}

// Without a free descriptor, a client that waits would keep poll(2) from waiting.
void LineListener::turn_away() {
  spare_.close();
  Descriptor(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC)).close();
  spare_ = open_spare();
}

void LineListener::receive_datagrams() {
  while (lines_.size() < kMostLines) {
    const ssize_t n = ::recv(listener_.get(), datagram_.data(), datagram_.size(), MSG_DONTWAIT);
    if (n < 0) return;
    lines_.append(datagram_, 0, static_cast<std::size_t>(n));
    if (n > 0 && lines_.back() != '\n') lines_ += '\n';
  }
}

bool LineListener::receive_from(Client& client) {
  std::array<char, kMaxLine> buffer{};
  const ssize_t n = ::recv(client.fd.get(), buffer.data(), buffer.size(), MSG_DONTWAIT);
  if (n < 0) return errno == EAGAIN || errno == EINTR;
  if (n == 0) {
    if (!client.line.empty()) lines_ += client.line + "\n";
    return false;
  }
  client.heard = turns_;
  take(client, {buffer.data(), static_cast<std::size_t>(n)});
  return true;
}

void LineListener::take(Client& client, std::string_view text) {
  for (std::size_t end = 0; (end = text.find('\n')) != std::string_view::npos; text.remove_prefix(end + 1)) {
    if (!std::exchange(client.too_long, false)) lines_.append(client.line).append(text.substr(0, end + 1));
    client.line.clear();
  }
  if (client.too_long) return;
  client.line.append(text);
  if (client.line.size() <= kMaxLine) return;
  lines_ += client.line + "\n";
  client.line.clear();
  client.too_long = true;
}

OpenedLink open_line_listener(const std::string& path) {
  const auto network = parse_network_path(path);
  if (is_network_path(path) && (!network || network->local_port)) {
    return {nullptr, explain(path, EADDRNOTAVAIL)};
  }
  ListeningSocket listening =
      network ? listen_at(network->host, network->port, network->udp ? SOCK_DGRAM : SOCK_STREAM, kBacklog)
              : listen_at_file(path);
  if (!listening.fd.valid()) return {nullptr, explain(path, listening.error)};
  const std::filesystem::path socket_file = network ? "" : path;
  Descriptor poll(::epoll_create1(EPOLL_CLOEXEC));
  if (!poll.valid() || !watch(poll.get(), listening.fd.get())) {
    if (!network) ::unlink(path.c_str());
    return {nullptr, explain(path, errno)};
  }
  return {std::make_unique<LineListener>(std::move(poll), std::move(listening.fd), network && network->udp,
                                         socket_file),
          {}};
}

}  // namespace groma::link
