// Pseudo-terminals, by termios.
#include <fcntl.h>
#include <fmt/format.h>
#include <termios.h>

#include <cerrno>
#include <utility>

#include "host/link/byte_link.hpp"
#include "host/link/descriptor.hpp"

namespace groma::link {
namespace {

struct Rate {
  unsigned baud;
  speed_t code;
};

constexpr Rate kRates[] = {
    {9600, B9600},       {19200, B19200},     {38400, B38400},     {57600, B57600},     {115200, B115200},
    {230400, B230400},   {460800, B460800},   {500000, B500000},   {576000, B576000},   {921600, B921600},
    {1000000, B1000000}, {1500000, B1500000}, {2000000, B2000000}, {3000000, B3000000}, {4000000, B4000000},
};

const Rate* find_rate(unsigned baud) {
  for (const Rate& rate : kRates) {
    if (rate.baud == baud) return &rate;
  }
  return nullptr;
}

}  // namespace

OpenedLink open_pty(const std::string& path, unsigned baud) {
  const Rate* rate = find_rate(baud);
  if (rate == nullptr) {
    return {nullptr,
            {LinkFault::kUnsuitable,
             fmt::format("{}: {} bits per second is not a rate of terminals; use 115200 or 1000000", path,
                         baud)}};
  }
  Descriptor fd(::open(path.c_str(), O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC));
  if (!fd.valid()) {
    // EIO: the other end is closed, but the pseudo-terminal still exists.
    return {nullptr, explain_open_error(path, errno == EIO ? ENODEV : errno)};
  }
  if (!lock_device(fd.get())) return {nullptr, explain_open_error(path, errno)};
  termios settings{};
  if (::tcgetattr(fd.get(), &settings) != 0) return {nullptr, explain_open_error(path, errno)};
  ::cfmakeraw(&settings);
  settings.c_cflag |= CLOCAL | CREAD;
  settings.c_cflag &= ~static_cast<tcflag_t>(CRTSCTS | CSTOPB);
  if (::cfsetspeed(&settings, rate->code) != 0 || ::tcsetattr(fd.get(), TCSANOW, &settings) != 0) {
    return {nullptr, explain_open_error(path, errno)};
  }
  return {std::make_unique<DescriptorLink>(std::move(fd)), {}};
}

}  // namespace groma::link
