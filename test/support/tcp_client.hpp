// A TCP client of this computer, for tests.
#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <cstdint>
#include <stdexcept>
#include <string>

#include "host/io/descriptor.hpp"

namespace groma::test {

class TcpClient {
 public:
  // receive_buffer: of the socket, in bytes; 0: the system's.
  explicit TcpClient(std::uint16_t port, int receive_buffer = 0)
      : fd_(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)) {
    if (receive_buffer > 0) {
      ::setsockopt(fd_.get(), SOL_SOCKET, SO_RCVBUF, &receive_buffer, sizeof(receive_buffer));
    }
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      throw std::runtime_error("connect");
    }
  }

  // False if not all could be sent at once.
  bool send(const std::string& text) const {
    return ::send(fd_.get(), text.data(), text.size(), MSG_DONTWAIT | MSG_NOSIGNAL) ==
           static_cast<ssize_t>(text.size());
  }
  // What has arrived.
  std::string receive() {
    std::string text;
    char buffer[65536];
    ssize_t n = 0;
    while ((n = ::recv(fd_.get(), buffer, sizeof(buffer), MSG_DONTWAIT)) > 0) {
      text.append(buffer, static_cast<std::size_t>(n));
    }
    ended_ = ended_ || n == 0 || errno == ECONNRESET;
    return text;
  }
  // The same, after waiting for it at most that long.
  std::string await(std::chrono::milliseconds patience) {
    pollfd ready{fd_.get(), POLLIN, 0};
    ::poll(&ready, 1, static_cast<int>(patience.count()));
    return receive();
  }
  // The other side has ended the connection.
  [[nodiscard]] bool ended() const { return ended_; }
  void close() { fd_.close(); }
  [[nodiscard]] int fd() const { return fd_.get(); }

 private:
  io::Descriptor fd_;
  bool ended_ = false;
};

}  // namespace groma::test
