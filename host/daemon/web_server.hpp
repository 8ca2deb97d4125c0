// gromad's HTTP server (HTTP/1.1, GET and HEAD), on the event loop. It never waits for a client.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <string_view>

#include "host/daemon/event_loop.hpp"
#include "host/daemon/tcp_listener.hpp"
#include "host/link/byte_link.hpp"

namespace groma::daemon {

struct WebCounters {
  std::uint64_t accepted = 0;   // clients
  std::uint64_t refused = 0;    // more than kMaxClients
  std::uint64_t requests = 0;   // answered, with any status
  std::uint64_t timed_out = 0;  // clients that were silent, or did not take the answer
};

class WebServer {
 public:
  static constexpr std::size_t kMaxClients = 16;
  static constexpr std::size_t kMaxRequest = 8192;  // bytes of a request's header; it has no body
  static constexpr int kPatience_s = 10;            // for a request, and for the client to take the answer

  // Gives the content of a page; the view is valid until the next call.
  using Render = std::function<std::string_view()>;
  struct Opened {
    std::unique_ptr<WebServer> server;
    link::LinkError error;
  };
  [[nodiscard]] static Opened open(EventLoop& loop, const Endpoint& endpoint);
  ~WebServer();
  WebServer(const WebServer&) = delete;
  WebServer& operator=(const WebServer&) = delete;

  // Serves a page at that path, such as "/metrics". Other paths give 404.
  void serve(std::string path, std::string content_type, Render render);

  [[nodiscard]] std::uint16_t port() const noexcept { return listener_->port(); }
  [[nodiscard]] const WebCounters& counters() const noexcept { return counters_; }

 private:
  class Client;
  struct Page {
    std::string content_type;
    Render render;
  };

  WebServer() = default;
  void add(EventLoop& loop, io::Descriptor fd);

  std::map<std::string, Page, std::less<>> pages_;
  WebCounters counters_;
  std::set<Client*> clients_;  // each is owned by its operation on the loop
  std::unique_ptr<TcpListener> listener_;
};

}  // namespace groma::daemon
