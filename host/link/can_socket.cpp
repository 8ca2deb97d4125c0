#include "host/link/can_socket.hpp"

#include <fmt/format.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <net/if_arp.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <ctime>
#include <utility>

namespace groma::link {
namespace {

// About 1000 frames, 0.1 s of a fully loaded bus; the system's default holds a quarter of that.
constexpr int kReceiveBuffer_bytes = 1 << 20;

constexpr std::string_view kBringUpClassic = "up type can bitrate 1000000";
constexpr std::string_view kBringUpFd = "up type can bitrate 1000000 dbitrate 2000000 fd on";

// Calls an ioctl of netdevice(7) for an interface; false with errno set on failure.
bool query_interface(int fd, const std::string& interface, unsigned long request, ifreq& answer) noexcept {
  answer = {};
  interface.copy(answer.ifr_name, IFNAMSIZ - 1);
  return ::ioctl(fd, request, &answer) == 0;
}

std::string can_interfaces(int fd) {
  std::string names;
  struct if_nameindex* const all = ::if_nameindex();
  for (const struct if_nameindex* entry = all; entry != nullptr && entry->if_index != 0; ++entry) {
    ifreq hardware{};
    if (!query_interface(fd, entry->if_name, SIOCGIFHWADDR, hardware)) continue;
    if (hardware.ifr_hwaddr.sa_family != ARPHRD_CAN) continue;
    names += (names.empty() ? "" : ", ") + std::string(entry->if_name);
  }
  ::if_freenameindex(all);
  return names;
}

LinkError explain_missing(const std::string& path, const std::string& interface, int fd) {
  const std::string others = can_interfaces(fd);
  return {LinkFault::kNoDevice,
          fmt::format("{}: there is no interface {}; {}", path, interface,
                      others.empty() ? "there is no CAN interface at all: plug the adapter in and load its "
                                       "driver"
                                     : "available CAN interfaces: " + others)};
}

// Returns an error unless the interface is a CAN interface, is up and supports the format.
LinkError check_interface(int fd, const std::string& path, const std::string& interface,
                          wire::CanFormat format) {
  ifreq answer{};
  if (!query_interface(fd, interface, SIOCGIFHWADDR, answer)) {
    return explain_missing(path, interface, fd);
  }
  if (answer.ifr_hwaddr.sa_family != ARPHRD_CAN) {
    const std::string others = can_interfaces(fd);
    return {LinkFault::kUnsuitable, fmt::format("{}: {} is not a CAN interface; {}", path, interface,
                                                others.empty() ? "see 'ip link show type can'"
                                                               : "available CAN interfaces: " + others)};
  }
  const bool fd_wanted = format == wire::CanFormat::kFd;
  if (!query_interface(fd, interface, SIOCGIFFLAGS, answer)) {
    return explain_can_error(path, interface, errno);
  }
  if ((answer.ifr_flags & IFF_UP) == 0) {
    return {LinkFault::kNoDevice, fmt::format("{}: {} is down; 'sudo ip link set {} {}'", path, interface,
                                              interface, fd_wanted ? kBringUpFd : kBringUpClassic)};
  }
  if (!query_interface(fd, interface, SIOCGIFMTU, answer)) {
    return explain_can_error(path, interface, errno);
  }
  if (fd_wanted && answer.ifr_mtu < static_cast<int>(CANFD_MTU)) {
    return {LinkFault::kUnsuitable,
            fmt::format("{}: {} is set up for classic CAN; 'sudo ip link set {} down' and 'sudo ip link set "
                        "{} {}', or, if its controller has no CAN FD, set the node to classic CAN and name "
                        "it can:{}",
                        path, interface, interface, interface, kBringUpFd, path.substr(path.find(':') + 1))};
  }
  return {};
}

template <typename Value>
bool set_option(int fd, int level, int option, const Value& value) noexcept {
  return ::setsockopt(fd, level, option, &value, sizeof(value)) == 0;
}

bool set_options(int fd, std::span<const can_filter> filters, bool receives_fd) noexcept {
  // A lost arbitration is not an error.
  const can_err_mask_t errors = CAN_ERR_MASK & ~static_cast<can_err_mask_t>(CAN_ERR_LOSTARB);
  const int on = 1;
  const auto size = static_cast<socklen_t>(filters.size_bytes());
  return ::setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, filters.data(), size) == 0 &&
         set_option(fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, errors) &&
         (!receives_fd || set_option(fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, on)) &&
         set_option(fd, SOL_SOCKET, SO_TIMESTAMPNS, on) && set_option(fd, SOL_SOCKET, SO_RXQ_OVFL, on);
}

void enlarge_queue(int fd) noexcept {
  // SO_RCVBUFFORCE exceeds the system's limit but requires CAP_NET_ADMIN; otherwise up to the limit is
  // enough.
  if (!set_option(fd, SOL_SOCKET, SO_RCVBUFFORCE, kReceiveBuffer_bytes)) {
    static_cast<void>(set_option(fd, SOL_SOCKET, SO_RCVBUF, kReceiveBuffer_bytes));
  }
}

}  // namespace

LinkError explain_can_error(const std::string& path, const std::string& interface, int error_number) {
  switch (error_number) {
    case EAFNOSUPPORT:
    case EPROTONOSUPPORT:
      return {
          LinkFault::kUnsuitable,
          fmt::format("{}: this kernel has no CAN sockets; 'sudo modprobe can-raw', or, where there is no "
                      "such module, boot a kernel that has it, such as Debian's",
                      path)};
    case EACCES:
    case EPERM:
      return {LinkFault::kPermission,
              fmt::format("{}: this user may not open CAN sockets; they need no privileges, so check "
                          "what the container or the service manager forbids",
                          path)};
    case ENODEV:
    case ENXIO:
      return {LinkFault::kNoDevice,
              fmt::format("{}: the interface {} was removed; plug the adapter in again", path, interface)};
    case ENETDOWN:
      return {LinkFault::kNoDevice,
              fmt::format("{}: {} is down; 'sudo ip link set {} up'", path, interface, interface)};
    default:
      return {LinkFault::kUnsuitable, fmt::format("{}: cannot be used as a link ({}); see 'ip -details link "
                                                  "show {}'",
                                                  path, std::strerror(error_number), interface)};
  }
}

CanSocket::Opened CanSocket::open(const std::string& name, const std::string& interface,
                                  std::span<const can_filter> filters, wire::CanFormat format,
                                  bool receives_fd) {
  Descriptor fd(::socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW));
  if (!fd.valid()) return {nullptr, explain_can_error(name, interface, errno)};
  if (LinkError error = check_interface(fd.get(), name, interface, format); error.fault != LinkFault::kNone) {
    return {nullptr, std::move(error)};
  }
  sockaddr_can address{};
  address.can_family = AF_CAN;
  ifreq index{};
  if (!query_interface(fd.get(), interface, SIOCGIFINDEX, index) ||
      !set_options(fd.get(), filters, receives_fd)) {
    return {nullptr, explain_can_error(name, interface, errno)};
  }
  address.can_ifindex = index.ifr_ifindex;
  enlarge_queue(fd.get());
  if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
    return {nullptr, explain_can_error(name, interface, errno)};
  }
  return {std::unique_ptr<CanSocket>(new CanSocket(std::move(fd), name, interface)), {}};
}

CanSocket::CanSocket(Descriptor socket, std::string name, std::string interface) noexcept
    : socket_(std::move(socket)), name_(std::move(name)), interface_(std::move(interface)) {}

bool CanSocket::receive(canfd_frame& frame) {
  for (;;) {
    frame = {};
    iovec part{&frame, sizeof(frame)};
    constexpr std::size_t kControl = CMSG_SPACE(sizeof(std::uint32_t)) + CMSG_SPACE(sizeof(timespec));
    alignas(cmsghdr) std::array<char, kControl> control{};
    msghdr message{};
    message.msg_iov = &part;
    message.msg_iovlen = 1;
    message.msg_control = control.data();
    message.msg_controllen = control.size();
    const ssize_t n = ::recvmsg(socket_.get(), &message, MSG_DONTWAIT);
    if (n < 0) {
      if (errno == EINTR) continue;
      if (errno == EAGAIN || gone_) return false;
      // The interface went down or was removed. Frames received before are still in the queue.
      gone_ = true;
      continue;
    }
    take_control(message);
    const auto size = static_cast<std::size_t>(n);
    if (size != CAN_MTU && size != CANFD_MTU) continue;
    if (size == CAN_MTU && (frame.can_id & CAN_ERR_FLAG) != 0) {
      can_frame error{};
      std::memcpy(&error, &frame, sizeof(error));
      take_error(error);
      continue;
    }
    ++counters_.frames;
    frame.len = std::min<std::uint8_t>(frame.len, CANFD_MAX_DLEN);
    return true;
  }
}

void CanSocket::take_control(msghdr& message) {
  for (cmsghdr* header = CMSG_FIRSTHDR(&message); header != nullptr; header = CMSG_NXTHDR(&message, header)) {
    if (header->cmsg_level != SOL_SOCKET) continue;
    if (header->cmsg_type == SO_RXQ_OVFL) {
      std::uint32_t overruns = 0;
      std::memcpy(&overruns, CMSG_DATA(header), sizeof(overruns));
      take_overruns(overruns);
    } else if (header->cmsg_type == SCM_TIMESTAMPNS) {
      timespec at{};
      std::memcpy(&at, CMSG_DATA(header), sizeof(at));
      received_s_ = static_cast<double>(at.tv_sec) + 1e-9 * static_cast<double>(at.tv_nsec);
    }
  }
}

bool CanSocket::send(const canfd_frame& frame, wire::CanFormat format) {
  for (;;) {
    // can_frame has the layout of the first part of canfd_frame.
    const std::size_t size = format == wire::CanFormat::kFd ? CANFD_MTU : CAN_MTU;
    if (::send(socket_.get(), &frame, size, MSG_DONTWAIT) > 0) return true;
    if (errno == EINTR) continue;
    // The socket reports such an error only once, so receive() cannot rely on seeing it.
    if (errno == ENETDOWN || errno == ENODEV || errno == ENXIO) gone_ = true;
    return false;
  }
}

std::string CanSocket::take_news() {
  return std::exchange(news_, {});
}

// linux/can/error.h
void CanSocket::take_error(const can_frame& frame) {
  ++counters_.error_frames;
  if ((frame.can_id & CAN_ERR_CRTL) != 0) {
    const unsigned detail = frame.data[1];
    if ((detail & CAN_ERR_CRTL_RX_OVERFLOW) != 0 && counters_.controller_overruns++ == 0) {
      add_news(
          "the controller's own buffer was full and frames are lost; the computer serves its interrupts too "
          "late");
    }
    if ((detail & (CAN_ERR_CRTL_RX_PASSIVE | CAN_ERR_CRTL_TX_PASSIVE)) != 0) {
      take_state(BusState::kErrorPassive);
    } else if ((detail & CAN_ERR_CRTL_ACTIVE) != 0) {
      take_state(BusState::kActive);
    }
  }
  if ((frame.can_id & CAN_ERR_RESTARTED) != 0) {
    ++counters_.restarts;
    take_state(BusState::kActive);
  }
  if ((frame.can_id & CAN_ERR_BUSOFF) != 0) take_state(BusState::kOff);
}

void CanSocket::take_state(BusState state) {
  if (state == state_) return;
  state_ = state;
  switch (state) {
    case BusState::kActive:
      add_news("the bus works again");
      break;
    case BusState::kErrorPassive:
      ++counters_.error_passive;
      add_news(
          "many errors on the bus (the controller is error-passive); check bit rate, wiring and the two "
          "terminations, and that another node acknowledges frames");
      break;
    case BusState::kOff:
      ++counters_.bus_off;
      add_news(
          fmt::format("the controller has left the bus after too many errors (bus-off); check bit rate, "
                      "wiring and the two terminations; 'sudo ip link set {0} type can restart' restarts it, "
                      "and 'sudo ip link set {0} type can restart-ms 100', given while the interface is "
                      "down, lets it restart by itself",
                      interface_));
      break;
  }
}

void CanSocket::take_overruns(std::uint32_t all) {
  const std::uint32_t more = all - overruns_;
  if (more == 0) return;
  if (counters_.frames_overrun == 0) {
    add_news("frames came faster than they were read and are lost; the computer is too busy");
  }
  overruns_ = all;
  counters_.frames_overrun += more;
}

void CanSocket::add_news(const std::string& text) {
  news_ += fmt::format("{}{}", news_.empty() ? name_ + ": " : "; ", text);
}

}  // namespace groma::link
