#include "host/daemon/web_server.hpp"

#include <chrono>
#include <optional>
#include <utility>

#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/beast/core/flat_static_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/http/empty_body.hpp>
#include <boost/beast/http/error.hpp>
#include <boost/beast/http/message.hpp>
#include <boost/beast/http/parser.hpp>
#include <boost/beast/http/read.hpp>
#include <boost/beast/http/string_body.hpp>
#include <boost/beast/http/write.hpp>

namespace groma::daemon {

namespace beast = boost::beast;
namespace http = beast::http;
using boost::asio::ip::tcp;
using Error = beast::error_code;

// One connection: reads a request, answers it, and reads the next one.
class WebServer::Client : public std::enable_shared_from_this<WebServer::Client> {
 public:
  Client(WebServer& server, tcp::socket socket) : server_(&server), stream_(std::move(socket)) {
    server_->clients_.insert(this);
  }
  ~Client() {
    if (server_ != nullptr) server_->clients_.erase(this);
  }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  void read() {
    request_.emplace();
    request_->header_limit(kMaxRequest);
    stream_.expires_after(std::chrono::seconds(kPatience_s));
    http::async_read(stream_, buffer_, *request_,
                     [self = shared_from_this()](const Error& error, std::size_t) { self->on_read(error); });
  }

  // The server is destroyed before the loop.
  void abandon() {
    server_ = nullptr;
    stream_.close();
  }

 private:
  void on_read(const Error& error) {
    if (server_ == nullptr || error == http::error::end_of_stream) return;
    if (error && error.category() == Error(http::error::bad_method).category()) {
      return respond(http::status::bad_request, "text/plain", "bad request\n", false);
    }
    if (error) return count_time_out(error);
    const auto target = request_->get().target();
    const std::string_view text(target.data(), target.size());
    const bool keep_alive = request_->get().keep_alive();
    const http::verb method = request_->get().method();
    const auto page = server_->pages_.find(text.substr(0, text.find('?')));
    if (method != http::verb::get && method != http::verb::head) {
      respond(http::status::method_not_allowed, "text/plain", "GET and HEAD only\n", keep_alive);
    } else if (page == server_->pages_.end()) {
      respond(http::status::not_found, "text/plain", "not found\n", keep_alive);
    } else {
      respond(http::status::ok, page->second.content_type, page->second.render(), keep_alive);
    }
  }

  void respond(http::status status, const std::string& type, std::string_view body, bool keep_alive) {
    constexpr unsigned kHttp11 = 11;
    ++server_->counters_.requests;
    response_ = http::response<http::string_body>(status, kHttp11);
    response_.set(http::field::content_type, type);
    if (status == http::status::method_not_allowed) response_.set(http::field::allow, "GET, HEAD");
    response_.keep_alive(keep_alive);
    response_.body() = body;
    response_.prepare_payload();
    if (request_->get().method() == http::verb::head) response_.body().clear();
    stream_.expires_after(std::chrono::seconds(kPatience_s));
    http::async_write(stream_, response_, [self = shared_from_this()](const Error& error, std::size_t) {
      self->on_written(error);
    });
  }

  void on_written(const Error& error) {
    if (server_ == nullptr) return;
    if (error) return count_time_out(error);
    if (response_.keep_alive()) return read();
    Error ignored;
    stream_.socket().shutdown(tcp::socket::shutdown_send, ignored);
  }

  void count_time_out(const Error& error) {
    if (error == beast::error::timeout) ++server_->counters_.timed_out;
  }

  WebServer* server_;  // null: destroyed
  beast::tcp_stream stream_;
  beast::flat_static_buffer<kMaxRequest> buffer_;
  std::optional<http::request_parser<http::empty_body>> request_;
  http::response<http::string_body> response_;
};

WebServer::Opened WebServer::open(EventLoop& loop, const Endpoint& endpoint) {
  std::unique_ptr<WebServer> server(new WebServer());
  TcpListener::Opened opened =
      TcpListener::open(loop, endpoint, "web",
                        [&loop, &to = *server](io::Descriptor client) { to.add(loop, std::move(client)); });
  if (!opened.listener) return {nullptr, std::move(opened.error)};
  server->listener_ = std::move(opened.listener);
  return {std::move(server), {}};
}

WebServer::~WebServer() {
  for (Client* client : clients_) client->abandon();
}

void WebServer::serve(std::string path, std::string content_type, Render render) {
  pages_[std::move(path)] = {std::move(content_type), std::move(render)};
}

void WebServer::add(EventLoop& loop, io::Descriptor fd) {
  if (clients_.size() == kMaxClients) {
    ++counters_.refused;
    return;
  }
  ++counters_.accepted;
  tcp::socket socket(loop.context());
  Error error;
  // Asio uses the protocol only to open sockets.
  socket.assign(tcp::v4(), fd.get(), error);
  if (error) return;
  static_cast<void>(fd.release());
  std::make_shared<Client>(*this, std::move(socket))->read();
}

}  // namespace groma::daemon
