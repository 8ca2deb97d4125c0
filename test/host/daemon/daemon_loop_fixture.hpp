// Fixture of tests that run the daemon in their own process, on an injected clock.
#pragma once

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "host/daemon/daemon.hpp"
#include "test/host/daemon/circle_drive.hpp"
#include "test/host/daemon/prometheus_parser.hpp"
#include "test/host/daemon/temporary_folder.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::daemon {

using groma::test::TcpClient;
using groma::test::TemporaryFolder;
using test::CircleDrive;
using test::Labels;
using ::testing::HasSubstr;
using ::testing::StartsWith;

// The other side of a link.
class Peer {
 public:
  explicit Peer(const std::filesystem::path& path)
      : listener_(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0)) {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    path.string().copy(address.sun_path, sizeof(address.sun_path) - 1);
    if (::bind(listener_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0 ||
        ::listen(listener_.get(), 4) != 0) {
      throw std::runtime_error(path.string());
    }
  }
  void accept() { peer_ = io::Descriptor(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC)); }
  void send(const std::vector<std::uint8_t>& bytes) const {
    ASSERT_EQ(::send(peer_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT),
              static_cast<ssize_t>(bytes.size()));
  }
  void hang_up() { peer_.close(); }

 private:
  io::Descriptor listener_;
  io::Descriptor peer_;
};

class DaemonLoop : public ::testing::Test {
 protected:
  DaemonLoop() {
    config_.nodes[0].path = folder_ / "tag-1";
    config_.robot_socket = folder_ / "robot.sock";
    config_.web.emplace().endpoint.port = 0;
  }

  void start() {
    log_.clear();
    now_s_ = CircleDrive::kBegin_s;
    daemon_ = std::make_unique<Daemon>(
        config_, calibration_, [this](std::string_view text) { log_ += std::string(text) + "\n"; },
        [this] { return now_s_; });
    const link::LinkError error = daemon_->open();
    if (error.fault != link::LinkFault::kNone) throw std::runtime_error(error.message);
    tag_.accept();
    robot_.accept();
    daemon_->poll();
  }
  // Gives the daemon the part of the drive up to that time; after each arrival calls `then`.
  template <typename Then>
  void run(double duration_s, Then then) {
    for (const CircleDrive::Arrival& arrival : drive_.arrivals(duration_s)) {
      if (arrival.host_s <= now_s_) continue;
      now_s_ = arrival.host_s;
      (arrival.robot ? robot_ : tag_).send(arrival.bytes);
      daemon_->poll();
      then(arrival);
    }
  }
  // The port that the log names.
  [[nodiscard]] std::uint16_t port(const std::string& of) const {
    const std::string key = of + " on 127.0.0.1 port ";
    return static_cast<std::uint16_t>(std::stoi(log_.substr(log_.find(key) + key.size())));
  }
  std::string get(const std::string& path) {
    TcpClient client(daemon_->web_port());
    EXPECT_TRUE(client.send("GET " + path + " HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"));
    std::string text;
    for (int i = 0; i < 1000 && !client.ended(); ++i) {
      daemon_->poll();
      text += client.receive();
    }
    return text;
  }
  std::map<std::string, test::MetricFamily> metrics() {
    now_s_ += 0.2;  // /metrics may be 0.1 s old
    const std::string answer = get("/metrics");
    EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 "));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n"));
    return test::PrometheusParser::parse(answer.substr(answer.find("\r\n\r\n") + 4));
  }
  static double value(const std::map<std::string, test::MetricFamily>& of, const std::string& name,
                      const Labels& labels = {}) {
    return of.at(name).samples.at(name).at(labels);
  }

  static std::string poses_of(const std::string& stream) {
    std::string poses;
    std::istringstream lines(stream);
    for (std::string line; std::getline(lines, line);) {
      if (line.starts_with("{\"class\":\"POSE\"")) poses += line + "\n";
    }
    return poses;
  }
  static std::size_t lines_of(const std::string& text) {
    return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
  }

  TemporaryFolder folder_;
  CircleDrive drive_;
  Config config_ = drive_.config();
  model::Calibration calibration_ = drive_.surveyed();
  Peer tag_{folder_ / "tag-1"};
  Peer robot_{folder_ / "robot.sock"};
  double now_s_ = 0.0;
  std::string log_;
  std::unique_ptr<Daemon> daemon_;
};

}  // namespace groma::daemon
