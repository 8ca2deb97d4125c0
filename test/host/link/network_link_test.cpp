#include "host/link/network_link.hpp"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <chrono>
#include <functional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "host/link/reconnecting_link.hpp"

namespace groma::link {
namespace {

using ::testing::HasSubstr;

bool soon(const std::function<bool()>& done) {
  const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(20);
  while (!done()) {
    if (std::chrono::steady_clock::now() > deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  return true;
}

// A serial server on this computer, at a free port of its own or at a given one.
class SerialServer {
 public:
  explicit SerialServer(int type, std::uint16_t port = 0) : type_(type) { serve(port); }

  void serve(std::uint16_t port) {
    socket_ = Descriptor(::socket(AF_INET, type_ | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
    const int on = 1;
    ::setsockopt(socket_.get(), SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t size = sizeof(address);
    if (::bind(socket_.get(), reinterpret_cast<const sockaddr*>(&address), size) != 0 ||
        (type_ == SOCK_STREAM && ::listen(socket_.get(), 4) != 0) ||
        ::getsockname(socket_.get(), reinterpret_cast<sockaddr*>(&address), &size) != 0) {
      throw std::runtime_error("no serial server");
    }
    port_ = ntohs(address.sin_port);
  }
  bool accept() {
    const int fd = ::accept4(socket_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd >= 0) client_ = Descriptor(fd);
    return fd >= 0;
  }
  // Resets the connection, as a server that loses its supply and comes back does.
  void break_connection() {
    const linger at_once{1, 0};
    ::setsockopt(client_.get(), SOL_SOCKET, SO_LINGER, &at_once, sizeof(at_once));
    client_.close();
  }
  void stop() {
    client_.close();
    socket_.close();
  }
  void send(const std::string& text) const {
    ASSERT_EQ(::send(client_.get(), text.data(), text.size(), MSG_NOSIGNAL),
              static_cast<ssize_t>(text.size()));
  }
  // The next bytes from the client, of UDP with its address.
  std::string receive(sockaddr_in& from) const {
    char buffer[2048];
    ssize_t n = 0;
    socklen_t size = sizeof(from);
    const int fd = type_ == SOCK_STREAM ? client_.get() : socket_.get();
    const bool came = soon([&] {
      n = ::recvfrom(fd, buffer, sizeof(buffer), MSG_DONTWAIT, reinterpret_cast<sockaddr*>(&from), &size);
      return n > 0;
    });
    return came ? std::string(buffer, static_cast<std::size_t>(n)) : "nothing";
  }
  void send_to(const sockaddr_in& to, const std::string& text) const {
    ASSERT_EQ(::sendto(socket_.get(), text.data(), text.size(), 0, reinterpret_cast<const sockaddr*>(&to),
                       sizeof(to)),
              static_cast<ssize_t>(text.size()));
  }
  [[nodiscard]] std::uint16_t port() const { return port_; }
  [[nodiscard]] std::string path(const std::string& scheme, const std::string& host = "127.0.0.1") const {
    return scheme + "://" + host + ":" + std::to_string(port_);
  }

 private:
  int type_;
  Descriptor socket_;
  Descriptor client_;
  std::uint16_t port_ = 0;
};

std::vector<std::uint8_t> bytes_of(const std::string& text) {
  return {text.begin(), text.end()};
}

std::string read_soon(ByteLink& link) {
  std::vector<std::uint8_t> buffer(70000);
  std::string text;
  soon([&] {
    const ReadResult result = link.read(buffer);
    text.append(buffer.begin(), buffer.begin() + static_cast<std::ptrdiff_t>(result.bytes));
    return !text.empty() || result.gone;
  });
  return text;
}

TEST(NetworkPath, HasAProtocolAHostAndAPort) {
  const auto tcp = parse_network_path("tcp://gate.local:4001");
  ASSERT_TRUE(tcp);
  EXPECT_FALSE(tcp->udp);
  EXPECT_EQ(tcp->host, "gate.local");
  EXPECT_EQ(tcp->port, 4001);
  EXPECT_FALSE(tcp->local_port);
  const auto udp = parse_network_path("udp://[fe80::1%eth0]:65535/7000");
  ASSERT_TRUE(udp);
  EXPECT_TRUE(udp->udp);
  EXPECT_EQ(udp->host, "fe80::1%eth0");
  EXPECT_EQ(udp->port, 65535);
  EXPECT_EQ(udp->local_port, 7000);
  for (const char* wrong :
       {"tcp://", "tcp://host", "tcp://host:", "tcp://:4001", "tcp://host:0", "tcp://host:65536",
        "tcp://host:+1", "tcp://host:1x", "tcp://::1:4001", "tcp://[::1]", "tcp://[]:1", "tcp://a b:1",
        "tcp://host:1/2", "udp://host:1/", "udp://host:1/0", "tcp:host:1", "/dev/tcp", ""}) {
    EXPECT_FALSE(parse_network_path(wrong)) << wrong;
  }
  EXPECT_TRUE(is_network_path("udp://"));
  EXPECT_FALSE(is_network_path("can:can0/1"));
  const OpenedLink opened = open_link("tcp://host", 0);
  EXPECT_EQ(opened.error.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(opened.error.message, HasSubstr("tcp://host: is no address; write it as tcp://HOST:PORT"));
}

TEST(TcpLink, CarriesBytesBothWaysByAddressAndByName) {
  for (const std::string host : {"127.0.0.1", "localhost"}) {
    SerialServer server(SOCK_STREAM);
    const OpenedLink opened = open_link(server.path("tcp", host), 0);
    ASSERT_TRUE(opened.link) << opened.error.message;
    ASSERT_TRUE(soon([&] { return server.accept(); }));
    std::string all;
    for (int i = 0; i < 256; ++i) all.push_back(static_cast<char>(i));
    server.send(all);
    EXPECT_EQ(read_soon(*opened.link), all);
    EXPECT_EQ(opened.link->write(bytes_of(all)), all.size());
    sockaddr_in from{};
    EXPECT_EQ(server.receive(from), all);
    server.break_connection();
    EXPECT_EQ(read_soon(*opened.link), "");
    std::uint8_t byte = 0;
    EXPECT_TRUE(opened.link->read({&byte, 1}).gone);
  }
}

TEST(TcpLink, ExplainsWhyThereIsNone) {
  SerialServer server(SOCK_STREAM);
  const std::string path = server.path("tcp");
  server.stop();
  const OpenedLink opened = open_link(path, 0);
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kNoDevice);
  EXPECT_THAT(opened.error.message, HasSubstr(path + ": nothing listens at this port"));
  // A name that is too long for a name server to be asked.
  const OpenedLink unknown = open_link("tcp://" + std::string(300, 'x') + ":4001", 0);
  EXPECT_FALSE(unknown.link);
  EXPECT_EQ(unknown.error.fault, LinkFault::kNoDevice);
  EXPECT_THAT(unknown.error.message, HasSubstr("has no address"));
}

TEST(TcpLink, NeverBlocksWhileItConnects) {
  // Connections beyond the backlog of a server that does not accept are not answered.
  const Descriptor full(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t size = sizeof(address);
  ASSERT_EQ(::bind(full.get(), reinterpret_cast<const sockaddr*>(&address), size), 0);
  ASSERT_EQ(::listen(full.get(), 0), 0);
  ASSERT_EQ(::getsockname(full.get(), reinterpret_cast<sockaddr*>(&address), &size), 0);
  const std::string path = "tcp://127.0.0.1:" + std::to_string(ntohs(address.sin_port));
  std::vector<OpenedLink> taken;
  bool pending = false;
  for (int i = 0; i < 8 && !pending; ++i) {
    NetworkOpener opener(path);
    OpenedLink opened;
    for (int attempt = 0; attempt < 50 && !opened.link; ++attempt) {
      const auto begin = std::chrono::steady_clock::now();
      opened = opener.open();
      // The machine may be busy; a blocking connect() takes a second or more.
      EXPECT_LT(std::chrono::steady_clock::now() - begin, std::chrono::milliseconds(500));
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    pending = !opened.link && opened.pending;
    if (pending) {
      EXPECT_THAT(opened.error.message, HasSubstr("no answer yet"));
    }
    taken.push_back(std::move(opened));
  }
  EXPECT_TRUE(pending);
}

TEST(TcpLink, ComesBackWhenTheServerDoes) {
  SerialServer server(SOCK_STREAM);
  const std::uint16_t port = server.port();
  const std::string path = server.path("tcp");
  server.stop();
  ReconnectingLink link(link_opener(path, 0));
  double now_s = 0.0;
  const auto tries = [&](int times) {
    for (int i = 0; i < times && link.get() == nullptr; ++i) {
      now_s = std::max(now_s, link.next_attempt_s());
      static_cast<void>(link.service(now_s));
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    return link.get() != nullptr;
  };
  EXPECT_FALSE(tries(20));
  EXPECT_THAT(link.last_error().message, HasSubstr("nothing listens"));
  for (std::uint32_t round = 1; round <= 3; ++round) {
    server.serve(port);
    ASSERT_TRUE(tries(1000)) << link.last_error().message;
    EXPECT_EQ(link.last_error().fault, LinkFault::kNone);
    ASSERT_TRUE(soon([&] { return server.accept(); }));
    server.send("again");
    std::uint8_t buffer[16];
    EXPECT_TRUE(soon([&] { return link.read(buffer, now_s).bytes == 5; }));
    server.stop();
    EXPECT_TRUE(soon([&] { return link.read(buffer, now_s).gone; }));
    EXPECT_EQ(link.counters().lost, round);
  }
}

TEST(UdpLink, CarriesDatagramsOfItsPeerOnly) {
  const SerialServer server(SOCK_DGRAM);
  const SerialServer stranger(SOCK_DGRAM);
  const OpenedLink opened = open_link(server.path("udp"), 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  EXPECT_EQ(opened.link->write(bytes_of("hello")), 5U);
  sockaddr_in from{};
  EXPECT_EQ(server.receive(from), "hello");
  stranger.send_to(from, "nonsense");
  const std::string large(60'000, 'x');
  server.send_to(from, large);
  EXPECT_EQ(read_soon(*opened.link), large);
  // A datagram that is larger than the reader's buffer.
  server.send_to(from, "0123456789");
  std::uint8_t buffer[4];
  std::string text;
  soon([&] {
    const ReadResult result = opened.link->read(buffer);
    text.append(buffer, buffer + result.bytes);
    return text.size() >= 10;
  });
  EXPECT_EQ(text, "0123456789");
}

TEST(UdpLink, ReceivesAtAPortOfItsOwn) {
  const SerialServer server(SOCK_DGRAM);
  SerialServer free(SOCK_DGRAM);
  const std::uint16_t local = free.port();
  const std::string path = server.path("udp") + "/" + std::to_string(local);
  const OpenedLink taken = open_link(path, 0);
  EXPECT_FALSE(taken.link);
  EXPECT_EQ(taken.error.fault, LinkFault::kBusy);
  EXPECT_THAT(taken.error.message,
              HasSubstr("port " + std::to_string(local) + " of this computer is in use"));
  free.stop();
  const OpenedLink opened = open_link(path, 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(local);
  to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  server.send_to(to, "unasked");
  EXPECT_EQ(read_soon(*opened.link), "unasked");
}

TEST(UdpLink, SaysOnceThatNobodyListensAndContinues) {
  SerialServer server(SOCK_DGRAM);
  const std::uint16_t port = server.port();
  const std::string path = server.path("udp");
  server.stop();
  const OpenedLink opened = open_link(path, 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  std::uint8_t buffer[64];
  std::string news;
  ASSERT_TRUE(soon([&] {
    static_cast<void>(opened.link->write(bytes_of("?")));
    EXPECT_FALSE(opened.link->read(buffer).gone);
    news = opened.link->take_news();
    return !news.empty();
  }));
  EXPECT_THAT(news, HasSubstr(path + ": nothing listens at this port"));
  for (int i = 0; i < 10; ++i) {
    static_cast<void>(opened.link->write(bytes_of("?")));
    static_cast<void>(opened.link->read(buffer));
  }
  EXPECT_EQ(opened.link->take_news(), "");
  server.serve(port);
  ASSERT_TRUE(soon([&] { return opened.link->write(bytes_of("!")) == 1; }));
  sockaddr_in from{};
  EXPECT_EQ(server.receive(from), "!");
  server.send_to(from, "here");
  EXPECT_EQ(read_soon(*opened.link), "here");
}

}  // namespace
}  // namespace groma::link
