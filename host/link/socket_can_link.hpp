// A node on a CAN bus. can_segment.hpp defines how the node's byte stream is cut into frames.
#pragma once

#include <linux/can.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "host/link/byte_link.hpp"
#include "host/link/can_path.hpp"
#include "host/link/can_socket.hpp"

namespace groma::link {

class SocketCanLink : public ByteLink {
 public:
  // socket: receives the frames of the path's node.
  SocketCanLink(std::unique_ptr<CanSocket> socket, CanPath path) noexcept;

  [[nodiscard]] int poll_fd() const noexcept override { return socket_->fd(); }
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override;
  // Sends frames of the link's format; returns how many bytes fit the interface's queue.
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override;
  [[nodiscard]] std::string take_news() override { return socket_->take_news(); }
  [[nodiscard]] const CanCounters* can_counters() const noexcept override { return &socket_->counters(); }

 private:
  std::unique_ptr<CanSocket> socket_;
  CanPath path_;
  canfd_frame frame_{};  // received, not yet read completely
  std::size_t payload_read_ = 0;
};

// For `path` see can_path.hpp.
[[nodiscard]] OpenedLink open_socket_can(const std::string& path);

}  // namespace groma::link
