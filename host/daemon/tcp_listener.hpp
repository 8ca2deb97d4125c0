// Accepts TCP clients on the event loop.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "host/daemon/event_loop.hpp"
#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"

namespace groma::daemon {

// A numeric address, IPv4 or IPv6, and a port; 0: any free one.
struct Endpoint {
  std::string address = "127.0.0.1";
  std::uint16_t port = 0;
};

// As in a URL: "127.0.0.1:8080", "[::1]:8080".
[[nodiscard]] std::string authority(const std::string& address, std::uint16_t port);

class TcpListener {
 public:
  // Takes an accepted client, which does not block.
  using Accepted = std::function<void(io::Descriptor)>;
  struct Opened {
    std::unique_ptr<TcpListener> listener;
    link::LinkError error;
  };
  // key: of the endpoint in the configuration, for messages.
  [[nodiscard]] static Opened open(EventLoop& loop, const Endpoint& endpoint, std::string_view key,
                                   Accepted accepted);

  [[nodiscard]] std::uint16_t port() const noexcept { return port_; }
  // How often it had to pause, because no descriptor or memory was free.
  [[nodiscard]] std::uint64_t pauses() const noexcept { return pauses_; }

 private:
  // Without free descriptors the listener stays readable: accept no client for this time.
  static constexpr double kPause_s = 1.0;
  static constexpr int kAcceptsPerTurn = 16;

  TcpListener(EventLoop& loop, io::Descriptor listener, std::uint16_t port, Accepted accepted);
  void listen();
  void accept();

  EventLoop& loop_;
  io::Descriptor listener_;
  std::uint16_t port_;
  Accepted accepted_;
  std::uint64_t pauses_ = 0;
  std::optional<EventLoop::Watch> watch_;  // none: pauses
  EventLoop::Timer resume_;
};

}  // namespace groma::daemon
