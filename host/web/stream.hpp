// A client's connection: TCP, or TLS over it. One type for both, so that HTTP and WebSocket are compiled
// once.
#pragma once

#include <chrono>
#include <memory>
#include <utility>

#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/ssl/context.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/ssl/ssl_stream.hpp>
#include <boost/beast/websocket/teardown.hpp>

namespace groma::web {

class Stream {
 public:
  using Tcp = boost::beast::tcp_stream;
  using executor_type = Tcp::executor_type;
  using next_layer_type = Tcp;  // what boost::beast::get_lowest_layer() looks for

  // tls: null: plain TCP.
  Stream(boost::asio::ip::tcp::socket socket, boost::asio::ssl::context* tls)
      : tcp_(std::make_unique<Tcp>(std::move(socket))) {
    if (tls != nullptr) tls_ = std::make_unique<Tls>(*tcp_, *tls);
  }

  [[nodiscard]] executor_type get_executor() noexcept { return tcp_->get_executor(); }
  [[nodiscard]] Tcp& next_layer() noexcept { return *tcp_; }
  [[nodiscard]] const Tcp& next_layer() const noexcept { return *tcp_; }

  template <typename Buffers, typename Handler>
  auto async_read_some(const Buffers& buffers, Handler&& handler) {
    return tls_ ? tls_->async_read_some(buffers, std::forward<Handler>(handler))
                : tcp_->async_read_some(buffers, std::forward<Handler>(handler));
  }
  template <typename Buffers, typename Handler>
  auto async_write_some(const Buffers& buffers, Handler&& handler) {
    return tls_ ? tls_->async_write_some(buffers, std::forward<Handler>(handler))
                : tcp_->async_write_some(buffers, std::forward<Handler>(handler));
  }

  // Of a TLS stream.
  template <typename Handler>
  void async_handshake(Handler&& handler) {
    tls_->async_handshake(boost::asio::ssl::stream_base::server, std::forward<Handler>(handler));
  }

  void close() { tcp_->close(); }

 private:
  using Tls = boost::beast::ssl_stream<Tcp&>;

  std::unique_ptr<Tcp> tcp_;
  std::unique_ptr<Tls> tls_;
};

// How a WebSocket ends its connection: as TCP does. A close frame went before, so that TLS needs no farewell.
template <typename Handler>
void async_teardown(boost::beast::role_type role, Stream& stream, Handler&& handler) {
  boost::beast::websocket::async_teardown(role, stream.next_layer().socket(), std::forward<Handler>(handler));
}
inline void teardown(boost::beast::role_type role, Stream& stream, boost::beast::error_code& error) {
  boost::beast::websocket::teardown(role, stream.next_layer().socket(), error);
}
inline void beast_close_socket(Stream& stream) {
  stream.close();
}

}  // namespace groma::web
