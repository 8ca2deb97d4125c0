#include "host/link/socket_can_link.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <memory>
#include <utility>

namespace groma::link {
namespace {

// The longest prefix of the stream that fits a payload of this format without padding; the whole stream if it
// ends with the zero of a complete frame, after which padding is allowed.
std::span<const std::uint8_t> without_padding(std::span<const std::uint8_t> stream, wire::CanFormat format) {
  const std::size_t most = wire::max_can_payload(format);
  if (stream.size() >= most || stream.back() == 0) return stream;
  std::uint8_t code = wire::can_length_code(stream.size());
  if (wire::kCanLengths[code] > stream.size()) --code;
  return stream.first(wire::kCanLengths[code]);
}

}  // namespace

OpenedLink open_socket_can(const std::string& path) {
  const auto can = parse_can_path(path);
  if (!can) {
    return {
        nullptr,
        {LinkFault::kUnsuitable, fmt::format("{}: names no node on a CAN bus; {}", path, kCanPathAdvice)}};
  }
  // Only the node's frames reach the socket.
  const can_filter of_node{
      .can_id = wire::can_id({wire::CanDirection::kToHost, can->node}) | CAN_EFF_FLAG,
      .can_mask = CAN_EFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG,
  };
  CanSocket::Opened opened = CanSocket::open(path, can->interface, std::span(&of_node, 1), can->format,
                                             can->format == wire::CanFormat::kFd);
  if (!opened.socket) return {nullptr, std::move(opened.error)};
  return {std::make_unique<SocketCanLink>(std::move(opened.socket), *can), {}};
}

SocketCanLink::SocketCanLink(std::unique_ptr<CanSocket> socket, CanPath path) noexcept
    : socket_(std::move(socket)), path_(std::move(path)) {}

ReadResult SocketCanLink::read(std::span<std::uint8_t> out) {
  std::size_t bytes = 0;
  while (bytes < out.size()) {
    if (payload_read_ == frame_.len) {
      payload_read_ = 0;
      if (!socket_->receive(frame_)) {
        frame_.len = 0;
        break;
      }
    }
    const std::size_t n = std::min<std::size_t>(out.size() - bytes, frame_.len - payload_read_);
    std::memcpy(out.data() + bytes, frame_.data + payload_read_, n);
    payload_read_ += n;
    bytes += n;
  }
  return {bytes, socket_->gone() && bytes == 0};
}

std::size_t SocketCanLink::write(std::span<const std::uint8_t> bytes) {
  std::size_t sent = 0;
  while (sent < bytes.size()) {
    wire::CanFrame cut;
    const std::size_t taken =
        wire::cut_can_payload(without_padding(bytes.subspan(sent), path_.format), path_.format, cut);
    canfd_frame frame{};
    frame.can_id = wire::can_id({wire::CanDirection::kToNode, path_.node}) | CAN_EFF_FLAG;
    frame.len = cut.size;
    if (path_.format == wire::CanFormat::kFd) frame.flags = CANFD_BRS;
    std::memcpy(frame.data, cut.data.data(), cut.size);
    if (!socket_->send(frame, path_.format)) break;
    sent += taken;
  }
  return sent;
}

}  // namespace groma::link
