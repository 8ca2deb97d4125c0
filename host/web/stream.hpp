// A client's connection: TCP, or TLS over it. One type for both, and for all operations on it, so that each
// layer is compiled once.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include <boost/asio/buffer.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/ssl/context.hpp>
#include <boost/beast/core/error.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/websocket/teardown.hpp>

namespace groma::web {

// Its operations complete on the executor of the socket.
class Stream {
 public:
  using Tcp = boost::beast::tcp_stream;
  using executor_type = Tcp::executor_type;
  using next_layer_type = Tcp;  // what boost::beast::get_lowest_layer() looks for
  using Error = boost::beast::error_code;

  // tls: null: plain TCP.
  Stream(boost::asio::ip::tcp::socket socket, boost::asio::ssl::context* tls);
  ~Stream();
  Stream(Stream&&) noexcept;
  Stream& operator=(Stream&&) noexcept;

  [[nodiscard]] executor_type get_executor() noexcept { return tcp_->get_executor(); }
  [[nodiscard]] Tcp& next_layer() noexcept { return *tcp_; }
  [[nodiscard]] const Tcp& next_layer() const noexcept { return *tcp_; }

  template <typename Sequence, typename Handler>
  void async_read_some(const Sequence& sequence, Handler&& handler) {
    read_some(listed<boost::asio::mutable_buffer>(sequence), erased(std::forward<Handler>(handler)));
  }
  template <typename Sequence, typename Handler>
  void async_write_some(const Sequence& sequence, Handler&& handler) {
    write_some(listed<boost::asio::const_buffer>(sequence), erased(std::forward<Handler>(handler)));
  }

  // Of a TLS stream.
  void async_handshake(std::function<void(const Error&)> done);

  void close() { tcp_->close(); }

 private:
  struct Tls;
  using Done = std::function<void(const Error&, std::size_t)>;

  template <typename Buffer, typename Sequence>
  static std::vector<Buffer> listed(const Sequence& sequence) {
    return std::vector<Buffer>(boost::asio::buffer_sequence_begin(sequence),
                               boost::asio::buffer_sequence_end(sequence));
  }
  // A std::function can be copied; Beast's handlers can only be moved.
  template <typename Handler>
  static Done erased(Handler&& handler) {
    return [to = std::make_shared<std::decay_t<Handler>>(std::forward<Handler>(handler))](const Error& error,
                                                                                          std::size_t bytes) {
      std::decay_t<Handler>& once = *to;
      std::move(once)(error, bytes);
    };
  }
  void read_some(const std::vector<boost::asio::mutable_buffer>& buffers, Done done);
  void write_some(const std::vector<boost::asio::const_buffer>& buffers, Done done);

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
