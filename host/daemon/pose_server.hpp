// Serves lines to any number of TCP clients, and waits for none of them.
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
  std::uint64_t disconnected = 0;  // went by themselves
  std::uint64_t too_slow = 0;      // were dropped
};

class PoseServer {
 public:
  static constexpr std::size_t kMaxClients = 64;
  static constexpr std::size_t kMaxBacklog = 262'144;  // bytes that may wait for one client

  struct Opened {
    std::unique_ptr<PoseServer> server;
    link::LinkError error;
  };
  // address: numeric, IPv4 or IPv6; port 0: any that is free. Each client is greeted with `greeting`.
  [[nodiscard]] static Opened open(const std::string& address, std::uint16_t port, std::string greeting);

  [[nodiscard]] std::uint16_t port() const noexcept { return port_; }
  [[nodiscard]] std::size_t client_count() const noexcept { return clients_.size(); }
  [[nodiscard]] const PoseServerCounters& counters() const noexcept { return counters_; }

  // Appends what is to be polled for.
  void append_poll(std::vector<pollfd>& out) const;
  // Accepts who has come, lets go who has left, sends what waits. Never blocks.
  void service();
  // To all clients; one that has more than kMaxBacklog waiting is dropped.
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
