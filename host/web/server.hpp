// An HTTP and WebSocket server (HTTP/1.1: GET and HEAD; RFC 6455), plain or over TLS, on an io_context of the
// caller. It never waits for a client, and what it keeps for each is bounded.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <list>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/descriptor.hpp"
#include "host/web/access.hpp"

namespace boost::asio {
class io_context;
}
namespace boost::asio::ssl {
class context;
}

namespace groma::web {

struct Counters {
  std::uint64_t accepted = 0;   // clients
  std::uint64_t refused = 0;    // kMaxClients others were busy
  std::uint64_t requests = 0;   // answered, with any status
  std::uint64_t forbidden = 0;  // of those: wrong host, origin or token
  std::uint64_t timed_out = 0;  // clients that were silent, or did not take the answer
  std::uint64_t sockets = 0;    // WebSockets opened
  std::uint64_t messages = 0;   // sent to WebSockets
  std::uint64_t left_out = 0;   // messages for which a client was too slow
  std::uint64_t ignored = 0;    // messages of clients without a meaning
};

// An open WebSocket, valid from on_open() to on_close().
class Socket {
 public:
  using Message = std::shared_ptr<const std::string>;
  // While more bytes wait for a client, messages to it are left out.
  static constexpr std::size_t kMaxWaiting = 1U << 20U;

  Socket(const Socket&) = delete;
  Socket& operator=(const Socket&) = delete;
  virtual ~Socket() = default;

  enum class Kind { kText, kBinary };
  // False: left out.
  virtual bool send(Message message, Kind kind) = 0;
  [[nodiscard]] virtual std::size_t waiting_bytes() const noexcept = 0;

 protected:
  Socket() = default;
};

// What a path with WebSockets does. Its functions are called on the io_context's thread.
class SocketService {
 public:
  SocketService(const SocketService&) = delete;
  SocketService& operator=(const SocketService&) = delete;
  virtual ~SocketService() = default;

  virtual void on_open(Socket& socket) = 0;
  virtual void on_close(Socket& socket) = 0;
  // A text message. False: it says nothing to the service.
  virtual bool on_text(Socket& /*socket*/, std::string_view /*text*/) { return false; }
  // Nothing waits for the client any more; called after each time that it had to wait.
  virtual void on_drained(Socket& /*socket*/) {}

 protected:
  SocketService() = default;
};

struct TlsTexts {
  std::string certificate_pem;  // the chain, the server's first
  std::string key_pem;          // without a password
};
// Why a server cannot use them, by OpenSSL's words; empty: it can.
[[nodiscard]] std::string fault_of(const TlsTexts& texts);

class Server {
 public:
  static constexpr std::size_t kMaxClients = 64;
  static constexpr std::size_t kMaxSockets = 16;
  static constexpr std::size_t kMaxRequest = 8192;  // bytes of a request's header; it has no body
  static constexpr std::size_t kMaxMessage = 4096;  // bytes of a client's message
  static constexpr int kPatience_s = 10;            // for a request, and for the client to take the answer
  static constexpr int kSilence_s = 20;             // for a WebSocket's client to answer a ping

  // Throws std::runtime_error if fault_of(*tls) is not empty.
  Server(boost::asio::io_context& context, AccessRules rules, const std::optional<TlsTexts>& tls);
  ~Server();
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  // The content of a page; the view is valid until the next call.
  using Render = std::function<std::string_view()>;
  struct Page {
    std::string content_type;
    Render render;
    std::string encoding = {};  // of the content, such as gzip; empty: none
  };
  // At that path, such as "/metrics". Other paths give 404.
  void serve(std::string path, Page page);
  // subprotocols: those that the service speaks; the first one that a client offers is chosen. A client that
  // offers none of them is refused if it has to name one.
  struct SocketPath {
    SocketService* service = nullptr;
    std::vector<std::string> subprotocols;
    bool needs_subprotocol = false;
  };
  void serve(std::string path, SocketPath sockets);

  // Serves a connected client. If all places are taken, the first one that came and says nothing now loses
  // its own; WebSockets keep theirs.
  void add(io::Descriptor client);

  [[nodiscard]] const Counters& counters() const noexcept { return counters_; }
  [[nodiscard]] std::size_t clients() const noexcept { return clients_.size(); }
  [[nodiscard]] std::size_t sockets() const noexcept { return sockets_.size(); }

 private:
  class Client;
  class WebSocket;

  [[nodiscard]] bool make_place();
  // Begins with clients that wait for TLS, a few at once, then 20 a second.
  void begin_handshakes();

  boost::asio::io_context& context_;
  AccessRules rules_;
  std::unique_ptr<boost::asio::ssl::context> tls_;  // null: plain
  struct Handshakes;
  std::unique_ptr<Handshakes> handshakes_;
  std::map<std::string, Page, std::less<>> pages_;
  std::map<std::string, SocketPath, std::less<>> socket_paths_;
  Counters counters_;
  std::list<Client*> clients_;     // in the order of arrival; each is owned by its operation on the context
  std::list<WebSocket*> sockets_;  // likewise
};

}  // namespace groma::web
