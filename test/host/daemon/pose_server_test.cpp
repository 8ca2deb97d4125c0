#include "host/daemon/pose_server.hpp"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <chrono>
#include <limits>
#include <string>
#include <thread>

#include <nlohmann/json.hpp>

#include "host/daemon/pose_message.hpp"

namespace groma::daemon {
namespace {

using nlohmann::json;

class Client {
 public:
  explicit Client(std::uint16_t port, int receive_buffer = 0) : fd_(::socket(AF_INET, SOCK_STREAM, 0)) {
    if (receive_buffer > 0) {
      ::setsockopt(fd_.get(), SOL_SOCKET, SO_RCVBUF, &receive_buffer, sizeof(receive_buffer));
    }
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    connected = ::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) == 0;
  }
  // Returns the first bytes that come within 0.1 s.
  std::string read() {
    std::string text;
    for (int i = 0; i < 20; ++i) {
      char buffer[4096];
      ssize_t n = 0;
      while ((n = ::recv(fd_.get(), buffer, sizeof(buffer), MSG_DONTWAIT)) > 0) {
        text.append(buffer, static_cast<std::size_t>(n));
      }
      ended = n == 0;
      if (!text.empty() || ended) break;
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    return text;
  }
  void close() { fd_.close(); }
  [[nodiscard]] int fd() const { return fd_.get(); }

  bool connected = false;
  bool ended = false;

 private:
  io::Descriptor fd_;
};

void settle(PoseServer& server) {
  for (int i = 0; i < 10; ++i) {
    server.service();
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
}

TEST(PoseServer, GreetsAndServesEachClient) {
  auto opened = PoseServer::open("127.0.0.1", 0, "hello\n");
  ASSERT_TRUE(opened.server) << opened.error.message;
  PoseServer& server = *opened.server;
  Client first(server.port());
  Client second(server.port());
  ASSERT_TRUE(first.connected && second.connected);
  settle(server);
  EXPECT_EQ(first.read(), "hello\n");
  server.broadcast("a\n");
  server.broadcast("b\n");
  EXPECT_EQ(first.read(), "a\nb\n");
  EXPECT_EQ(second.read(), "hello\na\nb\n");
  first.close();
  settle(server);
  EXPECT_EQ(server.client_count(), 1U);
  EXPECT_EQ(server.counters().disconnected, 1U);
  server.broadcast("c\n");
  EXPECT_EQ(second.read(), "c\n");
}

TEST(PoseServer, DoesNotWaitForASlowClient) {
  auto opened = PoseServer::open("127.0.0.1", 0, "");
  ASSERT_TRUE(opened.server);
  PoseServer& server = *opened.server;
  Client slow(server.port(), 4096);
  Client quick(server.port());
  settle(server);
  const std::string line(1000, 'x');
  std::size_t received = 0;
  // The slow client reads nothing: its socket buffers, then its backlog fill up.
  for (int i = 0; i < 20'000 && server.client_count() == 2; ++i) {
    server.broadcast(line + "\n");
    server.service();
    received += quick.read().size();
  }
  EXPECT_EQ(server.counters().too_slow, 1U);
  EXPECT_EQ(server.client_count(), 1U);
  EXPECT_GT(received, PoseServer::kMaxBacklog);
}

TEST(PoseServer, IgnoresDataFromAClient) {
  auto opened = PoseServer::open("127.0.0.1", 0, "");
  ASSERT_TRUE(opened.server);
  Client client(opened.server->port());
  const std::string noise(100'000, '?');
  ::send(client.fd(), noise.data(), noise.size(), MSG_DONTWAIT);
  settle(*opened.server);
  opened.server->broadcast("still there\n");
  EXPECT_EQ(client.read(), "still there\n");
}

TEST(PoseServer, RefusesClientsBeyondItsBound) {
  auto opened = PoseServer::open("127.0.0.1", 0, "");
  ASSERT_TRUE(opened.server);
  std::vector<std::unique_ptr<Client>> clients;
  for (std::size_t i = 0; i < PoseServer::kMaxClients + 3; ++i) {
    clients.push_back(std::make_unique<Client>(opened.server->port()));
    opened.server->service();
  }
  settle(*opened.server);
  EXPECT_EQ(opened.server->client_count(), PoseServer::kMaxClients);
  EXPECT_EQ(opened.server->counters().refused, 3U);
  clients.back()->read();
  EXPECT_TRUE(clients.back()->ended);
}

TEST(PoseServer, ExplainsWhyItCannotListen) {
  auto first = PoseServer::open("127.0.0.1", 0, "");
  ASSERT_TRUE(first.server);
  const auto second = PoseServer::open("127.0.0.1", first.server->port(), "");
  EXPECT_FALSE(second.server);
  EXPECT_EQ(second.error.fault, link::LinkFault::kBusy);
  EXPECT_THAT(second.error.message, testing::HasSubstr(std::to_string(first.server->port())));
  const auto elsewhere = PoseServer::open("192.0.2.1", 0, "");
  EXPECT_FALSE(elsewhere.server);
  EXPECT_EQ(elsewhere.error.fault, link::LinkFault::kNoDevice);
}

TEST(PoseMessage, UnknownTermsAreNull) {
  PoseEstimate pose;
  pose.t_s = 1.7e9 + 0.25;
  pose.x_m = 1.5;
  pose.covariance.setIdentity();
  pose.covariance(2, 2) = std::numeric_limits<double>::quiet_NaN();
  pose.covariance(0, 5) = 0.125;
  pose.state = filter::State::kTracking;
  const std::string line = pose_line(pose, "map", "schmidt");
  EXPECT_EQ(line.back(), '\n');
  EXPECT_EQ(line.find('\n'), line.size() - 1);
  const json object = json::parse(line);
  EXPECT_EQ(object.at("class"), "POSE");
  EXPECT_EQ(object.at("t_s"), 1.7e9 + 0.25);
  EXPECT_EQ(object.at("state"), "TRACKING");
  EXPECT_EQ(object.at("x_m"), 1.5);
  ASSERT_EQ(object.at("covariance").size(), 36U);
  EXPECT_EQ(object.at("covariance")[5], 0.125);
  EXPECT_TRUE(object.at("covariance")[14].is_null());
  EXPECT_EQ(json::parse(version_line()).at("class"), "VERSION");
  EXPECT_EQ(json::parse(status_line({.state = "TRACKING", .ranges = 5})).at("ranges"), 5);
  EXPECT_TRUE(json::parse(pose_line(pose, "m\xff", "schmidt")).is_object());
}

}  // namespace
}  // namespace groma::daemon
