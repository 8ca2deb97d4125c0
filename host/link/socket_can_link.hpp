// A node on a CAN bus, by a raw socket of Linux's SocketCAN (Documentation/networking/can.rst).
// can_segment.hpp defines how the node's byte stream is cut into frames.
#pragma once

#include <linux/can.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "host/link/byte_link.hpp"
#include "host/link/can_path.hpp"
#include "host/link/descriptor.hpp"
#include "proto/can_segment.hpp"

namespace groma::link {

// Since the link was opened. Every link on an interface gets the controller's error frames.
struct CanCounters {
  std::uint64_t frames = 0;               // from the node
  std::uint64_t frames_overrun = 0;       // lost because they came faster than they were read
  std::uint64_t error_frames = 0;         // from the controller, of any kind, including those counted below
  std::uint64_t controller_overruns = 0;  // the controller's buffer was full: frames of any node are lost
  std::uint64_t error_passive = 0;        // times the controller became error-passive
  std::uint64_t bus_off = 0;
  std::uint64_t restarts = 0;  // after bus-off
};

class SocketCanLink : public ByteLink {
 public:
  // socket: non-blocking, bound to the path's interface, with the filters set. name: for messages.
  SocketCanLink(Descriptor socket, CanPath path, std::string name) noexcept;

  [[nodiscard]] int poll_fd() const noexcept override { return socket_.get(); }
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override;
  // Sends frames of the link's format; returns how many bytes fit the interface's queue.
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override;
  [[nodiscard]] std::string take_news() override;
  [[nodiscard]] std::vector<LinkEvent> events() const override;

  [[nodiscard]] const CanCounters& counters() const noexcept { return counters_; }

 private:
  enum class BusState { kActive, kErrorPassive, kOff };

  bool receive();
  void take_error(const can_frame& frame);
  void take_state(BusState state);
  void take_overruns(std::uint32_t all);
  void add_news(const std::string& text);

  Descriptor socket_;
  CanPath path_;
  std::string name_;
  std::array<std::uint8_t, CANFD_MAX_DLEN> payload_{};  // received, not yet read completely
  std::size_t payload_size_ = 0;
  std::size_t payload_read_ = 0;
  bool gone_ = false;
  std::uint32_t overruns_ = 0;  // the socket's count
  BusState state_ = BusState::kActive;
  std::string news_;
  CanCounters counters_;
};

// For `path` see can_path.hpp.
[[nodiscard]] OpenedLink open_socket_can(const std::string& path);

// Explains `error_number` of a call on a CAN socket for `path`, with a remedy.
[[nodiscard]] LinkError explain_can_error(const std::string& path, const std::string& interface,
                                          int error_number);

}  // namespace groma::link
