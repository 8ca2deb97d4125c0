#include "host/link/socket_can_link.hpp"

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
#include <cerrno>
#include <cstring>
#include <memory>
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
LinkError check_interface(int fd, const std::string& path, const CanPath& can) {
  ifreq answer{};
  if (!query_interface(fd, can.interface, SIOCGIFHWADDR, answer)) {
    return explain_missing(path, can.interface, fd);
  }
  if (answer.ifr_hwaddr.sa_family != ARPHRD_CAN) {
    const std::string others = can_interfaces(fd);
    return {LinkFault::kUnsuitable, fmt::format("{}: {} is not a CAN interface; {}", path, can.interface,
                                                others.empty() ? "see 'ip link show type can'"
                                                               : "available CAN interfaces: " + others)};
  }
  const bool fd_wanted = can.format == wire::CanFormat::kFd;
  if (!query_interface(fd, can.interface, SIOCGIFFLAGS, answer)) {
    return explain_can_error(path, can.interface, errno);
  }
  if ((answer.ifr_flags & IFF_UP) == 0) {
    return {LinkFault::kNoDevice, fmt::format("{}: {} is down; 'sudo ip link set {} {}'", path, can.interface,
                                              can.interface, fd_wanted ? kBringUpFd : kBringUpClassic)};
  }
  if (!query_interface(fd, can.interface, SIOCGIFMTU, answer)) {
    return explain_can_error(path, can.interface, errno);
  }
  if (fd_wanted && answer.ifr_mtu < static_cast<int>(CANFD_MTU)) {
    return {
        LinkFault::kUnsuitable,
        fmt::format("{}: {} is set up for classic CAN; 'sudo ip link set {} down' and 'sudo ip link set "
                    "{} {}', or, if its controller has no CAN FD, set the node to classic CAN and name "
                    "it can:{}/{}",
                    path, can.interface, can.interface, can.interface, kBringUpFd, can.interface, can.node)};
  }
  return {};
}

template <typename Value>
bool set_option(int fd, int level, int option, const Value& value) noexcept {
  return ::setsockopt(fd, level, option, &value, sizeof(value)) == 0;
}

// Only the node's frames and the controller's error frames reach the socket.
bool set_filters(int fd, const CanPath& can) noexcept {
  const can_filter of_node{
      .can_id = wire::can_id({wire::CanDirection::kToHost, can.node}) | CAN_EFF_FLAG,
      .can_mask = CAN_EFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG,
  };
  // A lost arbitration is not an error.
  const can_err_mask_t errors = CAN_ERR_MASK & ~static_cast<can_err_mask_t>(CAN_ERR_LOSTARB);
  const int on = 1;
  return set_option(fd, SOL_CAN_RAW, CAN_RAW_FILTER, of_node) &&
         set_option(fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, errors) &&
         (can.format == wire::CanFormat::kClassic || set_option(fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, on)) &&
         set_option(fd, SOL_SOCKET, SO_RXQ_OVFL, on);
}

void enlarge_queue(int fd) noexcept {
  // SO_RCVBUFFORCE exceeds the system's limit but requires CAP_NET_ADMIN; otherwise up to the limit is
  // enough.
  if (!set_option(fd, SOL_SOCKET, SO_RCVBUFFORCE, kReceiveBuffer_bytes)) {
    static_cast<void>(set_option(fd, SOL_SOCKET, SO_RCVBUF, kReceiveBuffer_bytes));
  }
}

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

OpenedLink open_socket_can(const std::string& path) {
  const auto can = parse_can_path(path);
  if (!can) {
    return {
        nullptr,
        {LinkFault::kUnsuitable, fmt::format("{}: names no node on a CAN bus; {}", path, kCanPathAdvice)}};
  }
  Descriptor fd(::socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW));
  if (!fd.valid()) return {nullptr, explain_can_error(path, can->interface, errno)};
  if (LinkError error = check_interface(fd.get(), path, *can); error.fault != LinkFault::kNone) {
    return {nullptr, std::move(error)};
  }
  sockaddr_can address{};
  address.can_family = AF_CAN;
  ifreq index{};
  if (!query_interface(fd.get(), can->interface, SIOCGIFINDEX, index) || !set_filters(fd.get(), *can)) {
    return {nullptr, explain_can_error(path, can->interface, errno)};
  }
  address.can_ifindex = index.ifr_ifindex;
  enlarge_queue(fd.get());
  if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
    return {nullptr, explain_can_error(path, can->interface, errno)};
  }
  return {std::make_unique<SocketCanLink>(std::move(fd), *can, path), {}};
}

SocketCanLink::SocketCanLink(Descriptor socket, CanPath path, std::string name) noexcept
    : socket_(std::move(socket)), path_(std::move(path)), name_(std::move(name)) {}

ReadResult SocketCanLink::read(std::span<std::uint8_t> out) {
  std::size_t bytes = 0;
  while (bytes < out.size()) {
    if (payload_read_ == payload_size_ && !receive()) break;
    const std::size_t n = std::min(out.size() - bytes, payload_size_ - payload_read_);
    std::memcpy(out.data() + bytes, payload_.data() + payload_read_, n);
    payload_read_ += n;
    bytes += n;
  }
  return {bytes, gone_ && bytes == 0};
}

// Receives the next frame's payload; false if none is available.
bool SocketCanLink::receive() {
  for (;;) {
    canfd_frame frame{};
    iovec part{&frame, sizeof(frame)};
    alignas(cmsghdr) std::array<char, CMSG_SPACE(sizeof(std::uint32_t))> control{};
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
    for (cmsghdr* header = CMSG_FIRSTHDR(&message); header != nullptr;
         header = CMSG_NXTHDR(&message, header)) {
      if (header->cmsg_level != SOL_SOCKET || header->cmsg_type != SO_RXQ_OVFL) continue;
      std::uint32_t overruns = 0;
      std::memcpy(&overruns, CMSG_DATA(header), sizeof(overruns));
      take_overruns(overruns);
    }
    const auto size = static_cast<std::size_t>(n);
    if (size != CAN_MTU && size != CANFD_MTU) continue;
    if (size == CAN_MTU && (frame.can_id & CAN_ERR_FLAG) != 0) {
      can_frame error{};
      std::memcpy(&error, &frame, sizeof(error));
      take_error(error);
      continue;
    }
    ++counters_.frames;
    payload_size_ = std::min<std::size_t>(frame.len, payload_.size());
    payload_read_ = 0;
    if (payload_size_ == 0) continue;
    std::memcpy(payload_.data(), frame.data, payload_size_);
    return true;
  }
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
    const bool fd = path_.format == wire::CanFormat::kFd;
    if (fd) frame.flags = CANFD_BRS;
    std::memcpy(frame.data, cut.data.data(), cut.size);
    // can_frame has the layout of the first part of canfd_frame.
    const ssize_t n = ::send(socket_.get(), &frame, fd ? CANFD_MTU : CAN_MTU, MSG_DONTWAIT);
    if (n < 0 && errno == EINTR) continue;
    // The socket reports such an error only once, so read() cannot rely on seeing it.
    if (n < 0 && (errno == ENETDOWN || errno == ENODEV || errno == ENXIO)) gone_ = true;
    if (n <= 0) break;
    sent += taken;
  }
  return sent;
}

std::string SocketCanLink::take_news() {
  return std::exchange(news_, {});
}

std::vector<LinkEvent> SocketCanLink::events() const {
  return {{"can_frames", counters_.frames},
          {"can_frames_overrun", counters_.frames_overrun},
          {"can_error_frames", counters_.error_frames},
          {"can_controller_overruns", counters_.controller_overruns},
          {"can_error_passive", counters_.error_passive},
          {"can_bus_off", counters_.bus_off},
          {"can_restarts", counters_.restarts}};
}

// linux/can/error.h
void SocketCanLink::take_error(const can_frame& frame) {
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

void SocketCanLink::take_state(BusState state) {
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
                      path_.interface));
      break;
  }
}

void SocketCanLink::take_overruns(std::uint32_t all) {
  const std::uint32_t more = all - overruns_;
  if (more == 0) return;
  if (counters_.frames_overrun == 0) {
    add_news("frames came faster than they were read and are lost; the computer is too busy");
  }
  overruns_ = all;
  counters_.frames_overrun += more;
}

void SocketCanLink::add_news(const std::string& text) {
  news_ += fmt::format("{}{}", news_.empty() ? name_ + ": " : "; ", text);
}

}  // namespace groma::link
