#include "host/daemon/pose_server.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/pose_message.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::daemon {
namespace {

using groma::test::TcpClient;
using nlohmann::json;

class PoseServerTest : public ::testing::Test {
 protected:
  PoseServer& open(const std::string& greeting) {
    PoseServer::Opened opened = PoseServer::open(loop_, {.address = "127.0.0.1", .port = 0}, greeting);
    server_ = std::move(opened.server);
    if (!server_) throw std::runtime_error(opened.error.message);
    return *server_;
  }

  EventLoop loop_;
  std::unique_ptr<PoseServer> server_;
};

TEST_F(PoseServerTest, GreetsAndServesEachClient) {
  PoseServer& server = open("hello\n");
  TcpClient first(server.port());
  TcpClient second(server.port());
  loop_.poll();
  EXPECT_EQ(first.receive(), "hello\n");
  server.on_line("a\n");
  server.on_line("b\n");
  EXPECT_EQ(first.receive(), "a\nb\n");
  EXPECT_EQ(second.receive(), "hello\na\nb\n");
  first.close();
  loop_.poll();
  EXPECT_EQ(server.client_count(), 1U);
  EXPECT_EQ(server.counters().disconnected, 1U);
  server.on_line("c\n");
  EXPECT_EQ(second.receive(), "c\n");
}

TEST_F(PoseServerTest, DoesNotWaitForASlowClient) {
  PoseServer& server = open("");
  TcpClient slow(server.port(), 4096);
  TcpClient quick(server.port());
  loop_.poll();
  const std::string line(1000, 'x');
  std::size_t received = 0;
  // The slow client reads nothing: its socket buffers, then its backlog fill up.
  for (int i = 0; i < 20'000 && server.client_count() == 2; ++i) {
    server.on_line(line + "\n");
    loop_.poll();
    received += quick.receive().size();
  }
  EXPECT_EQ(server.counters().too_slow, 1U);
  EXPECT_EQ(server.client_count(), 1U);
  EXPECT_GT(received, PoseServer::kMaxBacklog);
}

// A client that reads again in time gets all lines in order.
TEST_F(PoseServerTest, SendsWhatWaitedOnceTheClientReads) {
  PoseServer& server = open("");
  TcpClient client(server.port(), 4096);
  loop_.poll();
  std::string sent;
  for (int i = 0; server.waiting_bytes() < PoseServer::kMaxBacklog / 2; ++i) {
    ASSERT_LT(i, 20'000);
    const std::string line = std::to_string(i) + std::string(1000, 'x') + "\n";
    server.on_line(line);
    sent += line;
    loop_.poll();
  }
  std::string received;
  for (int i = 0; i < 1'000'000 && received.size() < sent.size(); ++i) {
    received += client.receive();
    loop_.poll();
  }
  EXPECT_EQ(server.waiting_bytes(), 0U);
  EXPECT_EQ(received, sent);
}

TEST_F(PoseServerTest, IgnoresDataFromAClient) {
  PoseServer& server = open("");
  const TcpClient noisy(server.port());
  TcpClient client(server.port());
  static_cast<void>(noisy.send(std::string(100'000, '?')));
  static_cast<void>(client.send("?"));
  loop_.poll();
  server.on_line("still there\n");
  EXPECT_EQ(client.receive(), "still there\n");
  EXPECT_EQ(server.client_count(), 2U);
}

// Clients that do not read fill their buffers, and give their places to others; a client that reads stays.
TEST_F(PoseServerTest, AClientThatReadsTakesThePlaceOfOneThatDoesNot) {
  PoseServer& server = open("hello\n");
  TcpClient reader(server.port());
  std::vector<std::unique_ptr<TcpClient>> silent;
  while (silent.size() + 1 < PoseServer::kMaxClients) {
    silent.push_back(std::make_unique<TcpClient>(server.port()));
    loop_.poll();
  }
  ASSERT_EQ(server.client_count(), PoseServer::kMaxClients);
  const std::string line(1000, 'x');
  std::size_t sent = 0;
  for (; server.waiting_bytes() < silent.size() * PoseServer::kBehind; ++sent) {
    // Some seconds of poses at 50 Hz, not minutes.
    ASSERT_LT(sent, 500U);
    server.on_line(line + "\n");
    loop_.poll();
    reader.receive();
  }
  ASSERT_EQ(server.counters().too_slow, 0U);
  std::vector<std::unique_ptr<TcpClient>> late;
  for (std::uint64_t i = 1; i <= 3; ++i) {
    late.push_back(std::make_unique<TcpClient>(server.port()));
    loop_.poll();
    EXPECT_EQ(late.back()->receive(), "hello\n");
    EXPECT_EQ(server.counters().too_slow, i);
  }
  EXPECT_EQ(server.counters().refused, 0U);
  server.on_line("still there\n");
  EXPECT_EQ(reader.receive(), "still there\n");
  EXPECT_FALSE(reader.ended());
  std::string log;
  server.log_events([&](std::string_view text) { log += text; });
  EXPECT_EQ(log, "pose stream: clients dropped so far because they did not read: 3");
}

TEST_F(PoseServerTest, RefusesClientsBeyondItsBound) {
  PoseServer& server = open("hello\n");
  std::vector<std::unique_ptr<TcpClient>> clients;
  for (std::size_t i = 0; i < PoseServer::kMaxClients + 3; ++i) {
    clients.push_back(std::make_unique<TcpClient>(server.port()));
    loop_.poll();
  }
  EXPECT_EQ(server.client_count(), PoseServer::kMaxClients);
  EXPECT_EQ(server.counters().refused, 3U);
  EXPECT_THAT(clients.back()->receive(), testing::StartsWith("hello\n{\"class\":\"REFUSED\","));
  static_cast<void>(clients.back()->receive());
  EXPECT_TRUE(clients.back()->ended());
  std::string log;
  server.log_events([&](std::string_view text) { log += text; });
  EXPECT_EQ(log, "pose stream: clients refused so far because 64 others read it: 3");
  const std::string before = log;
  server.log_events([&](std::string_view text) { log += text; });
  EXPECT_EQ(log, before);
}

TEST_F(PoseServerTest, ExplainsWhyItCannotListen) {
  const std::uint16_t port = open("").port();
  const auto second = PoseServer::open(loop_, {.address = "127.0.0.1", .port = port}, "");
  EXPECT_FALSE(second.server);
  EXPECT_EQ(second.error.fault, link::LinkFault::kBusy);
  EXPECT_THAT(second.error.message, testing::HasSubstr(std::to_string(port)));
  EXPECT_THAT(second.error.message, testing::HasSubstr("pose_stream"));
  const auto elsewhere = PoseServer::open(loop_, {.address = "192.0.2.1", .port = 0}, "");
  EXPECT_FALSE(elsewhere.server);
  EXPECT_EQ(elsewhere.error.fault, link::LinkFault::kNoDevice);
}

// Without a free descriptor the listener stays readable; the loop does not spin, and accepts the client
// later.
TEST(TcpListener, PausesWithoutDescriptors) {
  double now_s = 0.0;
  EventLoop loop([&] { return now_s; });
  std::size_t accepted = 0;
  const auto opened = TcpListener::open(loop, {.address = "127.0.0.1", .port = 0}, "pose_stream",
                                        [&](const io::Descriptor& /*client*/) { ++accepted; });
  ASSERT_TRUE(opened.listener) << opened.error.message;
  const TcpClient client(opened.listener->port());
  loop.poll();
  ASSERT_EQ(accepted, 1U);

  const TcpClient next(opened.listener->port());
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_NOFILE, &before), 0);
  const rlimit few{.rlim_cur = 64, .rlim_max = before.rlim_max};
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &few), 0);
  std::vector<io::Descriptor> all;
  do {
    all.emplace_back(::dup(STDERR_FILENO));
  } while (all.back().valid());
  loop.poll();  // returns, as nothing is ready any more
  loop.poll();
  EXPECT_EQ(accepted, 1U);
  all.clear();
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &before), 0);
  loop.poll();
  EXPECT_EQ(accepted, 1U);
  now_s += 1.0;
  loop.poll();
  loop.poll();
  EXPECT_EQ(accepted, 2U);
}

TEST(PoseMessage, UnknownTermsAreNull) {
  PoseEstimate pose;
  pose.t_s = 1.7e9 + 0.25;
  pose.x_m = 1.5;
  pose.covariance.setIdentity();
  pose.covariance(2, 2) = std::numeric_limits<double>::quiet_NaN();
  pose.covariance(0, 5) = 0.125;
  pose.state = filter::State::kTracking;
  pose.quaternion = {0.1, -0.2, 0.3, 0.9};
  pose.velocity = {1.25, -0.5, 0.75};
  pose.velocity_covariance << 1.0, 2.0, 3.0, 2.0, 4.0, 5.0, 3.0, 5.0, 6.0;
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
  EXPECT_EQ(object.at("quaternion"), json({0.1, -0.2, 0.3, 0.9}));
  EXPECT_EQ(object.at("child_frame"), "base_link");
  const json& twist = object.at("twist");
  EXPECT_EQ(twist.at("vx_mps"), 1.25);
  EXPECT_EQ(twist.at("vy_mps"), -0.5);
  EXPECT_EQ(twist.at("omega_radps"), 0.75);
  // Of vx, vy, vz and the rates about x, y, z; vz and the rates about x and y are unknown.
  const json none;
  EXPECT_EQ(twist.at("covariance"),
            json({1.0,  2.0,  none, none, none, 3.0,  2.0,  4.0,  none, none, none, 5.0,
                  none, none, none, none, none, none, none, none, none, none, none, none,
                  none, none, none, none, none, none, 3.0,  5.0,  none, none, none, 6.0}));
  EXPECT_EQ(json::parse(version_line()).at("class"), "VERSION");
  EXPECT_EQ(json::parse(status_line({.state = "TRACKING", .ranges = 5})).at("ranges"), 5);
  EXPECT_TRUE(json::parse(pose_line(pose, "m\xff", "schmidt")).is_object());
}

TEST(StatusMessage, HasTheStateOfEachLink) {
  Status status{.state = "TRACKING"};
  status.links.push_back(
      {.link = "can:can0/1", .round_trip_s = 0.001, .can = link::CanCounters{.bus_off = 2}});
  groma_Hello hello = groma_Hello_init_zero;
  hello.id = 7;
  hello.role = groma_Role_ROLE_TAG;
  hello.network_id = 42;
  status.links.push_back({.link = "/dev/ttyACM0", .error = "no such device"});
  status.robots = {{.link = "robot.sock"}};
  status.links.push_back({.link = "/dev/ttyACM1", .node = {.frames = 3, .tag_id = 8, .hello = &hello}});
  status.pairs.push_back({.tag_id = 7, .anchor_id = 100, .ranges = 2, .innovation_m2 = 0.04});
  status.pairs.push_back({.tag_id = 7, .anchor_id = 101});
  const json object = json::parse(status_line(status));
  const json& can = object.at("links")[0];
  EXPECT_EQ(can.at("link"), "can:can0/1");
  EXPECT_EQ(can.at("open"), true);
  EXPECT_TRUE(can.at("error").is_null());
  EXPECT_EQ(can.at("round_trip_s"), 0.001);
  EXPECT_EQ(can.at("can").at("bus_off"), 2);
  EXPECT_EQ(can.at("can").at("error_frames"), 0);
  const json& serial = object.at("links")[1];
  EXPECT_EQ(serial.at("open"), false);
  EXPECT_EQ(serial.at("error"), "no such device");
  EXPECT_TRUE(serial.at("round_trip_s").is_null());
  EXPECT_FALSE(serial.contains("can"));
  const json socket{{"link", "robot.sock"}, {"open", true}, {"error", nullptr}};
  EXPECT_EQ(object.at("robot"), socket);
  EXPECT_FALSE(object.contains("robots"));
  status.robots.push_back({.link = "udp://127.0.0.1:4723"});
  const json both = json::parse(status_line(status));
  EXPECT_EQ(both.at("robot"), socket);
  EXPECT_EQ(both.at("robots")[0], socket);
  EXPECT_EQ(both.at("robots")[1].at("link"), "udp://127.0.0.1:4723");
  EXPECT_TRUE(serial.at("node").at("id").is_null());
  const json& node = object.at("links")[2];
  EXPECT_EQ(node.at("frames"), 3);
  EXPECT_EQ(node.at("node").at("id"), 7) << "as the node says, not as its ranges do";
  EXPECT_EQ(node.at("node").at("role"), "tag");
  EXPECT_EQ(node.at("node").at("network_id"), 42);
  EXPECT_TRUE(node.at("node").at("sync").is_null());
  EXPECT_DOUBLE_EQ(object.at("pairs")[0].at("innovation_m"), 0.2);
  EXPECT_TRUE(object.at("pairs")[1].at("innovation_m").is_null());
  EXPECT_TRUE(object.at("t_s").is_null());
}

}  // namespace
}  // namespace groma::daemon
