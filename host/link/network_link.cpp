#include "host/link/network_link.hpp"

#include <fmt/format.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cstring>
#include <memory>
#include <thread>
#include <utility>

namespace groma::link {
namespace {

constexpr std::string_view kTcpScheme = "tcp://";
constexpr std::string_view kUdpScheme = "udp://";

// A peer that does not acknowledge for this long is gone. By hand: a few seconds, so that the link is opened
// again soon after its cable was plugged in.
constexpr int kUserTimeout_ms = 5000;
constexpr int kKeepAliveIdle_s = 2;
constexpr int kKeepAliveInterval_s = 1;
constexpr int kKeepAliveProbes = 3;
constexpr int kSynRetries = 2;  // 7 s in all

std::optional<std::uint16_t> parse_port(std::string_view text) noexcept {
  std::uint16_t port = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), port);
  if (error != std::errc() || end != text.data() + text.size() || port == 0) return std::nullopt;
  return port;
}

template <typename Value>
void try_option(int fd, int level, int option, const Value& value) noexcept {
  static_cast<void>(::setsockopt(fd, level, option, &value, sizeof(value)));
}

void set_tcp_options(int fd) noexcept {
  try_option(fd, SOL_SOCKET, SO_KEEPALIVE, 1);
  try_option(fd, IPPROTO_TCP, TCP_NODELAY, 1);
  try_option(fd, IPPROTO_TCP, TCP_KEEPIDLE, kKeepAliveIdle_s);
  try_option(fd, IPPROTO_TCP, TCP_KEEPINTVL, kKeepAliveInterval_s);
  try_option(fd, IPPROTO_TCP, TCP_KEEPCNT, kKeepAliveProbes);
  try_option(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, kUserTimeout_ms);
  try_option(fd, IPPROTO_TCP, TCP_SYNCNT, kSynRetries);
}

// Binds to that port at any address. False with errno set on failure.
bool bind_port(int fd, sa_family_t family, std::uint16_t port) noexcept {
  if (family == AF_INET6) {
    sockaddr_in6 any{};
    any.sin6_family = AF_INET6;
    any.sin6_port = htons(port);
    return ::bind(fd, reinterpret_cast<const sockaddr*>(&any), sizeof(any)) == 0;
  }
  sockaddr_in any{};
  any.sin_family = AF_INET;
  any.sin_port = htons(port);
  return ::bind(fd, reinterpret_cast<const sockaddr*>(&any), sizeof(any)) == 0;
}

// A connected UDP socket: receives from its peer only. It is never gone; a peer that is not there yet refuses
// datagrams, which is reported once.
class UdpLink : public ByteLink {
 public:
  UdpLink(Descriptor socket, std::string name) noexcept
      : socket_(std::move(socket)), name_(std::move(name)) {}

  [[nodiscard]] int poll_fd() const noexcept override { return socket_.get(); }

  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override {
    if (read_ == size_) receive();
    const std::size_t n = std::min(out.size(), size_ - read_);
    std::memcpy(out.data(), datagram_.data() + read_, n);
    read_ += n;
    return {n, false};
  }

  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override {
    const ssize_t n = ::send(socket_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    if (n < 0) note_error();
    return n > 0 ? static_cast<std::size_t>(n) : 0;
  }

  [[nodiscard]] std::string take_news() override { return std::exchange(news_, {}); }

 private:
  void receive() {
    read_ = 0;
    size_ = 0;
    const ssize_t n = ::recv(socket_.get(), datagram_.data(), datagram_.size(), MSG_DONTWAIT);
    if (n < 0) return note_error();
    size_ = static_cast<std::size_t>(n);
    refused_ = false;
  }
  void note_error() {
    if (errno != ECONNREFUSED || std::exchange(refused_, true)) return;
    news_ =
        fmt::format("{}: nothing listens at this port; check its number and the serial server's mode", name_);
  }

  Descriptor socket_;
  std::string name_;
  std::array<std::uint8_t, 65536> datagram_{};
  std::size_t size_ = 0;  // received
  std::size_t read_ = 0;
  bool refused_ = false;
  std::string news_;
};

}  // namespace

bool is_network_path(std::string_view path) noexcept {
  return path.starts_with(kTcpScheme) || path.starts_with(kUdpScheme);
}

std::optional<NetworkPath> parse_network_path(std::string_view path) {
  if (!is_network_path(path)) return std::nullopt;
  NetworkPath out;
  out.udp = path.starts_with(kUdpScheme);
  std::string_view rest = path.substr(kTcpScheme.size());
  if (const std::size_t slash = rest.find('/'); slash != std::string_view::npos) {
    out.local_port = parse_port(rest.substr(slash + 1));
    if (!out.udp || !out.local_port) return std::nullopt;
    rest = rest.substr(0, slash);
  }
  const std::size_t colon = rest.rfind(':');
  if (colon == std::string_view::npos) return std::nullopt;
  const auto port = parse_port(rest.substr(colon + 1));
  std::string_view host = rest.substr(0, colon);
  const bool bracketed = host.starts_with('[') && host.ends_with(']') && host.size() > 2;
  if (bracketed) host = host.substr(1, host.size() - 2);
  // Without brackets, the colons of an IPv6 address would hide where the port begins.
  if (!port || host.empty() || (!bracketed && host.find_first_of(":[] ") != std::string_view::npos)) {
    return std::nullopt;
  }
  out.host = host;
  out.port = *port;
  return out;
}

NetworkOpener::NetworkOpener(std::string path)
    : name_(std::move(path)),
      path_(parse_network_path(name_)),
      last_error_{LinkFault::kNoDevice,
                  fmt::format("{}: no answer yet; check the address, the serial server's "
                              "supply and the network",
                              name_)} {}

NetworkOpener::Resolution NetworkOpener::resolve(const NetworkPath& path, bool numeric) {
  addrinfo hints{};
  hints.ai_family = AF_UNSPEC;
  hints.ai_socktype = path.udp ? SOCK_DGRAM : SOCK_STREAM;
  hints.ai_flags = AI_NUMERICSERV | (numeric ? AI_NUMERICHOST : 0);
  addrinfo* found = nullptr;
  Resolution out;
  const int error = ::getaddrinfo(path.host.c_str(), fmt::format("{}", path.port).c_str(), &hints, &found);
  if (error != 0) out.error = ::gai_strerror(error);
  for (const addrinfo* one = found; one != nullptr; one = one->ai_next) {
    Address& address = out.addresses.emplace_back();
    address.size = std::min<socklen_t>(one->ai_addrlen, sizeof(address.value));
    std::memcpy(&address.value, one->ai_addr, address.size);
  }
  if (found != nullptr) ::freeaddrinfo(found);
  return out;
}

bool NetworkOpener::have_addresses() {
  if (!addresses_.empty()) return true;
  Resolution resolution;
  if (!resolution_.valid()) {
    resolution = resolve(*path_, /*numeric=*/true);
    if (resolution.addresses.empty()) {
      std::packaged_task<Resolution()> task([path = *path_] { return resolve(path, /*numeric=*/false); });
      resolution_ = task.get_future();
      // Not joined: a name server that does not answer would hold up the program's end.
      std::thread(std::move(task)).detach();
      return false;
    }
  } else {
    if (resolution_.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return false;
    resolution = resolution_.get();
  }
  addresses_ = std::move(resolution.addresses);
  if (addresses_.empty()) {
    last_error_ = {LinkFault::kNoDevice,
                   fmt::format("{}: the name '{}' has no address ({}); check it, or give a numeric address",
                               name_, path_->host, resolution.error)};
  }
  return !addresses_.empty();
}

bool NetworkOpener::connect(const Address& address) {
  const int type = path_->udp ? SOCK_DGRAM : SOCK_STREAM;
  const sa_family_t family = address.value.ss_family;
  socket_ = Descriptor(::socket(family, type | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  if (socket_.valid() && !path_->udp) set_tcp_options(socket_.get());
  const bool ready =
      socket_.valid() && (!path_->local_port || bind_port(socket_.get(), family, *path_->local_port));
  if (ready &&
      ::connect(socket_.get(), reinterpret_cast<const sockaddr*>(&address.value), address.size) == 0) {
    return true;
  }
  if (ready && errno == EINPROGRESS) return false;
  last_error_ = explain(errno);
  socket_.close();
  return false;
}

OpenedLink NetworkOpener::open() {
  if (!path_) {
    return {nullptr,
            {LinkFault::kUnsuitable, fmt::format("{}: is no address; {}", name_, kNetworkPathAdvice)}};
  }
  bool connected = false;
  if (socket_.valid()) {
    pollfd entry{socket_.get(), POLLOUT, 0};
    if (::poll(&entry, 1, 0) <= 0) return {nullptr, last_error_, /*pending=*/true};
    int error = 0;
    socklen_t size = sizeof(error);
    static_cast<void>(::getsockopt(socket_.get(), SOL_SOCKET, SO_ERROR, &error, &size));
    connected = error == 0;
    if (!connected) {
      last_error_ = explain(error);
      socket_.close();
      // The next call begins again.
      if (addresses_.empty()) return {nullptr, last_error_};
    }
  }
  if (!connected && have_addresses()) {
    const Address next = addresses_.front();
    addresses_.erase(addresses_.begin());
    connected = connect(next);
  }
  if (!connected) {
    const bool pending = socket_.valid() || resolution_.valid() || !addresses_.empty();
    return {nullptr, last_error_, pending};
  }
  addresses_.clear();
  if (path_->udp) return {std::make_unique<UdpLink>(std::move(socket_), name_), {}};
  return {std::make_unique<DescriptorLink>(std::move(socket_)), {}};
}

LinkError NetworkOpener::explain(int error_number) const {
  const char* const reason = std::strerror(error_number);
  switch (error_number) {
    case ECONNREFUSED:
      return {LinkFault::kNoDevice,
              fmt::format("{}: nothing listens at this port; check its number and the serial server's mode",
                          name_)};
    case EACCES:
    case EPERM:
      return {LinkFault::kPermission,
              fmt::format("{}: not permitted ({}); check what the firewall or the service manager forbids",
                          name_, reason)};
    case EADDRINUSE:
      return {LinkFault::kBusy, fmt::format("{}: port {} of this computer is in use; choose another", name_,
                                            path_->local_port.value_or(0))};
    default:
      return {
          LinkFault::kNoDevice,
          fmt::format("{}: no connection ({}); check the address, the serial server's supply and the network",
                      name_, reason)};
  }
}

OpenedLink open_network(const std::string& path) {
  constexpr auto kStep = std::chrono::milliseconds(10);
  NetworkOpener opener(path);
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(kNetworkPatience_s);
  OpenedLink opened = opener.open();
  while (opened.pending && std::chrono::steady_clock::now() < end) {
    std::this_thread::sleep_for(kStep);
    opened = opener.open();
  }
  return opened;
}

}  // namespace groma::link
