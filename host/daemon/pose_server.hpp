// The pose stream: sends lines to TCP clients and never waits for any of them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "host/daemon/event_loop.hpp"
#include "host/daemon/log_doubling.hpp"
#include "host/daemon/output.hpp"
#include "host/daemon/tcp_listener.hpp"
#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"

namespace groma::daemon {

struct PoseServerCounters {
  std::uint64_t accepted = 0;
  std::uint64_t refused = 0;       // kMaxClients others read
  std::uint64_t disconnected = 0;  // closed by the client
  std::uint64_t too_slow = 0;      // dropped by the server: did not read
};

class PoseServer : public Output {
 public:
  static constexpr std::size_t kMaxClients = 64;
  static constexpr std::size_t kMaxBacklog = 262'144;  // bytes that may wait for one client
  // A client with at least this much waiting gives its place to a new one.
  static constexpr std::size_t kBehind = 16'384;

  struct Opened {
    std::unique_ptr<PoseServer> server;
    link::LinkError error;
  };
  // `greeting` is the first line to each client. The loop has to outlive the server.
  [[nodiscard]] static Opened open(EventLoop& loop, const Endpoint& endpoint, std::string greeting);
  ~PoseServer() override;

  [[nodiscard]] std::uint16_t port() const noexcept { return listener_->port(); }
  [[nodiscard]] std::size_t client_count() const noexcept { return clients_.size(); }
  // Bytes that wait for clients.
  [[nodiscard]] std::size_t waiting_bytes() const noexcept;
  [[nodiscard]] const PoseServerCounters& counters() const noexcept { return counters_; }

  void on_pose(const PoseEstimate& /*pose*/, std::string_view line) override { on_line(line); }
  // Logs refused and dropped clients, and a lack of descriptors, since the last call; not each one.
  void log_events(const std::function<void(std::string_view)>& log);
  // Sends to all clients; drops a client with more than kMaxBacklog bytes waiting.
  void on_line(std::string_view line) override;

 private:
  struct Client;

  explicit PoseServer(std::string greeting);
  void add(EventLoop& loop, io::Descriptor fd);
  // Drops the client that is furthest behind; false if all of them read.
  bool make_place();
  void read(Client& client);
  void queue(Client& client, std::string_view line);
  void send_waiting(Client& client);
  void drop(Client& client, std::uint64_t& counter);
  void remove_gone();

  std::unique_ptr<TcpListener> listener_;
  std::string greeting_;
  std::vector<std::unique_ptr<Client>> clients_;
  PoseServerCounters counters_;
  LogDoubling refused_;
  LogDoubling too_slow_;
  LogDoubling pauses_;
};

}  // namespace groma::daemon
