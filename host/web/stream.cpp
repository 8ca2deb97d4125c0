#include "host/web/stream.hpp"

#include <boost/beast/ssl/ssl_stream.hpp>

namespace groma::web {

struct Stream::Tls : boost::beast::ssl_stream<Tcp&> {
  using boost::beast::ssl_stream<Tcp&>::ssl_stream;
};

Stream::Stream(boost::asio::ip::tcp::socket socket, boost::asio::ssl::context* tls)
    : tcp_(std::make_unique<Tcp>(std::move(socket))) {
  if (tls != nullptr) tls_ = std::make_unique<Tls>(*tcp_, *tls);
}
Stream::~Stream() = default;
Stream::Stream(Stream&&) noexcept = default;
Stream& Stream::operator=(Stream&&) noexcept = default;

void Stream::read_some(const std::vector<boost::asio::mutable_buffer>& buffers, Done done) {
  tls_ ? tls_->async_read_some(buffers, std::move(done)) : tcp_->async_read_some(buffers, std::move(done));
}

void Stream::write_some(const std::vector<boost::asio::const_buffer>& buffers, Done done) {
  tls_ ? tls_->async_write_some(buffers, std::move(done)) : tcp_->async_write_some(buffers, std::move(done));
}

void Stream::async_handshake(std::function<void(const Error&)> done) {
  tls_->async_handshake(boost::asio::ssl::stream_base::server, std::move(done));
}

}  // namespace groma::web
