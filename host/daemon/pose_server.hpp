// Sends lines to TCP clients and never waits for any of them.
#pragma once

#include <poll.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"

namespace groma::daemon {

struct PoseServerCounters {
  std::uint64_t accepted = 0;
  std::uint64_t refused = 0;       // more than kMaxClients
  std::uint64_t disconnected = 0;  // closed by the client
  std::uint64_t too_slow = 0;      // dropped by the server
};

class PoseServer {
 public:
  static constexpr std::size_t kMaxClients = 64;
  static constexpr std::size_t kMaxBacklog = 262'144;  // bytes that may wait for one client

  struct Opened {
    std::unique_ptr<PoseServer> server;
    link::LinkError error;
  };
  // address: numeric, IPv4 or IPv6; port 0: any free one. `greeting` is the first line to each client.
  [[nodiscard]] static Opened open(const std::string& address, std::uint16_t port, std::string greeting);

  [[nodiscard]] std::uint16_t port() const noexcept { return port_; }
  [[nodiscard]] std::size_t client_count() const noexcept { return clients_.size(); }
  [[nodiscard]] const PoseServerCounters& counters() const noexcept { return counters_; }

  // Appends the descriptors and events to poll for.
  void append_poll(std::vector<pollfd>& out) const;
  // Accepts new clients, removes those that left, sends waiting bytes. Never blocks.
  void service();
  // Sends to all clients; drops a client with more than kMaxBacklog bytes waiting.
  void broadcast(std::string_view line);

 private:
  struct Client {
    io::Descriptor fd;
    std::string waiting;
    bool gone = false;
  };

  PoseServer(io::Descriptor listener, std::uint16_t port, std::string greeting);
  void accept_clients();
  void queue(Client& client, std::string_view line);
  void send_waiting(Client& client);
  void drop(Client& client, std::uint64_t& counter);

  io::Descriptor listener_;
  std::uint16_t port_;
  std::string greeting_;
  std::vector<Client> clients_;
  PoseServerCounters counters_;
};

}  // namespace groma::daemon
