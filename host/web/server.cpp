#include "host/web/server.hpp"

#include <openssl/ssl.h>

#include <algorithm>
#include <chrono>
#include <deque>
#include <stdexcept>
#include <utility>

#include <boost/asio/buffer.hpp>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/ssl/context.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/beast/core/flat_static_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/http/empty_body.hpp>
#include <boost/beast/http/error.hpp>
#include <boost/beast/http/message.hpp>
#include <boost/beast/http/parser.hpp>
#include <boost/beast/http/read.hpp>
#include <boost/beast/http/rfc7230.hpp>
#include <boost/beast/http/string_body.hpp>
#include <boost/beast/http/write.hpp>
#include <boost/beast/websocket/rfc6455.hpp>
#include <boost/beast/websocket/stream.hpp>

#include "host/web/stream.hpp"

namespace groma::web {

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace http = beast::http;
namespace websocket = beast::websocket;
using asio::ip::tcp;
using Error = beast::error_code;
using Request = http::request<http::empty_body>;

namespace {

// Bytes that the kernel keeps for a client; by itself it would keep megabytes for one that does not read.
constexpr int kSendBuffer = 65'536;

// Scripts, styles and data come from this server alone, and no other page may have it in a frame.
constexpr const char* kPolicy =
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; frame-ancestors 'none'";

std::string_view view(beast::string_view text) {
  return {text.data(), text.size()};
}

struct Target {
  std::string_view path;
  std::string_view query;
};

Target target_of(const Request& request) {
  const std::string_view text = view(request.target());
  const std::size_t mark = text.find('?');
  return {text.substr(0, mark), mark == std::string_view::npos ? std::string_view{} : text.substr(mark + 1)};
}

Sender sender_of(const Request& request) {
  Sender out{.host = view(request[http::field::host]),
             .origin = {},
             .authorization = view(request[http::field::authorization]),
             .cookie = view(request[http::field::cookie]),
             .query = target_of(request).query};
  if (request.count(http::field::origin) > 0) out.origin = view(request[http::field::origin]);
  return out;
}

// The first subprotocol that the client offers and the path speaks; empty: none.
std::string chosen_subprotocol(const Request& request, const Server::SocketPath& path) {
  for (const auto offered : http::token_list(request[http::field::sec_websocket_protocol])) {
    std::string name(view(offered));
    if (std::find(path.subprotocols.begin(), path.subprotocols.end(), name) != path.subprotocols.end())
      return name;
  }
  return {};
}

// Throws boost::system::system_error.
std::unique_ptr<asio::ssl::context> make_tls(const TlsTexts& texts) {
  auto context = std::make_unique<asio::ssl::context>(asio::ssl::context::tls_server);
  context->set_options(asio::ssl::context::default_workarounds | asio::ssl::context::no_sslv2 |
                       asio::ssl::context::no_sslv3 | asio::ssl::context::no_tlsv1 |
                       asio::ssl::context::no_tlsv1_1);
  // Without this OpenSSL would ask for a key's password on the terminal.
  context->set_password_callback(
      [](std::size_t, asio::ssl::context::password_purpose) { return std::string(); });
  context->use_certificate_chain(asio::buffer(texts.certificate_pem));
  context->use_private_key(asio::buffer(texts.key_pem), asio::ssl::context::pem);
  // use_private_key() accepts a key of another kind than the certificate's.
  if (SSL_CTX_check_private_key(context->native_handle()) != 1)
    throw std::runtime_error("the key is not the certificate's");
  return context;
}

}  // namespace

std::string fault_of(const TlsTexts& texts) {
  try {
    static_cast<void>(make_tls(texts));
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return {};
}

// An open WebSocket, owned by its reading operation.
class Server::WebSocket : public Socket, public std::enable_shared_from_this<WebSocket> {
 public:
  WebSocket(Server& server, Stream stream, SocketService& service)
      : server_(&server), service_(service), stream_(std::move(stream)) {
    server.sockets_.push_back(this);
  }
  ~WebSocket() override {
    if (server_ != nullptr) server_->sockets_.remove(this);
  }
  WebSocket(const WebSocket&) = delete;
  WebSocket& operator=(const WebSocket&) = delete;

  void accept(const Request& request, const std::string& subprotocol) {
    stream_.next_layer().next_layer().expires_never();  // the WebSocket has its own times
    stream_.set_option(websocket::stream_base::timeout{std::chrono::seconds(kPatience_s),
                                                       std::chrono::seconds(kSilence_s), true});
    stream_.read_message_max(kMaxMessage);
    stream_.auto_fragment(false);
    stream_.set_option(websocket::stream_base::decorator([subprotocol](websocket::response_type& response) {
      if (!subprotocol.empty()) response.set(http::field::sec_websocket_protocol, subprotocol);
    }));
    stream_.async_accept(request,
                         [self = shared_from_this()](const Error& error) { self->on_accepted(error); });
  }

  bool send(Message message, Kind kind) override {
    if (server_ == nullptr) return false;
    if (waiting_bytes_ + cost(*message) > kMaxWaiting) {
      ++server_->counters_.left_out;
      if (Clock::now() - taken_ > std::chrono::seconds(kSilence_s)) stream_.next_layer().close();
      return false;
    }
    waiting_bytes_ += cost(*message);
    waiting_.push_back({std::move(message), kind});
    if (waiting_.size() == 1) {
      taken_ = Clock::now();
      write();
    }
    return true;
  }
  [[nodiscard]] std::size_t waiting_bytes() const noexcept override { return waiting_bytes_; }

  // The server is destroyed before the context.
  void abandon() {
    end();
    server_ = nullptr;
    stream_.next_layer().close();
  }

 private:
  using Clock = std::chrono::steady_clock;
  struct Waiting {
    Message message;
    Kind kind;
  };
  // Bytes, with those of the queue.
  [[nodiscard]] static std::size_t cost(const std::string& message) noexcept {
    constexpr std::size_t kQueued = 128;
    return message.size() + kQueued;
  }

  void on_accepted(const Error& error) {
    if (server_ == nullptr || error) return;
    ++server_->counters_.sockets;
    is_open_ = true;
    service_.on_open(*this);
    read();
  }

  void read() {
    stream_.async_read(
        buffer_, [self = shared_from_this()](const Error& error, std::size_t) { self->on_read(error); });
  }

  void on_read(const Error& error) {
    if (server_ == nullptr) return;
    if (error) {
      if (error == beast::error::timeout) ++server_->counters_.timed_out;
      end();
      return stream_.next_layer().close();  // else a write to a client that does not read goes on for ever
    }
    const auto bytes = buffer_.data();
    const std::string_view text(static_cast<const char*>(bytes.data()), bytes.size());
    if (!stream_.got_text() || !service_.on_text(*this, text)) ++server_->counters_.ignored;
    buffer_.consume(bytes.size());
    read();
  }

  void write() {
    stream_.binary(waiting_.front().kind == Kind::kBinary);
    stream_.async_write(
        asio::buffer(*waiting_.front().message),
        [self = shared_from_this()](const Error& error, std::size_t) { self->on_written(error); });
  }

  void on_written(const Error& error) {
    if (server_ == nullptr) return;
    if (error == beast::error::timeout) ++server_->counters_.timed_out;
    if (error) return;  // the reading operation ends, too
    ++server_->counters_.messages;
    taken_ = Clock::now();
    waiting_bytes_ -= cost(*waiting_.front().message);
    waiting_.pop_front();
    if (!waiting_.empty()) return write();
    if (is_open_) service_.on_drained(*this);
  }

  void end() {
    if (std::exchange(is_open_, false)) service_.on_close(*this);
  }

  Server* server_;  // null: destroyed
  SocketService& service_;
  websocket::stream<Stream, false> stream_;  // without compression
  beast::flat_static_buffer<kMaxMessage> buffer_;
  std::deque<Waiting> waiting_;  // the first one is being written
  std::size_t waiting_bytes_ = 0;
  Clock::time_point taken_{};  // when the client took a message, or the first one began to wait
  bool is_open_ = false;
};

// One client of HTTP: reads a request, answers it, and reads the next one.
class Server::Client : public std::enable_shared_from_this<Client> {
 public:
  Client(Server& server, tcp::socket socket)
      : server_(&server), stream_(std::move(socket), server.tls_.get()) {
    server.clients_.push_back(this);
  }
  ~Client() {
    if (server_ != nullptr) server_->clients_.remove(this);
  }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  // False: it lost its place before.
  bool start() {
    if (server_ == nullptr) return false;
    server_->tls_ == nullptr ? read() : shake_hands();
    return true;
  }

  // Whether nothing of an answer is under way.
  [[nodiscard]] bool is_silent() const noexcept { return is_silent_; }

  // The server is destroyed before the context, or needs the place.
  void abandon() {
    server_ = nullptr;
    stream_.close();
  }

 private:
  void shake_hands() {
    if (server_ == nullptr) return;
    stream_.next_layer().expires_after(std::chrono::seconds(kPatience_s));
    stream_.async_handshake([self = shared_from_this()](const Error& error) {
      if (self->server_ == nullptr) return;
      if (error) return self->count_time_out(error);
      self->read();
    });
  }

  void read() {
    request_.emplace();
    request_->header_limit(kMaxRequest);
    stream_.next_layer().expires_after(std::chrono::seconds(kPatience_s));
    http::async_read(stream_, buffer_, *request_,
                     [self = shared_from_this()](const Error& error, std::size_t) { self->on_read(error); });
  }

  void on_read(const Error& error) {
    if (server_ == nullptr || error == http::error::end_of_stream) return;
    is_silent_ = false;
    if (error && error.category() == Error(http::error::bad_method).category())
      return respond(http::status::bad_request, "bad request\n");
    if (error) return count_time_out(error);
    const Request& request = request_->get();
    if (const Access access = judge(server_->rules_, sender_of(request)); access != Access::kGranted)
      return refuse(access);
    const Target target = target_of(request);
    const auto sockets = server_->socket_paths_.find(target.path);
    const auto page = server_->pages_.find(target.path);
    if (request.method() != http::verb::get && request.method() != http::verb::head) {
      prepare(http::status::method_not_allowed, "text/plain", "GET and HEAD only\n");
      response_.set(http::field::allow, "GET, HEAD");
      write();
    } else if (sockets != server_->socket_paths_.end()) {
      upgrade(sockets->second);
    } else if (page == server_->pages_.end()) {
      respond(http::status::not_found, "not found\n");
    } else if (target.path == "/" && has_token_in_query(server_->rules_, target.query)) {
      exchange_token();
    } else {
      prepare(http::status::ok, page->second.content_type, page->second.render());
      if (!page->second.encoding.empty()) response_.set(http::field::content_encoding, page->second.encoding);
      write();
    }
  }

  void refuse(Access access) {
    ++server_->counters_.forbidden;
    const bool lacks_token = access == Access::kNoToken;
    prepare(lacks_token ? http::status::unauthorized : http::status::forbidden, "text/plain",
            explain(access));
    if (lacks_token) response_.set(http::field::www_authenticate, "Bearer");
    write();
  }

  // The browser keeps the token as a cookie for a year, so that the address does not contain it. Pages of
  // other origins cannot use it for a WebSocket.
  void exchange_token() {
    prepare(http::status::see_other, "text/plain", "");
    response_.set(http::field::location, "/");
    response_.set(http::field::set_cookie, std::string(kTokenCookie) + "=" + server_->rules_.token +
                                               "; Path=/; Max-Age=31536000; HttpOnly; SameSite=Lax" +
                                               (server_->tls_ != nullptr ? "; Secure" : ""));
    write();
  }

  void upgrade(const SocketPath& path) {
    const Request& request = request_->get();
    if (!websocket::is_upgrade(request)) {
      prepare(http::status::upgrade_required, "text/plain", "a WebSocket only\n");
      response_.set(http::field::upgrade, "websocket");
      return write();
    }
    const std::string subprotocol = chosen_subprotocol(request, path);
    if (subprotocol.empty() && path.needs_subprotocol)
      return respond(http::status::bad_request, "name a subprotocol that gromad speaks\n");
    if (server_->sockets_.size() >= kMaxSockets)
      return respond(http::status::service_unavailable, "as many WebSockets as gromad serves are open\n");
    ++server_->counters_.requests;
    std::make_shared<WebSocket>(*server_, std::move(stream_), *path.service)->accept(request, subprotocol);
  }

  void respond(http::status status, std::string_view body) {
    prepare(status, "text/plain", body);
    write();
  }

  void prepare(http::status status, const std::string& type, std::string_view body) {
    constexpr unsigned kHttp11 = 11;
    response_ = http::response<http::string_body>(status, kHttp11);
    response_.set(http::field::content_type, type);
    response_.set(http::field::cache_control, "no-cache");
    response_.set("X-Content-Type-Options", "nosniff");
    response_.set("Content-Security-Policy", kPolicy);
    response_.keep_alive(request_->get().keep_alive() && status != http::status::bad_request);
    response_.body() = body;
  }

  void write() {
    ++server_->counters_.requests;
    response_.prepare_payload();
    if (request_->get().method() == http::verb::head) response_.body().clear();
    stream_.next_layer().expires_after(std::chrono::seconds(kPatience_s));
    http::async_write(stream_, response_, [self = shared_from_this()](const Error& error, std::size_t) {
      self->on_written(error);
    });
  }

  void on_written(const Error& error) {
    if (server_ == nullptr) return;
    if (error) return count_time_out(error);
    is_silent_ = true;
    if (response_.keep_alive()) return read();
    Error ignored;
    stream_.next_layer().socket().shutdown(tcp::socket::shutdown_send, ignored);
  }

  void count_time_out(const Error& error) {
    if (error == beast::error::timeout) ++server_->counters_.timed_out;
  }

  Server* server_;  // null: destroyed
  Stream stream_;
  beast::flat_static_buffer<kMaxRequest> buffer_;
  std::optional<http::request_parser<http::empty_body>> request_;
  http::response<http::string_body> response_;
  bool is_silent_ = true;
};

// A handshake of TLS costs some milliseconds, which poses would wait for.
struct Server::Handshakes {
  explicit Handshakes(asio::io_context& context) : timer(context) {}

  std::deque<std::shared_ptr<Client>> waiting;
  asio::steady_timer timer;
  bool is_due = false;  // the timer runs
  int at_once = kAtOnce;

  static constexpr int kAtOnce = 8;
  static constexpr std::chrono::milliseconds kBetween{50};
};

Server::Server(asio::io_context& context, AccessRules rules, const std::optional<TlsTexts>& tls)
    : context_(context), rules_(std::move(rules)), handshakes_(std::make_unique<Handshakes>(context)) {
  if (tls) tls_ = make_tls(*tls);
}

Server::~Server() {
  // Each is removed from the list when its operation ends, or here.
  for (Client* client : clients_) client->abandon();
  for (WebSocket* socket : sockets_) socket->abandon();
}

void Server::serve(std::string path, Page page) {
  pages_[std::move(path)] = std::move(page);
}

void Server::serve(std::string path, SocketPath sockets) {
  socket_paths_[std::move(path)] = std::move(sockets);
}

void Server::add(io::Descriptor fd) {
  if (clients_.size() + sockets_.size() >= kMaxClients && !make_place()) {
    ++counters_.refused;
    return;
  }
  ++counters_.accepted;
  tcp::socket socket(context_);
  Error error;
  // Asio uses the protocol only to open sockets.
  socket.assign(tcp::v4(), fd.get(), error);
  if (error) return;
  static_cast<void>(fd.release());
  socket.set_option(asio::socket_base::send_buffer_size(kSendBuffer), error);
  const auto client = std::make_shared<Client>(*this, std::move(socket));
  if (tls_ == nullptr) {
    client->start();
    return;
  }
  handshakes_->waiting.push_back(client);
  begin_handshakes();
}

bool Server::make_place() {
  const auto silent = std::find_if(clients_.begin(), clients_.end(),
                                   [](const Client* client) { return client->is_silent(); });
  if (silent == clients_.end()) return false;
  Client* const client = *silent;
  clients_.erase(silent);
  client->abandon();
  return true;
}

void Server::begin_handshakes() {
  Handshakes& to = *handshakes_;
  while (!to.waiting.empty() && to.at_once > 0) {
    const std::shared_ptr<Client> client = std::move(to.waiting.front());
    to.waiting.pop_front();
    if (client->start()) --to.at_once;
  }
  if (to.is_due || to.at_once == Handshakes::kAtOnce) return;
  to.is_due = true;
  to.timer.expires_after(Handshakes::kBetween);
  to.timer.async_wait([this](const Error& error) {
    if (error) return;  // the server is destroyed
    handshakes_->is_due = false;
    ++handshakes_->at_once;
    begin_handshakes();
  });
}
}  // namespace groma::web
