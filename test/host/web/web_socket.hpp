// A WebSocket client (RFC 6455) by hand, for tests: what a browser sends, and what it never would.
#pragma once

#include <netinet/tcp.h>

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "test/support/tcp_client.hpp"

namespace groma::web::test {

class WebSocketClient {
 public:
  struct Frame {
    unsigned opcode = 0;
    std::string payload;
  };
  static constexpr unsigned kText = 1;
  static constexpr unsigned kBinary = 2;
  static constexpr unsigned kClose = 8;
  static constexpr unsigned kPing = 9;
  static constexpr unsigned kPong = 10;

  // serve: lets the server do what it has to do.
  WebSocketClient(std::uint16_t port, std::function<void()> serve, int receive_buffer = 0)
      : tcp_(port, receive_buffer), serve_(std::move(serve)) {
    const int on = 1;
    ::setsockopt(tcp_.fd(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
  }

  // Sends the handshake; returns the answer's header.
  std::string open(const std::string& path, const std::string& headers = {},
                   const std::string& host = "127.0.0.1") {
    tcp_.send("GET " + path + " HTTP/1.1\r\nHost: " + host +
              "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
              "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" +
              headers + "\r\n");
    for (int i = 0; i < 200 && bytes_.find("\r\n\r\n") == std::string::npos && !tcp_.ended(); ++i) poll();
    const std::size_t end = bytes_.find("\r\n\r\n");
    if (end == std::string::npos) return bytes_;
    std::string header = bytes_.substr(0, end + 4);
    bytes_.erase(0, end + 4);
    return header;
  }

  // A frame with that payload. announced: the length that its header has, if another one.
  void send(unsigned opcode, const std::string& payload, std::optional<std::uint64_t> announced = {}) {
    const std::uint64_t length = announced.value_or(payload.size());
    std::string out(1, static_cast<char>(0x80U | opcode));
    const int bytes = length < 126 ? 0 : length < 65536 ? 2 : 8;
    out += static_cast<char>(0x80U | (bytes == 0 ? length : bytes == 2 ? 126U : 127U));
    for (int i = bytes - 1; i >= 0; --i) out += static_cast<char>((length >> (8 * i)) & 0xFFU);
    out += std::string(4, '\0');  // a mask that changes nothing
    tcp_.send(out + payload);
  }

  // The next frame, after serving at most `turns` times; none: nothing came.
  std::optional<Frame> next(int turns = 50) {
    for (int i = 0; i < turns; ++i) {
      if (auto frame = take()) return frame;
      poll();
    }
    return take();
  }
  // The payloads of all that comes until nothing more does.
  std::vector<std::string> all() {
    std::vector<std::string> out;
    while (auto frame = next()) out.push_back(frame->payload);
    return out;
  }

  void poll() {
    serve_();
    bytes_ += tcp_.receive();
  }
  [[nodiscard]] bool ended() const { return tcp_.ended(); }
  void close() { tcp_.close(); }
  void end_sending() { ::shutdown(tcp_.fd(), SHUT_WR); }

 private:
  std::optional<Frame> take() {
    if (bytes_.size() < 2) return {};
    const auto byte = [this](std::size_t i) { return static_cast<std::uint8_t>(bytes_[i]); };
    std::uint64_t length = byte(1) & 0x7FU;
    std::size_t header = 2;
    if (length >= 126) {
      const std::size_t more = length == 126 ? 2 : 8;
      if (bytes_.size() < 2 + more) return {};
      length = 0;
      for (std::size_t i = 0; i < more; ++i) length = length << 8U | byte(2 + i);
      header += more;
    }
    if (bytes_.size() < header + length) return {};
    Frame frame{byte(0) & 0x0FU, bytes_.substr(header, length)};
    bytes_.erase(0, header + length);
    return frame;
  }

  groma::test::TcpClient tcp_;
  std::function<void()> serve_;
  std::string bytes_;
};

}  // namespace groma::web::test
