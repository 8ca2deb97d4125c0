// A raw socket of Linux's SocketCAN (Documentation/networking/can.rst) on one interface: frames, and the
// error frames of its controller.
#pragma once

#include <linux/can.h>
#include <sys/socket.h>

#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "host/link/byte_link.hpp"
#include "host/link/can_counters.hpp"
#include "host/link/descriptor.hpp"
#include "proto/can_segment.hpp"

namespace groma::link {

class CanSocket {
 public:
  struct Opened {
    std::unique_ptr<CanSocket> socket;
    LinkError error;
  };
  // Frames that match a filter, and error frames, are received. name: of the link, for messages. With
  // CanFormat::kFd the interface has to support CAN FD. Frames of CAN FD are received if it does and
  // `receives_fd` is set.
  [[nodiscard]] static Opened open(const std::string& name, const std::string& interface,
                                   std::span<const can_filter> filters, wire::CanFormat format,
                                   bool receives_fd);

  [[nodiscard]] int fd() const noexcept { return socket_.get(); }
  // Receives the next data frame; a classic one has the layout of the first part of canfd_frame. False: none
  // is available.
  [[nodiscard]] bool receive(canfd_frame& frame);
  // When the last frame arrived, by this computer's clock: s since 1970.
  [[nodiscard]] double received_s() const noexcept { return received_s_; }
  // False if the interface's queue is full, or the interface is gone.
  [[nodiscard]] bool send(const canfd_frame& frame, wire::CanFormat format);
  // The interface went down or was removed, and all frames received before have been read.
  [[nodiscard]] bool gone() const noexcept { return gone_; }

  // As ByteLink's.
  [[nodiscard]] std::string take_news();
  [[nodiscard]] const CanCounters& counters() const noexcept { return counters_; }

 private:
  enum class BusState : std::uint8_t { kActive, kErrorPassive, kOff };

  CanSocket(Descriptor socket, std::string name, std::string interface) noexcept;
  void take_control(msghdr& message);
  void take_error(const can_frame& frame);
  void take_state(BusState state);
  void take_overruns(std::uint32_t all);
  void add_news(const std::string& text);

  Descriptor socket_;
  std::string name_;
  std::string interface_;
  double received_s_ = 0.0;
  bool gone_ = false;
  std::uint32_t overruns_ = 0;  // the socket's count
  BusState state_ = BusState::kActive;
  std::string news_;
  CanCounters counters_;
};

// Explains `error_number` of a call on a CAN socket for `path`, with a remedy.
[[nodiscard]] LinkError explain_can_error(const std::string& path, const std::string& interface,
                                          int error_number);

}  // namespace groma::link
