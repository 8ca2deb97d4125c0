#include "host/link/byte_link.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <utility>

#include "host/link/can_log.hpp"
#include "host/link/can_path.hpp"
#include "host/link/descriptor.hpp"
#include "host/link/network_link.hpp"
#include "host/link/socket_can_link.hpp"
#include "host/link/usb_port.hpp"

namespace groma::link {
namespace {

// Linux: Documentation/admin-guide/devices.txt, Unix98 pseudo-terminals.
constexpr unsigned kFirstPtyMajor = 136;
constexpr unsigned kLastPtyMajor = 143;

}  // namespace

OpenedLink open_unix_socket(const std::string& path) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof(address.sun_path)) {
    return {nullptr,
            {LinkFault::kUnsuitable,
             fmt::format("{}: longer than the {} characters that a socket's path may have", path,
                         sizeof(address.sun_path) - 1)}};
  }
  std::memcpy(address.sun_path, path.c_str(), path.size() + 1);
  Descriptor fd(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  if (!fd.valid() || ::connect(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
    // EAGAIN means a full backlog; report it as no listener.
    return {nullptr, explain_open_error(path, errno == EAGAIN ? ECONNREFUSED : errno)};
  }
  return {std::make_unique<DescriptorLink>(std::move(fd)), {}};
}

OpenedLink open_recording(const std::string& path) {
  Descriptor fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (!fd.valid()) return {nullptr, explain_open_error(path, errno)};
  return {std::make_unique<DescriptorLink>(std::move(fd)), {}};
}

OpenedLink open_can_log(const std::string& path) {
  const auto parsed = parse_can_log_path(path);
  if (!parsed) {
    return {nullptr,
            {LinkFault::kUnsuitable,
             fmt::format("{}: names no node of a CAN log; write it as can-log:FILE/NODE", path)}};
  }
  CanLog log = read_candump_log(parsed->file);
  if (log.error.fault != LinkFault::kNone) return {nullptr, std::move(log.error)};
  Descriptor fd(::memfd_create("can-log", MFD_CLOEXEC));
  if (!fd.valid()) return {nullptr, explain_open_error(path, errno)};
  for (const LoggedCanFrame& logged : log.frames) {
    const auto bytes = wire::stream_in(logged.frame, {wire::CanDirection::kToHost, parsed->node});
    if (::write(fd.get(), bytes.data(), bytes.size()) != static_cast<ssize_t>(bytes.size())) {
      return {nullptr, explain_open_error(path, errno)};
    }
  }
  if (::lseek(fd.get(), 0, SEEK_SET) != 0) return {nullptr, explain_open_error(path, errno)};
  return {std::make_unique<DescriptorLink>(std::move(fd)), {}};
}

OpenedLink open_link(const std::string& path, unsigned baud) {
  if (is_can_path(path)) return open_socket_can(path);
  if (is_can_log_path(path)) return open_can_log(path);
  if (is_network_path(path)) return open_network(path);
  if (is_usb_port_path(path)) return open_usb_port(path, baud);
  struct stat status {};
  if (::stat(path.c_str(), &status) != 0) return {nullptr, explain_open_error(path, errno)};
  if (S_ISSOCK(status.st_mode)) return open_unix_socket(path);
  if (S_ISREG(status.st_mode)) return open_recording(path);
  if (S_ISCHR(status.st_mode)) {
    const unsigned device = major(status.st_rdev);
    const bool pty = device >= kFirstPtyMajor && device <= kLastPtyMajor;
    return pty ? open_pty(path, baud) : open_serial_port(path, baud);
  }
  return {nullptr, explain_open_error(path, S_ISDIR(status.st_mode) ? EISDIR : ENOTTY)};
}

std::function<OpenedLink()> link_opener(const std::string& path, unsigned baud) {
  if (is_network_path(path)) {
    return [opener = std::make_shared<NetworkOpener>(path)] { return opener->open(); };
  }
  return [path, baud] { return open_link(path, baud); };
}

}  // namespace groma::link
