// A link that other programs connect to: a Unix socket, a TCP port or a UDP port at which they send lines of
// text. The link passes on whole lines only, so that those of several programs do not mix.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <vector>

#include "host/link/byte_link.hpp"
#include "host/link/descriptor.hpp"

namespace groma::link {

// Reads from its clients, and sends them nothing. A datagram is one or several lines. The last line of a
// client that leaves needs no line feed.
class LineListener : public ByteLink {
 public:
  // One more client replaces the one that has been silent for longest.
  static constexpr std::size_t kMaxClients = 16;
  // Of a longer line, more than this many bytes are passed on, and the rest is discarded.
  static constexpr std::size_t kMaxLine = 4096;

  // poll: an epoll instance with `listener`. socket_file: removed at the end; empty: none.
  LineListener(Descriptor poll, Descriptor listener, bool datagrams,
               std::filesystem::path socket_file) noexcept;
  LineListener(const LineListener&) = delete;
  LineListener& operator=(const LineListener&) = delete;
  ~LineListener() override;

  [[nodiscard]] int poll_fd() const noexcept override { return poll_.get(); }
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override;
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override { return bytes.size(); }

  [[nodiscard]] std::size_t client_count() const noexcept { return clients_.size(); }

 private:
  struct Client {
    Descriptor fd;
    std::string line;       // incomplete
    bool too_long = false;  // the rest of the line is discarded
    std::uint64_t heard = 0;
  };

  void receive();
  void accept_clients();
  void turn_away();
  void receive_datagrams();
  // False: the client has left.
  bool receive_from(Client& client);
  void take(Client& client, std::string_view text);

  Descriptor poll_;
  Descriptor listener_;
  Descriptor spare_;  // given up to accept and close a connection where no other is left
  bool datagrams_;
  std::string datagram_;  // buffer
  std::filesystem::path socket_file_;
  std::vector<Client> clients_;
  std::uint64_t turns_ = 0;
  std::string lines_;  // whole lines, not yet read completely
  std::size_t read_ = 0;
};

// path: of a Unix socket, tcp://ADDRESS:PORT or udp://ADDRESS:PORT with a numeric address. A socket file that
// no program serves is replaced; its owner and group may connect.
[[nodiscard]] OpenedLink open_line_listener(const std::string& path);

}  // namespace groma::link
