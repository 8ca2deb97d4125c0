#include "host/link/descriptor.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <grp.h>
#include <poll.h>
#include <sys/file.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

namespace groma::link {
namespace {

std::string group_of(const std::string& path) {
  struct stat status {};
  if (::stat(path.c_str(), &status) != 0) return {};
  const group* entry = ::getgrgid(status.st_gid);
  return entry != nullptr ? entry->gr_name : fmt::format("{}", status.st_gid);
}

}  // namespace

LinkError explain_open_error(const std::string& path, int error_number) {
  switch (error_number) {
    case ENOENT:
    case ENODEV:
    case ENXIO:
    case ENOTDIR:
      return {LinkFault::kNoDevice, fmt::format("{}: no such device; plug it in, or list the ports with "
                                                "'ls -l /dev/serial/by-id'",
                                                path)};
    case ECONNREFUSED:
      return {LinkFault::kNoDevice,
              fmt::format("{}: no program listens on this socket; start the one that serves it", path)};
    case EACCES:
    case EPERM: {
      const std::string group = group_of(path);
      if (group.empty()) {
        return {LinkFault::kPermission,
                fmt::format("{}: permission denied on a folder of its path; let this user enter it", path)};
      }
      if (group == "root") {
        return {
            LinkFault::kPermission,
            fmt::format("{}: permission denied; it belongs to group 'root': 'groma flash --udev-rules' gives "
                        "ports to the group dialout; a link of another kind needs a group of its own",
                        path)};
      }
      return {LinkFault::kPermission,
              fmt::format("{}: permission denied; it belongs to group '{}': 'sudo usermod -aG {} $USER' and "
                          "log in again",
                          path, group, group)};
    }
    case EBUSY:
    case EWOULDBLOCK:
      return {LinkFault::kBusy,
              fmt::format("{}: in use by another program; 'fuser -v {}' shows which; stop it", path, path)};
    default:
      return {
          LinkFault::kUnsuitable,
          fmt::format("{}: cannot be used as a link ({}); name a serial port, a pseudo-terminal, a socket "
                      "or a recording",
                      path, std::strerror(error_number))};
  }
}

bool lock_device(int fd) noexcept {
  return ::flock(fd, LOCK_EX | LOCK_NB) == 0;
}

bool hung_up(int fd) noexcept {
  pollfd entry{fd, POLLIN, 0};
  return ::poll(&entry, 1, 0) > 0 && (entry.revents & (POLLHUP | POLLERR | POLLNVAL)) != 0;
}

ReadResult DescriptorLink::read(std::span<std::uint8_t> out) {
  while (true) {
    const ssize_t n = ::read(fd_.get(), out.data(), out.size());
    if (n > 0) return {static_cast<std::size_t>(n), false};
    if (n == 0) return {0, true};
    if (errno == EINTR) continue;
    return {0, errno != EAGAIN};
  }
}

std::size_t DescriptorLink::write(std::span<const std::uint8_t> bytes) {
  std::size_t sent = 0;
  while (sent < bytes.size()) {
    const auto rest = bytes.subspan(sent);
    // A socket without a reader must not raise SIGPIPE.
    ssize_t n = ::send(fd_.get(), rest.data(), rest.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    if (n < 0 && errno == ENOTSOCK) n = ::write(fd_.get(), rest.data(), rest.size());
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) break;
    sent += static_cast<std::size_t>(n);
  }
  return sent;
}

}  // namespace groma::link
