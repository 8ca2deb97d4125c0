// A node on a CAN bus, by a raw socket of Linux's SocketCAN (Documentation/networking/can.rst): the node's
// stream as can_segment.hpp cuts it.
#pragma once

#include <linux/can.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "host/link/byte_link.hpp"
#include "host/link/can_path.hpp"
#include "host/link/descriptor.hpp"
#include "proto/can_segment.hpp"

namespace groma::link {

// Since the link was opened. What the controller tells of the bus, it tells each link.
struct CanCounters {
  std::uint64_t frames = 0;          // of the node
  std::uint64_t frames_overrun = 0;  // lost, as they came faster than they were read
  std::uint64_t error_frames = 0;    // of the controller, of whatever kind; those that follow among them
  std::uint64_t controller_overruns =
      0;                            // the controller's buffer was full: frames of whatever node are lost
  std::uint64_t error_passive = 0;  // times that it got so far
  std::uint64_t bus_off = 0;
  std::uint64_t restarts = 0;  // after bus-off
};

class SocketCanLink : public ByteLink {
 public:
  // A socket that does not block and is bound to the path's interface, with the filters set.
  SocketCanLink(Descriptor socket, CanPath path, std::string name) noexcept;

  [[nodiscard]] int poll_fd() const noexcept override { return socket_.get(); }
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override;
  // Sends frames of the link's format; takes as many bytes as the interface's queue had room for.
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override;
  [[nodiscard]] std::string take_news() override;

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
  std::array<std::uint8_t, CANFD_MAX_DLEN> payload_{};  // received, and not all read
  std::size_t payload_size_ = 0;
  std::size_t payload_read_ = 0;
  bool gone_ = false;
  std::uint32_t overruns_ = 0;  // as the socket counts them
  BusState state_ = BusState::kActive;
  std::string news_;
  CanCounters counters_;
};

// `path` as can_path.hpp has it.
[[nodiscard]] OpenedLink open_socket_can(const std::string& path);

// What a call on a CAN socket for `path` meant by `error_number`, with its remedy.
[[nodiscard]] LinkError explain_can_error(const std::string& path, const std::string& interface,
                                          int error_number);

}  // namespace groma::link
