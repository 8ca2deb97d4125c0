// A virtual CAN interface (vcan) that exists as long as its object, and other participants of its bus. Needs
// a kernel with vcan and the permission to create interfaces: test/vm/with-can.
#pragma once

#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <deque>
#include <exception>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "host/io/descriptor.hpp"
#include "proto/can_segment.hpp"
#include "test/support/child_process.hpp"

namespace groma::test {

class VirtualCan {
 public:
  explicit VirtualCan(std::string name, int mtu = CANFD_MTU) : name_(std::move(name)), mtu_(mtu) { add(); }
  VirtualCan(const VirtualCan&) = delete;
  VirtualCan& operator=(const VirtualCan&) = delete;
  ~VirtualCan() {
    try {
      if (there_) remove();
    } catch (const std::exception&) {
      // The interface disappears with the test's network namespace or machine.
      there_ = false;
    }
  }

  void add() {
    ip({"add", "dev", name_, "type", "vcan"});
    there_ = true;
    ip({"set", name_, "mtu", std::to_string(mtu_), "up"});
  }
  void remove() {
    ip({"del", name_});
    there_ = false;
  }
  void up() { ip({"set", name_, "up"}); }
  void down() { ip({"set", name_, "down"}); }

  [[nodiscard]] const std::string& name() const { return name_; }

 private:
  static constexpr const char* kBusybox = "/bin/busybox";

  static void ip(const std::vector<std::string>& arguments) {
    std::vector<std::string> command{kBusybox, "ip", "link"};
    command.insert(command.end(), arguments.begin(), arguments.end());
    const ChildResult result = run_child(command);
    if (result.exit_code != 0) throw std::runtime_error("ip link: " + result.out + result.err);
  }

  std::string name_;
  int mtu_;
  bool there_ = false;
};

// Another participant of the bus, which receives and can send any frame. A send returns when the bus has
// delivered the frame: a busy kernel delivers later than write() returns.
class CanParticipant {
 public:
  explicit CanParticipant(const std::string& interface)
      : fd_(::socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW)) {
    const int on = 1;
    const can_err_mask_t every_error = CAN_ERR_MASK;
    sockaddr_can address{};
    address.can_family = AF_CAN;
    address.can_ifindex = static_cast<int>(::if_nametoindex(interface.c_str()));
    if (!fd_.valid() || address.can_ifindex == 0 ||
        ::setsockopt(fd_.get(), SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof(on)) != 0 ||
        ::setsockopt(fd_.get(), SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &on, sizeof(on)) != 0 ||
        ::setsockopt(fd_.get(), SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &every_error, sizeof(every_error)) != 0 ||
        ::bind(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      throw std::runtime_error("no CAN socket on " + interface);
    }
  }

  // Sends the frame unchanged, including the flags in its id.
  void send_raw(const can_frame& frame) const { send_bytes(&frame, CAN_MTU); }

  void send(const wire::CanFrame& frame) const {
    canfd_frame raw{};
    raw.can_id = frame.id | CAN_EFF_FLAG;
    raw.len = frame.size;
    if (frame.bit_rate_switch) raw.flags = CANFD_BRS;
    std::memcpy(raw.data, frame.data.data(), frame.size);
    send_bytes(&raw, frame.format == wire::CanFormat::kFd ? CANFD_MTU : CAN_MTU);
  }

  // Cuts the protocol's byte stream into CAN frames and sends them.
  void send_stream(std::span<const std::uint8_t> stream, wire::CanFormat format,
                   wire::CanAddress from) const {
    while (!stream.empty()) {
      wire::CanFrame frame;
      stream = stream.subspan(wire::cut_can_payload(stream, format, frame));
      frame.id = wire::can_id(from);
      send(frame);
    }
  }

  // The next frame of the others with a 29-bit id; waits up to two seconds for each frame.
  [[nodiscard]] std::optional<wire::CanFrame> receive() const {
    for (;;) {
      std::optional<Received> next;
      if (waiting_.empty()) {
        next = take();
      } else {
        next = waiting_.front();
        waiting_.pop_front();
      }
      if (!next) return std::nullopt;
      const canfd_frame& raw = next->frame;
      if (next->own || (raw.can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)) != CAN_EFF_FLAG) continue;
      wire::CanFrame frame;
      frame.id = raw.can_id & CAN_EFF_MASK;
      frame.format = next->size == CANFD_MTU ? wire::CanFormat::kFd : wire::CanFormat::kClassic;
      frame.bit_rate_switch =
          frame.format == wire::CanFormat::kFd && (raw.flags & static_cast<unsigned>(CANFD_BRS)) != 0;
      frame.size = raw.len;
      std::memcpy(frame.data.data(), raw.data, frame.data.size());
      return frame;
    }
  }

 private:
  struct Received {
    canfd_frame frame{};
    std::size_t size = 0;
    bool own = false;
  };

  // The socket's next frame; waits up to two seconds.
  [[nodiscard]] std::optional<Received> take() const {
    pollfd entry{fd_.get(), POLLIN, 0};
    if (::poll(&entry, 1, 2000) <= 0) return std::nullopt;
    Received got;
    iovec part{&got.frame, sizeof(got.frame)};
    msghdr message{};
    message.msg_iov = &part;
    message.msg_iovlen = 1;
    const ssize_t n = ::recvmsg(fd_.get(), &message, 0);
    if (n < static_cast<ssize_t>(CAN_MTU)) return std::nullopt;
    got.size = static_cast<std::size_t>(n);
    got.own = (message.msg_flags & MSG_CONFIRM) != 0;
    return got;
  }

  void send_bytes(const void* frame, std::size_t size) const {
    if (::write(fd_.get(), frame, size) != static_cast<ssize_t>(size)) {
      throw std::runtime_error("a CAN frame could not be sent");
    }
    for (;;) {
      const std::optional<Received> next = take();
      if (!next) throw std::runtime_error("the bus did not deliver a frame within two seconds");
      if (next->own) return;
      waiting_.push_back(*next);
    }
  }

  io::Descriptor fd_;
  mutable std::deque<Received> waiting_;  // Frames of the others that arrived during a send.
};

}  // namespace groma::test
